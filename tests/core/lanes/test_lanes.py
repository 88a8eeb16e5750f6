"""Organs side by side against the same organs alone: every force term, whole presses, float32.

In float64 the two do the same sums in the same order: everything here is equal to the bit, not to a tolerance.
"""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from msdm_core.errors import OrganError
from msdm_core.kernels.structure_kernels import (
    FAULT_NONE,
    KEPT_NAMES,
    LANE_EMPTY,
    ContactLaw,
    ContactShapes,
    LaneModel,
    LaneState,
    OrganModel,
    OrganState,
    ToolResponse,
)
from msdm_core.kernels.substep_kernels import advance_substeps, evaluate_forces
from msdm_core.lanes.lanes import get_lane, lane_responses, lane_shapes, put_lane, set_lane, stack_organs, stack_shapes
from msdm_core.material.regions import Damping
from msdm_core.organ.compile import rest_state
from msdm_core.organ.stepping import advance_organ, unyielding
from tests.allocations import allocations
from tests.core import oracle
from tests.core.lanes.abreast import advance_lanes, rest_lanes

LAW = ContactLaw(stiffness=2e7, damping=500.0, friction=0.4, tangential_stiffness=1e7)
DAMPED = Damping(alpha=20.0, beta=2e-5)
RADIUS = 0.004
SUBSTEP, SUBSTEPS = 5e-5, 5


def same(a: OrganState, b: OrganState) -> list[str]:
    """The fields in which two states differ in any bit (a number that is not one equals itself)."""
    pairs = {name: (getattr(a, name), getattr(b, name)) for name in KEPT_NAMES}
    return [name for name, (left, right) in pairs.items() if left.tobytes() != right.tobytes()]


def varied(base: OrganModel, seed: int) -> OrganModel:
    """The organ with another stiffness of every spring, other moduli of every tet and node, other masses."""
    random = np.random.default_rng(seed)

    def times(values: NDArray, low: float, high: float) -> NDArray:
        return oracle.frozen(values * random.uniform(low, high, len(values)))

    heavier = random.uniform(1.0, 2.0, len(base.node_mass))
    return base._replace(
        node_mass=oracle.frozen(base.node_mass * heavier),
        node_inverse_mass=oracle.frozen(base.node_inverse_mass / heavier),
        spring_stiffness=times(base.spring_stiffness, 0.5, 2.0),
        tet_bulk=times(base.tet_bulk, 0.0, 1.5),
        tet_barrier_bulk=times(base.tet_barrier_bulk, 0.0, 2.0),
        node_bulk=times(base.node_bulk, 0.0, 1.5),
    )


@cache
def pressed_organs(count: int = 8, *, damping: Damping = DAMPED) -> list[OrganModel]:
    """Blocks of 3 x 2 x 2 cm on an anchored base, each of its own moduli."""
    base = oracle.block((0.03, 0.02, 0.02), (6, 4, 4), anchored_below=0.0, damping=damping)
    return [varied(base, seed) for seed in range(count)]


# ---- forces -------------------------------------------------------------------------------------------------------

# What is zero where one term is looked at.
TERMS: dict[str, set[str]] = {
    "springs": {"tet_bulk", "tet_barrier_bulk", "node_bulk"},
    "volume of tets": {"spring_stiffness", "tet_barrier_bulk", "node_bulk"},
    "averaged volume": {"spring_stiffness", "tet_bulk", "tet_barrier_bulk"},
    "squeezed tets": {"spring_stiffness", "tet_bulk", "node_bulk"},
    "all": set(),
}


