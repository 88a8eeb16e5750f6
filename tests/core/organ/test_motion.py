"""Motion of what holds an organ: quasi-static, work against energy, damping, supports, bad input."""

import math
from dataclasses import replace

import numpy as np
import pytest

from msdm_core.errors import OrganError
from msdm_core.kernels.structure_kernels import FAULT_NONE, OrganModel, OrganState
from msdm_core.material.regions import Damping, Material
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.foundation import Foundation
from msdm_core.organ.measure import kinetic_energy, potential_energy, support_forces
from msdm_core.organ.motion import Motion, place_on_ground
from msdm_core.organ.stability import stable_dt
from msdm_core.organ.stepping import NO_CONTACT, NO_SHAPES, advance, advance_organ
from msdm_core.organ.support import Support
from tests.core.measures import ground_work, steer

SIZE = (0.06, 0.03, 0.03)
MESH = box_mesh(SIZE, (6, 3, 3))
BOTTOM = np.flatnonzero(MESH.points[:, 2] < 1e-9)
LEFT = np.flatnonzero(MESH.points[:, 0] < 1e-9)
TISSUE = Material(8e3, 1000.0, 0.3)
# The foundation below moves in a part of it, the wall on the left does not.
HEART = Motion("heartbeat", (0.0, 0.001, 0.003), centre=(0.05, 0.015, 0.0), reach=0.03)
BREATH = Motion("breathing", (0.012, 0.0, 0.004))
HELD = OrganSpec(MESH, TISSUE, anchors=LEFT, foundations=(Foundation("bed", BOTTOM, 3e5, 1e5),))
MARKER = int(np.argmax(MESH.points @ [1.0, 0.1, 1.0]))
HAPTIC_STEP = 1e-3


def cycle(time: float, period: float) -> float:
    """A signal that rises to 1 and falls to 0 in each period."""
    return 0.5 * (1.0 - math.cos(2.0 * math.pi * time / period))


def follow(model: OrganModel, state: OrganState, signals, step: float, count: int, share: float = 0.5) -> np.ndarray:
    """Steer one motion through signals (n,), a haptic step [s] each; the marker's positions after them [m] (n, 3)."""
    substeps = math.ceil(step / (share * stable_dt(model)))
    places = []
    for signal in signals:
        steer(state, [signal] * count, step)
        fault = advance_organ(model, state, NO_SHAPES, NO_CONTACT, step / substeps, substeps, np.zeros((0, 6)))
        assert fault == FAULT_NONE
        places.append(state.node_position[MARKER].copy())
    return np.array(places)


def static_shift(motion: Motion) -> np.ndarray:
    """Displacement of the resting marker from signal 0 to signal 1 [m] (3,)."""
    model = compile_organ(replace(HELD, motions=(motion,), damping=Damping(alpha=60.0)))
    state = rest_state(model)
    rise = [cycle(0.5 * share, 1.0) for share in np.linspace(0.0, 1.0, 300)]
    follow(model, state, [*rise, *([1.0] * 1500)], HAPTIC_STEP, 1)
    assert np.abs(state.node_velocity).max() < 1e-7
    return state.node_position[MARKER] - MESH.points[MARKER]


def harmonic(values: np.ndarray, period: float) -> complex:
    """Amplitude and phase of a signal's part at the frequency of a period, over whole periods of HAPTIC_STEP."""
    time = HAPTIC_STEP * np.arange(1, len(values) + 1)
    return complex(values @ np.exp(-2j * np.pi * time / period)) * 2.0 / len(values)


@pytest.mark.parametrize("motion", [BREATH, HEART], ids=["all of it", "a part"])
def test_a_free_node_follows_a_breath_quasi_statically(motion):
    """0.25 Hz is far below the organ's modes: amplitude and phase of the static solution, both within 2 %."""
    model = compile_organ(replace(HELD, motions=(motion,)))
    state = rest_state(model)
    signals = [cycle(HAPTIC_STEP * number, 4.0) for number in range(1, 8001)]
    moved = (follow(model, state, signals, HAPTIC_STEP, 1) - MESH.points[MARKER])[4000:]
    still = static_shift(motion)
    axis = int(np.abs(still).argmax())
    ratio = harmonic(moved[:, axis], 4.0) / (still[axis] * harmonic(np.array(signals[4000:]), 4.0))
    assert abs(ratio) == pytest.approx(1.0, abs=0.02)
    assert abs(np.angle(ratio)) < 0.02


def test_a_heartbeat_is_as_with_small_steps():
    """1.2 Hz: the path at the scene's step against one with steps a tenth as long, 5 % of its largest excursion."""
    model = compile_organ(replace(HELD, motions=(HEART,)))
    period = 1.0 / 1.2
    paths = []
    for refined in (1, 10):
        step = HAPTIC_STEP / refined
        count = round(2.0 * period / HAPTIC_STEP) * refined
        signals = [cycle(step * number, period) for number in range(1, count + 1)]
        share = 0.9 if refined == 1 else 0.09
        paths.append(follow(model, rest_state(model), signals, step, 1, share)[refined - 1 :: refined])
    excursion = np.abs(paths[1] - MESH.points[MARKER]).max()
    assert excursion > 3e-4
    assert np.abs(paths[0] - paths[1]).max() < 0.05 * excursion


