"""Contact at the end of the substep: stiffer than an explicit one could be, with equilibria that know no step."""

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from msdm_core.kernels.structure_kernels import FAULT_NONE, ContactLaw, ContactShapes, OrganModel, OrganState
from msdm_core.material.regions import Damping
from msdm_core.organ.compile import rest_state
from msdm_core.organ.stability import largest_frequency, stable_dt
from msdm_core.organ.stepping import advance_organ, round_shapes
from tests.core import oracle
from tests.core.measures import momentum

SMOOTH = ContactLaw(stiffness=1e8, damping=100.0, friction=0.0, tangential_stiffness=5e7)
ROUGH = SMOOTH._replace(friction=0.3)
RADIUS = 0.008  # [m]
TOP = 0.02  # [m]


def organ(alpha: float = 150.0) -> OrganModel:
    return oracle.block((0.03, 0.03, TOP), (6, 6, 4), damping=Damping(alpha), anchored_below=1e-9)


def ball(depth: float = 0.0, *, velocity: ArrayLike = (0.0, 0.0, 0.0)) -> ContactShapes:
    return oracle.ball((0.0156, 0.0144, TOP + RADIUS - depth), RADIUS, velocity=velocity)


def run(
    model: OrganModel, state: OrganState, shapes: ContactShapes, law: ContactLaw, dt: float, seconds: float
) -> NDArray:
    """Mean wrench of each millisecond, (n, n_tool, 6)."""
    count, each = round(seconds / 1e-3), round(1e-3 / dt)
    wrench = np.zeros((count, len(shapes.tool_centre), 6))
    for number in range(count):
        assert advance_organ(model, state, shapes, law, dt, each, wrench[number]) == FAULT_NONE
    return wrench


def test_contact_is_stiffer_than_an_explicit_one_could_be():
    """Explicitly, symplectic Euler would need dt <= 2 / w_max of the organ held by k_p A at its nodes."""
    model = organ()
    area = np.bincount(
        model.surface_triangles.ravel(), np.repeat(model.surface_rest_area / 3.0, 3), len(model.node_mass)
    )
    law = SMOOTH._replace(stiffness=5e7)
    explicit = 2.0 / largest_frequency(model, law.stiffness * area)
    assert stable_dt(model, law) > 1.8 * explicit


@pytest.mark.parametrize(("stiffness", "steps"), [(1e8, (5e-4, 2.5e-4, 1e-4)), (1e9, (1.25e-4, 1e-4, 5e-5))])
def test_a_static_press_does_not_depend_on_the_step(stiffness: float, steps: tuple[float, ...]):
    """The same force to 1e-5 at steps that differ by a factor of 2.5 and more, at rest to 1e-6 of it."""
    model, law, forces = organ(), SMOOTH._replace(stiffness=stiffness), []
    for dt in steps:
        state = rest_state(model, shape_count=1)
        shapes = ball(velocity=(0.0, 0.0, -0.02))
        run(model, state, shapes, law, dt, 0.1)
        shapes.tool_twist[:] = 0.0
        force = run(model, state, shapes, law, dt, 0.4)[:, 0, 2]
        assert np.ptp(force[-20:]) < 1e-6 * force[-1]
        forces.append(force[-1])
    assert forces[0] > 0.05
    np.testing.assert_allclose(forces, forces[-1], rtol=1e-5)


def test_an_equilibrium_stays_where_it_is():
    """Settled with a short step, friction on: with a longer one no node moves by more than rounding."""
    model = organ()
    state, shapes = rest_state(model, shape_count=1), ball(velocity=(0.004, 0.0, -0.02))
    run(model, state, shapes, ROUGH, 1e-4, 0.1)
    shapes.tool_twist[:] = 0.0
    run(model, state, shapes, ROUGH, 1e-4, 1.0)
    place, stretch = state.node_position.copy(), state.contact_stretch.copy()
    assert np.abs(stretch).max() > 1e-6
    run(model, state, shapes, ROUGH, 5e-4, 0.1)
    assert np.abs(state.node_position - place).max() < 1e-11
    np.testing.assert_allclose(state.contact_stretch, stretch, rtol=0, atol=1e-11)