@pytest.mark.parametrize("gravity", [0.0, 9.81], ids=["", "gravity"])
@pytest.mark.parametrize("beta", [0.0, 1e-3], ids=["", "beta"])
@pytest.mark.parametrize("term", TERMS)
def test_forces_are_those_of_the_organ_alone(term: str, beta: float, gravity: float):
    """f of random organs, each with moduli of its own, in a deformed and moving state; 8 lanes, to the bit."""
    organs, states = [], []
    base = oracle.irregular_organ(7, damping=Damping(alpha=3.0, beta=beta))
    for seed in range(8):
        organ = varied(base, seed)
        # The first organ without averaged volumes, beside others that have them.
        zeroed = {*TERMS[term], "node_bulk"} if seed == 0 and term == "all" else TERMS[term]
        organ = organ._replace(**{name: oracle.frozen(np.zeros_like(getattr(organ, name))) for name in zeroed})
        state = oracle.deformed_state(organ, seed)
        if term in ("squeezed tets", "all"):
            state.node_position[:] *= 0.8  # half the volume
        states.append(state)
        down = oracle.frozen([0.3 * gravity, 0.0, -gravity])
        organs.append(organ._replace(gravity=down, averages_volume=bool(organ.node_bulk.any())))
    model, lanes = stack_organs(organs), rest_lanes([base] * 8)
    for lane, state in enumerate(states):
        put_lane(lanes, lane, state)
    lanes.moving[:] = 1.0
    evaluate_forces(model, lanes)
    for lane, (organ, state) in enumerate(zip(organs, states)):
        evaluate_forces(organ, state)
        assert np.abs(state.node_force).max() > 1e-4
        np.testing.assert_array_equal(get_lane(lanes, lane).node_force, state.node_force, err_msg=f"lane {lane}")
        assert get_lane(lanes, lane).volume_ratio_smallest[0] == state.volume_ratio_smallest[0]


# ---- presses ------------------------------------------------------------------------------------------------------


def tool(lane: int, *, depth: float = 0.0) -> ContactShapes:
    """A capsule and a ball or a rough rounded box on one tool above the block, with a path of their lane's own."""
    centre = np.array([0.012 + 5e-4 * lane, 0.0095 + 2e-4 * lane, 0.02 + RADIUS - depth])
    tilt = np.array([0.004, 0.0, 0.0005 * (lane % 3)])
    ends = [[centre, centre + tilt], [centre - 0.006, centre - 0.006]]
    twist = [4e-3 * (lane % 4 - 1.5), 2e-3 * (lane % 3 - 1), -0.012 - 1e-3 * lane, 0.3 * (lane % 2), 0.2, -0.5]
    span = [[0.0, 0.0, 0.0], [0.0, 0.003 * (lane % 2), 0.001 * (lane % 2)]]
    shapes = oracle.single_tool(ends, [RADIUS, 0.003], centre=centre, twist=twist, span=span)
    shapes.shape_friction[1] = 1.5
    return shapes


def yielding(lane: int = 0) -> ToolResponse:
    """A tool of 60 g and more that accelerates downwards and gives way."""
    response = unyielding(1)
    response.tool_mobility[0] = np.diag([1.0 / (0.06 + 0.01 * lane)] * 3 + [1e4] * 3)
    response.tool_acceleration[0, 2] = -2.0
    return response


def advance_both(organs, steps: int, *, yields: bool, places=None):
    """The same presses alone and side by side; the states, wrenches and shapes of both, and the lanes' faults."""
    places = range(len(organs)) if places is None else places
    alone = [rest_state(organ, shape_count=2) for organ in organs]
    tools = [tool(place) for place in places]
    responses = [yielding(place) if yields else unyielding(1) for place in places]
    wrench = np.zeros((len(organs), 1, 6))
    model, state = stack_organs(organs), rest_lanes(organs, shape_count=2)
    shapes, together = stack_shapes(tools), lane_responses(1)
    for lane, response in enumerate(responses):
        together.tool_mobility[lane] = response.tool_mobility
        together.tool_acceleration[lane] = response.tool_acceleration
    lane_wrench = np.zeros((8, 1, 6))
    for count in range(steps):
        for lane, organ in enumerate(organs):
            fault = advance_organ(
                organ, alone[lane], tools[lane], LAW, SUBSTEP, SUBSTEPS, wrench[lane], responses[lane]
            )
            assert fault == FAULT_NONE
        faults = advance_lanes(model, state, shapes, LAW, SUBSTEP, SUBSTEPS, lane_wrench, together)
        assert not faults[: len(organs)].any(), f"step {count}: {faults}"
        assert lane_wrench[: len(organs)].tobytes() == wrench.tobytes(), f"step {count}"
        assert not lane_wrench[len(organs) :].any()
    return alone, tools, wrench, state, shapes


