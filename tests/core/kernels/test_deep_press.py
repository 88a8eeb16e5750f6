"""Inversion is never silent: a press to 60 % of the layer ends with a named fault, or whole and outside."""

import re
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from msdm_core.errors import OrganDivergedError
from msdm_core.kernels.structure_kernels import OrganModel, OrganState
from msdm_core.organ.compile import rest_state
from msdm_core.organ.measure import inverted_tets, volume_ratios
from msdm_core.organ.stepping import advance
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.load import make_scene
from tests.core import oracle

HAPTIC_STEP = 1e-3  # [s]
SPEED = 0.03  # [m/s]
SITES = {"a node": (0.03, 0.03, 0.03), "between nodes": (0.0312, 0.0287, 0.03)}


@cache
def phantom() -> Anatomy:
    return load_anatomy(make_scene("phantom"))


@cache
def organ(site: str, hard: bool) -> OrganModel:
    """The phantom, healthy or with its stiffest, shallowest, largest lesion below a site."""
    anatomy = phantom()
    draw = anatomy.scene.lesion
    lesion = anatomy.lesion_below(np.array(SITES[site]), draw.radius[1], draw.cover[0], draw.modulus_ratio[1], "worst")
    return anatomy.organ([lesion] if hard else [])


class End(NamedTuple):
    """End of a press: depth [m], the fault's words or "", forces upward [N], the state, the ball's centre [m]."""

    depth: float
    fault: str
    force: NDArray
    state: OrganState
    centre: NDArray


def press(
    model: OrganModel, site: str, radius: float, depth: float, *, substeps: int | None = None, hold: float = 0.0
) -> End:
    """Push a ball straight down to a depth, or until a fault, and let it stand there for `hold` [s]."""
    law = phantom().scene.contact.law
    count = substeps or phantom().scene.timing.substep_count
    state = rest_state(model, shape_count=1)
    start = np.array(SITES[site]) + np.array([0.0, 0.0, radius])
    shapes = oracle.ball(start, radius, velocity=(0.0, 0.0, -SPEED))
    force: list[float] = []
    fault = ""
    down = round(depth / SPEED / HAPTIC_STEP)
    for step in range(down + round(hold / HAPTIC_STEP)):
        if step == down:
            shapes.tool_twist[:] = 0.0
        try:
            wrench = advance(model, state, dt=HAPTIC_STEP / count, substep_count=count, shapes=shapes, contact=law)
        except OrganDivergedError as error:
            fault = str(error)
            break
        force.append(float(wrench[0, 2]))
    centre = shapes.shape_ends[0, 0]
    return End(float(start[2] - centre[2]), fault, np.array(force), state, centre.copy())


def winding_number(point: NDArray, corners: NDArray) -> float:
    """Winding number of a closed surface of triangles (n, 3, 3) around a point: 0 outside, 1 inside.

    Sum of solid angles / 4 pi, tan(w / 2) = a . (b x c) / (abc + (a . b) c + (b . c) a + (c . a) b) (Van Oosterom).
    """
    a, b, c = (corners - point).transpose(1, 0, 2)
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    top = np.einsum("ij,ij->i", a, np.cross(b, c))
    ab, bc, ca = ((first * second).sum(axis=1) for first, second in ((a, b), (b, c), (c, a)))
    return float(np.arctan2(top, la * lb * lc + ab * lc + bc * la + ca * lb).sum() / (2.0 * np.pi))


def check_end(model: OrganModel, end: End, depth: float) -> None:
    """A true named fault, or a complete press."""
    ratios = volume_ratios(model, end.state)
    if end.fault:
        named = re.match(r"tet (\d+) turned inside out: volume ratio", end.fault)
        assert named, end.fault
        # What was seen at the start of the last substep; that substep moved on from there.
        assert end.state.volume_ratio_smallest[0] <= 0.0
        assert ratios[int(named[1])] < 0.2
        return
    assert end.depth == pytest.approx(depth, rel=0.02)
    assert end.state.volume_ratio_smallest[0] > 0.0
    assert not inverted_tets(model, end.state).size
    surface = end.state.node_position[phantom().mesh.boundary_triangles]
    assert winding_number(end.centre, surface) == pytest.approx(0.0, abs=0.01), "the ball is inside the organ"
    # Still held off, as hard as ever: a ball that is let go feels less with every millimetre.
    assert end.state.contact_engaged.any()
    assert end.force[-10:].mean() > 0.9 * end.force.max(), f"lost after {end.force.max():.2f} N"


def test_the_winding_number_tells_inside_from_outside():
    surface = phantom().mesh.points[phantom().mesh.boundary_triangles]
    assert winding_number(np.array([0.03, 0.03, 0.02]), surface) == pytest.approx(1.0)
    assert winding_number(np.array([0.03, 0.03, 0.031]), surface) == pytest.approx(0.0, abs=1e-9)


PRESSES = [
    pytest.param(site, hard, radius, id=f"{radius * 1e3:.0f} mm, {site}, {'lesion' if hard else 'healthy'}")
    for site in SITES
    for radius, hard in ((0.008, False), (0.008, True), (0.005, False), (0.005, True))
]


@pytest.mark.parametrize(("site", "hard", "radius"), PRESSES)
def test_a_press_to_sixty_percent_of_the_layer(site: str, hard: bool, radius: float):
    depth = 0.6 * 0.03
    model = organ(site, hard)
    end = press(model, site, radius, depth)
    print(f"\n{end.depth * 1e3:.1f} mm, {end.force[-1]:.2f} N (at most {end.force.max():.2f}), {end.fault or 'whole'}")
    check_end(model, end, depth)


def test_a_coupled_press_is_never_silent():
    """The scene's own probe, driven down through the exchange: the step that shows the inverted tet says so."""
    simulation = Simulation(phantom())
    simulation.reset(organ("a node", True), np.array([0.03, 0.03, 0.03 + 0.0085]))
    simulation.instrument.command_velocity(np.array([0.0, 0.0, -SPEED]))
    force: list[float] = []
    for _ in range(700):
        if simulation.instrument.tip_position[2] <= 0.038 - 0.6 * 0.03 or not simulation.haptic_step():
            break
        force.append(float(simulation.contact_force[2]))
    depth = 0.038 - float(simulation.instrument.tip_position[2])
    check_end(
        simulation.organ_model,
        End(depth, simulation.fault, np.array(force), simulation.organ_state, simulation.instrument.tip_position),
        0.6 * 0.03,
    )
    assert depth > 0.008 and force[-1] > 1.0


def test_a_press_right_through_is_a_fault():
    """To 29 of 30 mm: it cannot end well, and says so."""
    model = organ("a node", False)
    end = press(model, "a node", 0.008, 0.029)
    assert end.fault
    check_end(model, end, 0.029)