def test_an_organ_placed_on_moving_ground_goes_with_it():
    """All of the ground moves evenly: no tissue strains, whatever the signal."""
    model = compile_organ(replace(HELD, motions=(BREATH,)))
    state = rest_state(model)
    place_on_ground(model, state, [0.4], [0.5])
    shift = np.array(BREATH.displacement)
    np.testing.assert_allclose(state.node_position, MESH.points + 0.4 * shift, atol=1e-15)
    signals = [0.4 + 0.5 * HAPTIC_STEP * number for number in range(1, 301)]
    follow(model, state, signals, HAPTIC_STEP, 1)
    np.testing.assert_allclose(state.node_position, MESH.points + signals[-1] * shift, atol=1e-9)


def energy(model: OrganModel, state: OrganState, dt: float) -> float:
    """Energy at the time of the positions: velocities of symplectic Euler belong to half a step before."""
    later = OrganState(*(array.copy() for array in state))
    assert advance_organ(model, later, NO_SHAPES, NO_CONTACT, dt, 1, np.zeros((0, 6))) == FAULT_NONE
    later.node_velocity[:] = 0.5 * (state.node_velocity + later.node_velocity)
    return kinetic_energy(model, later) + potential_energy(model, state)


def test_the_work_of_the_ground_is_the_energy_of_the_organ():
    """alpha = 0, no contact: 1e-6 of the largest work, at steps for which Euler's own error is smaller; order 2."""
    model = compile_organ(replace(HELD, motions=(BREATH, HEART), damping=Damping(alpha=0.0)))
    errors = []
    for share in (0.02, 0.01):
        state, dt = rest_state(model), share * stable_dt(model)
        substeps, largest = 50, 0.0
        rises = round(0.05 / (substeps * dt))
        for number in [*range(1, rises + 1), *[rises] * 5]:
            steer(state, [1.0 * cycle(0.5 * number / rises, 1.0), 0.7 * cycle(number / rises, 1.0)], substeps * dt)
            assert advance_organ(model, state, NO_SHAPES, NO_CONTACT, dt, substeps, np.zeros((0, 6))) == FAULT_NONE
            largest = max(largest, float(np.abs(ground_work(state)).max()))
        steer(state, state.motion[:, 0], dt)
        errors.append(abs(energy(model, state, dt) - ground_work(state).sum()) / largest)
    assert largest > 1e-5
    assert errors[1] < 1e-6
    assert errors[1] < 0.4 * errors[0]


def test_damping_by_mass_is_relative_to_the_ground():
    """A ground that moves evenly carries the organ along: no drag, however large alpha."""
    model = compile_organ(replace(HELD, motions=(BREATH,), damping=Damping(alpha=50.0)))
    state = rest_state(model)
    speed = 0.1 * np.array(BREATH.displacement)
    state.node_velocity[:] = speed
    follow(model, state, [0.1 * HAPTIC_STEP * number for number in range(1, 501)], HAPTIC_STEP, 1)
    np.testing.assert_allclose(state.node_velocity, np.broadcast_to(speed, MESH.points.shape), atol=1e-12)
    np.testing.assert_allclose(state.node_position, MESH.points + 0.05 * np.array(BREATH.displacement), atol=1e-13)


def test_a_support_carries_what_lies_on_it():
    """A bed that rises and stays: the organ rests on it as before, as much higher, and the bed bears its weight."""
    spec = OrganSpec(
        MESH, TISSUE, damping=Damping(alpha=40.0), gravity=(0.0, 0.0, -9.81),
        supports=(Support("bed", "plane", friction=0.0),), motions=(Motion("breathing", (0.0, 0.0, 0.01)),),
    )  # fmt: skip
    model = compile_organ(spec)
    state = rest_state(model)
    before = state.node_position.copy()
    rise = [cycle(0.5 * share, 1.0) for share in np.linspace(0.0, 1.0, 300)]
    follow(model, state, [*rise, *([1.0] * 700)], HAPTIC_STEP, 1)
    np.testing.assert_allclose(state.node_position - before, np.broadcast_to([0.0, 0.0, 0.01], before.shape), atol=1e-6)
    assert support_forces(model, state)[0, 2] == pytest.approx(9.81 * model.node_mass.sum(), rel=1e-3)


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"displacement": (0.0, math.nan, 0.0)}, "displacement is .*nan"),
        ({"reach": -1.0, "centre": (0.0, 0.0, 0.0)}, "reach is -1"),
        ({"reach": 0.1}, "centre"),
    ],
)
def test_motions_that_are_impossible_are_refused(given, named):
    with pytest.raises(OrganError, match=named):
        Motion(**{"name": "breathing", "displacement": (0.0, 0.0, 0.01), **given})


def test_a_state_of_an_organ_that_moves_otherwise_is_refused():
    """Compiled code would read beyond its arrays."""
    moved, still = (compile_organ(replace(HELD, motions=motions)) for motions in ((BREATH,), ()))
    with pytest.raises(OrganError, match="nodes on supports, supports"):
        advance(moved, rest_state(still), dt=1e-5)