@pytest.mark.parametrize("yields", [False, True], ids=["tools as told", "yielding tools"])
def test_a_press_is_that_of_the_organ_alone(yields: bool):
    """400 haptic steps of contact, friction, damping, two shapes a tool, a path a lane: wrench and state to the bit."""
    organs = pressed_organs()
    alone, tools, wrench, state, shapes = advance_both(organs, 400, yields=yields)
    assert (np.abs(wrench[:, 0, 2]) > 5e-3).all(), "every lane is pressed"
    assert len(np.unique(wrench[:, 0, 2])) == 8
    for lane, single in enumerate(alone):
        assert single.contact_engaged.any() and single.contact_stretch.any()
        assert same(get_lane(state, lane), single) == []
        for name, array in lane_shapes(shapes, lane)._asdict().items():
            assert array.tobytes() == getattr(tools[lane], name).tobytes(), name


def guard_pushes(organ: OrganModel, state: OrganState, ball: ContactShapes) -> bool:
    """True if any triangle is within the guard's reach of a ball's centre."""
    corners = state.node_position[organ.surface_triangles]
    near = np.linalg.norm(corners.mean(axis=1) - ball.tool_centre[0], axis=1) < 0.006
    for triangle in corners[near]:
        normal = np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
        radius = float(ball.shape_radius[0])
        normal /= np.linalg.norm(normal)
        if oracle.guard_energy(ball.shape_ends[0], radius, triangle, normal, LAW.stiffness) > 0.0:
            return True
    return False


@pytest.mark.slow
def test_the_guard_is_that_of_the_organ_alone():
    """Balls so small that the guard takes over, pressed until it pushes in every lane: wrench and state to the bit."""
    organs = pressed_organs()
    balls = [oracle.ball((0.0112 + 3e-4 * i, 0.0108, 0.0215), 0.0015, velocity=(0.0, 0.0, -0.02)) for i in range(8)]
    alone = [rest_state(organ, shape_count=1) for organ in organs]
    model, state, shapes = stack_organs(organs), rest_lanes(organs, shape_count=1), stack_shapes(balls)
    wrench, lane_wrench = np.zeros((8, 1, 6)), np.zeros((8, 1, 6))
    pushed = np.zeros(8, dtype=bool)
    for step in range(900):
        faults = [
            advance_organ(organ, single, ball, LAW, SUBSTEP, SUBSTEPS, into)
            for organ, single, ball, into in zip(organs, alone, balls, wrench, strict=True)
        ]
        lane_faults = advance_lanes(model, state, shapes, LAW, SUBSTEP, SUBSTEPS, lane_wrench)
        assert not any(faults) and not lane_faults.any(), f"step {step}: {faults} {lane_faults}"
        assert lane_wrench.tobytes() == wrench.tobytes(), f"step {step}"
        if step % 20 == 0:
            pushed |= [guard_pushes(*given) for given in zip(organs, alone, balls, strict=True)]
    assert pushed.all()
    for lane, single in enumerate(alone):
        assert same(get_lane(state, lane), single) == []


def test_a_lane_does_not_depend_on_its_place_or_its_neighbours():
    """Organ and tool 5 alone in a group, in another place, and among seven others: the same bits."""
    organs = pressed_organs()
    among = get_lane(advance_both(organs, 150, yields=True)[3], 5)
    lonely = get_lane(advance_both([organs[5]], 150, yields=True, places=[5])[3], 0)
    moved = get_lane(advance_both([organs[2], organs[0], organs[5]], 150, yields=True, places=[0, 6, 5])[3], 2)
    assert among.contact_engaged.any()
    assert same(lonely, among) == [] and same(moved, among) == []


def pressing(organs) -> tuple[LaneModel, LaneState, ContactShapes, ToolResponse, NDArray]:
    """Organs side by side, 100 haptic steps into a press with yielding tools."""
    model, state = stack_organs(organs), rest_lanes(organs, shape_count=2)
    shapes, response, wrench = stack_shapes([tool(lane) for lane in range(8)]), lane_responses(1), np.zeros((8, 1, 6))
    response.tool_mobility[:] = yielding().tool_mobility
    for _ in range(100):
        assert not advance_lanes(model, state, shapes, LAW, SUBSTEP, SUBSTEPS, wrench, response).any()
    return model, state, shapes, response, wrench