def test_momentum_is_exchanged_and_nothing_else():
    """A free block under a spinning, sliding, rough ball: change of momentum = - wrench x time, to rounding."""
    model = oracle.block((0.03, 0.03, TOP), (6, 6, 4))
    state = rest_state(model, shape_count=1)
    shapes = ball(velocity=(0.1, -0.05, -0.1))
    shapes.tool_twist[0, 3:] = (3.0, -2.0, 20.0)
    pivot = np.array([0.01, -0.02, 0.05])
    for _ in range(50):
        before = momentum(model, state), _spin(model, state, pivot)
        centre, wrench = shapes.tool_centre[0].copy(), np.zeros((1, 6))
        assert advance_organ(model, state, shapes, SMOOTH._replace(friction=0.3), 2e-4, 5, wrench) == FAULT_NONE
        force, torque = wrench[0, :3], wrench[0, 3:] + np.cross(centre - pivot, wrench[0, :3])
        # 1e-12 of the impulse, and the rounding of the momentum itself.
        size = 1e-12 * 1e-3 * float(np.abs(wrench[0, :3]).max()) + 1e-17
        np.testing.assert_allclose(momentum(model, state) - before[0], -1e-3 * force, rtol=0, atol=size)
        np.testing.assert_allclose(_spin(model, state, pivot) - before[1], -1e-3 * torque, rtol=0, atol=size)


def _spin(model: OrganModel, state: OrganState, pivot: NDArray) -> NDArray:
    return model.node_mass @ np.cross(state.node_position - pivot, state.node_velocity)


def test_a_pressure_never_pulls():
    """A ball torn out of undamped tissue at 1 m/s, no friction: never drawn back, and free at once."""
    model = organ(alpha=0.0)
    state, shapes = rest_state(model, shape_count=1), ball(velocity=(0.0, 0.0, -0.05))
    run(model, state, shapes, SMOOTH, 2.5e-4, 0.04)
    shapes.tool_twist[0, 2] = 1.0
    force = run(model, state, shapes, SMOOTH, 2.5e-4, 0.02)[:, 0, 2]
    assert force.min() > -1e-15 and force[-1] == 0.0


def test_friction_sticks_up_to_the_pressure_that_acts():
    """Sliding over a cell: what friction adds to the drag of a smooth ball is mu N, whatever stiffness and step."""
    model = organ()
    for stiffness, dt in ((1e8, 5e-4), (1e8, 2e-4), (1e9, 1e-4)):
        drag = []
        for friction in (0.0, 0.3):
            law = ROUGH._replace(stiffness=stiffness, tangential_stiffness=0.5 * stiffness, friction=friction)
            state, shapes = rest_state(model, shape_count=1), ball(velocity=(0.0, 0.0, -0.02))
            shapes.shape_ends[:, :, 0] -= 0.006
            shapes.tool_centre[:, 0] -= 0.006
            run(model, state, shapes, law, dt, 0.05)
            shapes.tool_twist[0, :3] = (0.02, 0.0, 0.0)
            wrench = run(model, state, shapes, law, dt, 0.35)[-250:, 0]
            drag.append(-wrench[:, 0].sum() / wrench[:, 2].sum())
        assert drag[1] - drag[0] == pytest.approx(0.3, rel=0.05)


def test_two_tools_that_pinch_hold_still():
    """A rib between two balls of one radius, ten times as stiff as scenes are: forces opposite, steady, no chatter."""
    model = oracle.block((0.03, 0.03, 0.01), (9, 9, 3), damping=Damping(150.0), anchored_below=-1.0)
    held = np.where(model.node_rest_position[:, 0] < 1e-9, 0.0, model.node_inverse_mass)
    model = model._replace(node_inverse_mass=oracle.frozen(held))
    ends = [[[0.0156, 0.0144, 0.01 + RADIUS]] * 2, [[0.0156, 0.0144, -RADIUS]] * 2]
    shapes = round_shapes(ends, [RADIUS] * 2, tool=[0, 1])
    state, law = rest_state(model, shape_count=2), ROUGH._replace(stiffness=5e8, tangential_stiffness=2.5e8)
    dt = 1e-3 / np.ceil(1e-3 / (0.9 * stable_dt(model, law)))
    shapes.tool_twist[:, 2] = -0.01, 0.01
    run(model, state, shapes, law, dt, 0.1)
    shapes.tool_twist[:] = 0.0
    wrench = run(model, state, shapes, law, dt, 0.5)
    assert wrench[-1, 0, 2] == pytest.approx(-wrench[-1, 1, 2], rel=1e-3) and wrench[-1, 0, 2] > 0.02
    assert np.ptp(wrench[-50:, :, :3], axis=0).max() < 1e-5 * wrench[-1, 0, 2]