# ---- float32 ------------------------------------------------------------------------------------------------------


def contact_forces(organs: list[OrganModel], dtype: type) -> np.ndarray:
    """Contact force over a press and its release, of the first eight lanes [N], shape (n_step, 8, 3)."""
    count, rows = len(organs), []
    model = stack_organs(organs, dtype=dtype, lanes=count)
    state = rest_lanes(organs, shape_count=2, dtype=dtype, lanes=count)
    shapes, wrench = stack_shapes([tool(lane % 8) for lane in range(count)], count), np.zeros((count, 1, 6))
    for step in range(900):
        if step == 500:
            shapes.tool_twist[:] *= -1.0
        assert not advance_lanes(model, state, shapes, LAW, SUBSTEP, SUBSTEPS, wrench).any()
        rows.append(wrench[:8, 0, :3].copy())
    assert get_lane(state, 0).node_position.dtype == np.float64
    return np.array(rows)


def test_float32_presses_like_float64():
    """Over a whole press and its release the contact force is within 0.5 % of the largest of float64."""
    organs = pressed_organs(8)
    single, exact = contact_forces(organs, np.float32), contact_forces(organs, np.float64)
    largest = np.linalg.norm(exact, axis=2).max(axis=0)
    error = np.linalg.norm(single - exact, axis=2).max(axis=0) / largest
    print(f"\nfloat32 against float64: contact force differs by at most {error.max():.1e} of its largest value")
    assert (largest > 0.05).all()
    assert error.max() < 0.005


# ---- what is asked and refused -------------------------------------------------------------------------------------


@pytest.mark.parametrize("substeps", [1, 50])
def test_the_loop_allocates_nothing(substeps: int):
    """With contact and the guard."""
    model, state, shapes, response, wrench = pressing(pressed_organs())
    reference = shapes.tool_centre.copy()
    given = (model, state, shapes, LAW, response, SUBSTEP, 1.0, substeps, reference, wrench)
    advance_substeps(*given)
    assert allocations(advance_substeps, *given) == 0
    assert state.contact_engaged.any(axis=(1, 2)).all() and not state.lane_fault.any()


def test_left_over_lanes_stand_still():
    organs = pressed_organs()[:3]
    state = rest_lanes(organs, shape_count=2)
    assert state.lane_fault.tolist() == [0, 0, 0] + [LANE_EMPTY] * 5
    shapes = stack_shapes([tool(lane, depth=0.001) for lane in range(3)])
    before = shapes.shape_ends.copy()
    wrench = np.ones((8, 1, 6))
    advance_lanes(stack_organs(organs), state, shapes, LAW, SUBSTEP, SUBSTEPS, wrench)
    assert wrench[:3].any(axis=(1, 2)).all() and not wrench[3:].any()
    assert (shapes.shape_ends[:3] != before[:3]).any() and (shapes.shape_ends[3:] == before[3:]).all()
    assert same(get_lane(state, 5), rest_state(organs[2], shape_count=2)) == []


def test_only_organs_that_share_a_mesh_stand_side_by_side():
    organs = pressed_organs()
    base = organs[0]
    mass = base.node_inverse_mass.copy()
    mass[np.argmax(mass)] = 0.0
    others = {
        "alpha": base._replace(alpha=1.0),
        "gravity": base._replace(gravity=oracle.frozen([0.0, 0.0, -9.81])),
        "spring_nodes": oracle.block((0.03, 0.02, 0.02), (3, 2, 2), anchored_below=0.0, damping=DAMPED),
        "anchors": base._replace(node_inverse_mass=oracle.frozen(mass)),
    }
    model = stack_organs(organs[:2])
    for field, other in others.items():
        with pytest.raises(OrganError, match=rf"lane 1 .*{field}"):
            stack_organs([base, other])
        with pytest.raises(OrganError, match=rf"lane 6 .*{field}"):
            set_lane(model, 6, other)
    with pytest.raises(OrganError, match="9"):
        stack_organs([base] * 9)
    with pytest.raises(OrganError, match="16"):
        stack_organs([base], lanes=16)
