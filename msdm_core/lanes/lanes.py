"""Organs of one mesh side by side: eight float64 or sixteen float32 advance at once, each as it would alone.

Each organ has a lane of its own, with its own masses, springs, moduli, contact and tools; mesh, anchors, supports,
damping, gravity and the laws by which springs stiffen and relax are shared. With `own_rest` organs of the same tets may
also differ in their rest shape, in what is anchored, and in how foundations hold the same nodes, for a few hundredths
of the time. In float64 an organ moves to the bit as `stepping.advance_organ` moves it, whoever its neighbours.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import exp
from msdm_core.errors import OrganError
from msdm_core.kernels.contact_kernels import PLACE_WIDTH, QUADRATURE_COUNT, ROW_WIDTH
from msdm_core.kernels.structure_kernels import (
    FAULT_NONE,
    LANE_EMPTY,
    ContactLaw,
    ContactShapes,
    LaneModel,
    LaneState,
    OrganModel,
    OrganState,
    ToolResponse,
)
from msdm_core.kernels.substep_kernels import advance_substeps
from msdm_core.kernels.vector_kernels import aligned_zeros, lane_counts
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.compile import rest_state, steep_scratch, support_shape
from msdm_core.organ.stepping import unyielding

NODE_FIELDS = ("node_position", "node_velocity", "node_force")
ARM_FIELDS = ("spring_arm_tension", "spring_relief")
CONTACT_FIELDS = ("contact_engaged", "contact_stretch", "contact_passed", "support_stretch", "motion")
GROUND_FIELDS = ("ground_foundation", "ground_support", "ground_load")

# Of an organ's arrays, those that each lane has of its own; all others are shared.
OWN_FIELDS = (
    *("node_mass", "node_inverse_mass", "spring_stiffness", "tet_bulk", "tet_averaged_bulk", "node_bulk"),
    "node_softness",
)
OWN_NUMBERS = ("averages_volume", "stable_step")
# Fields that follow from the rest shape, shared or each lane's own, those of foundations with the lane as first index;
# and rows of surface, supports and anchored nodes, which depend on the anchors too and of which lanes may have
# different numbers.
REST_FIELDS = ("spring_rest_length", "tet_inverse_volume", "node_inverse_volume", "motion_node_shift")
HELD_FIELDS = ("foundation_position", "foundation_stiffness", "motion_foundation_shift")
ROW_FIELDS = ("surface_triangles", "surface_rest_area", "support_nodes", "support_area", "motion_anchored_nodes")
# The number of rows that a lane has, and a field with that many.
COUNTS = {
    "surface_count": "surface_triangles",
    "support_count": "support_nodes",
    "anchor_count": "motion_anchored_nodes",
}
ALWAYS_SHARED = tuple(
    name
    for name in LaneModel._fields
    if name
    not in (*OWN_FIELDS, *OWN_NUMBERS, *REST_FIELDS, *HELD_FIELDS, *ROW_FIELDS, *COUNTS, "node_rest_position", "lanes")
)
SHARED_REST = (*REST_FIELDS, *HELD_FIELDS, *ROW_FIELDS, "node_rest_position")


def stack_organs(
    organs: Sequence[OrganModel], *, dtype: Any = np.float64, lanes: int | None = None, own_rest: bool = False
) -> LaneModel:
    """Organs of one mesh side by side, in the given order; lanes that are left over have copies of the last one.

    Args:
        organs: at most as many as there are lanes.
        dtype: np.float64 or np.float32.
        lanes: 8 in float64; 16 (the default) or 8 in float32, where two groups on two cores may be worth more.
        own_rest: whether each lane has a rest shape and anchors of its own; all have the same tets in any case.

    Raises:
        OrganError: no organ or too many, another dtype or number of lanes, or an organ that differs from the first in
            what they share: its mesh, anchors, supports, damping or gravity. Names the lane and the field.
    """
    count = lane_count(dtype, lanes)
    if not 1 <= len(organs) <= count:
        raise OrganError(
            f"{len(organs)} organs for the {count} lanes of {np.dtype(dtype)}: stack them in several groups"
        )
    first = organs[0]
    own = {name: aligned_zeros((len(getattr(first, name)), count), dtype) for name in OWN_FIELDS}
    numbers = {"averages_volume": np.zeros(count, dtype=np.bool_), "stable_step": np.zeros(count)}
    shared = {name: getattr(first, name) for name in (*ALWAYS_SHARED, "node_rest_position")}
    if own_rest:
        rest = {name: aligned_zeros((*getattr(first, name).shape, count), dtype) for name in REST_FIELDS}
        rest |= {name: np.zeros((count, *getattr(first, name).shape)) for name in HELD_FIELDS}
        for name, room in surface_rooms(first).items():
            rows = getattr(first, name)
            rest[name] = np.zeros((count, room, *rows.shape[1:]), dtype=rows.dtype)
    else:
        rest = {name: getattr(first, name) for name in (*REST_FIELDS, *HELD_FIELDS, *ROW_FIELDS)}
    counts = {name: np.zeros(count, dtype=np.int32) for name in COUNTS}
    model = LaneModel(lanes=(0,) * count, **own, **numbers, **rest, **counts, **shared)
    for lane in range(count):
        organ = organs[min(lane, len(organs) - 1)]
        _check_shared(model, lane, organ, first.node_inverse_mass == 0.0)
        _write_lane(model, lane, organ)
    return model


def surface_rooms(organ: OrganModel) -> dict[str, int]:
    """The most rows that an organ of these tets can have in each of ROW_FIELDS, for any anchors."""
    faces = np.sort(organ.tet_nodes[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3), axis=1)
    outer, times = np.unique(faces, axis=0, return_counts=True)
    outer = outer[times == 1]
    nodes = len(np.unique(outer)) if len(organ.support_kind) else 0
    anchors = len(organ.node_mass) if len(organ.motion_node_shift) else 0
    return dict(zip(ROW_FIELDS, (len(outer), len(outer), nodes, nodes, anchors), strict=True))


def has_own_rest(model: LaneModel) -> bool:
    """Whether each lane has a rest shape and anchors of its own."""
    return model.surface_triangles.ndim == 3


def same_rest(one: OrganModel, other: OrganModel) -> bool:
    """Whether two organs have the same rest shape and anchors, so that they can share them as lanes."""
    same = all(_equal(getattr(one, name), getattr(other, name)) for name in SHARED_REST)
    return same and np.array_equal(one.node_inverse_mass == 0.0, other.node_inverse_mass == 0.0)


def lane_count(dtype: Any, lanes: int | None) -> int:
    """How many lanes there are, of those that a type has; OrganError for others."""
    if np.dtype(dtype) not in (np.float64, np.float32):
        raise OrganError(f"dtype is {np.dtype(dtype)}; lanes are float64 (8 organs) or float32 (16 or 8 organs)")
    known = lane_counts(dtype)
    if lanes is not None and lanes not in known:
        raise OrganError(f"lanes is {lanes}; in {np.dtype(dtype)} there are {' or '.join(map(str, known))}")
    return known[0] if lanes is None else lanes


def set_lane(model: LaneModel, lane: int, organ: OrganModel) -> None:
    """Put another organ of the same mesh into a lane, as with another lesion; its state is left as it is (`put_lane`).

    With rest shapes of their own, the same tets are enough.

    Raises:
        OrganError: no such lane, or an organ that differs in what the lanes share.
    """
    check_lane(lane, len(model.stable_step))
    _check_shared(model, lane, organ, model.node_inverse_mass[:, lane] == 0.0)
    _write_lane(model, lane, organ)


def _check_shared(model: LaneModel, lane: int, organ: OrganModel, anchored: NDArray[np.bool_]) -> None:
    own = has_own_rest(model)
    differing = _differing(model, organ, ALWAYS_SHARED if own else (*ALWAYS_SHARED, *SHARED_REST), anchored)
    if differing:
        shared = "tets" if own else "mesh, anchors"
        way = "a group of its own" if own else "a group of its own, or stack them with own_rest"
        raise OrganError(
            f"the organ for lane {lane} has another {differing} than its neighbours: organs side by side share "
            f"{shared}, supports, damping, gravity and the laws of their springs; put it into {way}"
        )


def _differing(model: LaneModel, organ: OrganModel, names: Sequence[str], anchored: NDArray[np.bool_]) -> str:
    """The first of some fields in which an organ differs from the lanes, "anchors" if it is they; "" for none."""
    for name in names:
        if not _equal(getattr(model, name), getattr(organ, name)):
            return name
    return "" if has_own_rest(model) or np.array_equal(organ.node_inverse_mass == 0.0, anchored) else "anchors"


def _equal(a: Any, b: Any) -> bool:
    return a is b or np.array_equal(a, b)


def _write_lane(model: LaneModel, lane: int, organ: OrganModel) -> None:
    # Writable for this moment only: a kernel that writes to the model does not compile.
    own = has_own_rest(model)
    for name in (*OWN_FIELDS, *OWN_NUMBERS, *(REST_FIELDS if own else ())):
        _write(getattr(model, name), (..., lane), getattr(organ, name))
    for name in HELD_FIELDS if own else ():
        _write(getattr(model, name), lane, getattr(organ, name))
    for name in ROW_FIELDS if own else ():
        rows = getattr(organ, name)
        _write(getattr(model, name), (lane, slice(len(rows))), rows)
    for name, rows in COUNTS.items():
        _write(getattr(model, name), lane, len(getattr(organ, rows)))


def _write(array: NDArray[Any], place: Any, values: Any) -> None:
    array.setflags(write=True)
    array[place] = values
    array.setflags(write=False)


def check_lane(lane: int, count: int) -> None:
    """OrganError for a lane that does not exist."""
    if not 0 <= lane < count:
        raise OrganError(f"lane {lane} does not exist; there are lanes 0 to {count - 1}")


def rest_lanes(
    organs: Sequence[OrganModel],
    *,
    shape_count: int = 0,
    dtype: Any = np.float64,
    lanes: int | None = None,
    own_rest: bool = False,
) -> LaneState:
    """The state at rest of organs side by side, with contact memory for `shape_count` shapes each.

    Lanes beyond the organs are empty (LANE_EMPTY) and do not move. Under gravity each organ is settled (`rest_state`).
    """
    resting = [rest_state(organ, shape_count=shape_count) for organ in organs]
    return lanes_of(resting, organs[0], dtype=dtype, lanes=lanes, own_rest=own_rest)


def lanes_of(
    states: Sequence[OrganState],
    first: OrganModel,
    *,
    dtype: Any = np.float64,
    lanes: int | None = None,
    own_rest: bool = False,
) -> LaneState:
    """Lanes that start from the states of organs, of which `first` is the first; lanes beyond them are empty."""
    shape_count = len(states[0].contact_engaged)
    count = lane_count(dtype, lanes)
    nodes, surface = len(first.node_mass), len(first.surface_triangles)
    support_nodes, supports, _ = support_shape(first)
    if own_rest:
        rooms = surface_rooms(first)
        surface, support_nodes = rooms["surface_triangles"], rooms["support_nodes"]
    vectors = {name: aligned_zeros((nodes, 3, count), dtype) for name in (*NODE_FIELDS, "kept_force")}
    points = shape_count * surface * QUADRATURE_COUNT
    # Steep springs are held in all lanes at once, between what makes these rows in each lane and what reads them.
    rooms_of_rows = count if first.stiffens else 1
    state = LaneState(
        **vectors,
        volume_ratio_smallest=aligned_zeros((1, count), dtype),
        lane_fault=np.full(count, LANE_EMPTY, dtype=np.int32),
        contact_engaged=np.zeros((count, shape_count, surface * QUADRATURE_COUNT), dtype=np.uint8),
        contact_stretch=np.zeros((count, shape_count, surface * QUADRATURE_COUNT, 3)),
        contact_candidates=np.zeros((count, shape_count, surface), dtype=np.int32),
        contact_rows=np.zeros((rooms_of_rows, points, ROW_WIDTH)),
        contact_places=np.zeros((rooms_of_rows, points, PLACE_WIDTH), dtype=np.int32),
        contact_hold=np.zeros(nodes),
        contact_passed=np.zeros((count, 2), dtype=np.int32),
        support_stretch=np.zeros((count, support_nodes, supports, 3)),
        motion=np.zeros((count, *states[0].motion.shape)),
        **{name: np.stack([getattr(states[0], name)] * count) for name in GROUND_FIELDS},
        ground_rate=aligned_zeros((len(states[0].motion), count), dtype),
        node_tension=aligned_zeros((nodes, count), dtype),
        squeezed_tets=np.zeros(len(first.tet_nodes), dtype=np.int32),
        node_pairs=aligned_zeros((2, len(first.node_softness), count), dtype),
        node_steepness=aligned_zeros((len(first.node_softness), count), dtype),
        spring_lengths=np.zeros(0),
        **steep_scratch(first, (count,), dtype),
        **{name: aligned_zeros((len(getattr(states[0], name)), count), dtype) for name in ARM_FIELDS},
        moving=aligned_zeros((1, count), dtype),
        finite_sum=aligned_zeros((1, count), dtype),
        candidate_count=np.zeros(count, dtype=np.int32),
        contact_kept=np.ones(count, dtype=np.uint8),
        contact_count=np.zeros(count, dtype=np.int32),
        surface_count=np.full(count, surface, dtype=np.int32),
        support_count=np.full(count, support_nodes, dtype=np.int32),
    )
    for lane in range(count):
        put_lane(state, lane, states[min(lane, len(states) - 1)])
    state.lane_fault[len(states) :] = LANE_EMPTY
    return state


def put_lane(state: LaneState, lane: int, organ: OrganState) -> None:
    """Let a lane go on from an organ's state, its fault forgotten; `rest_state(...)` restarts it.

    Raises:
        OrganError: no such lane, or a state of another mesh or of another number of contact shapes.
    """
    check_lane(lane, len(state.lane_fault))
    memory = tuple(getattr(organ, name).shape for name in ("contact_engaged", "support_stretch"))
    lane_memory = tuple(getattr(state, name).shape[1:] for name in ("contact_engaged", "support_stretch"))
    # Lanes with rest shapes of their own have room for the organ with the largest surface.
    shapes, points = memory[0]
    has_room = shapes == lane_memory[0][0] and points <= lane_memory[0][1]
    has_room &= memory[1][0] <= lane_memory[1][0] and memory[1][1:] == lane_memory[1][1:]
    has_room &= organ.motion.shape == state.motion.shape[1:]
    if organ.node_position.shape != state.node_position.shape[:2] or not has_room:
        raise OrganError(
            f"the state has {len(organ.node_position)} nodes, memory of contact and supports {memory} and "
            f"{len(organ.motion)} motions, lane {lane} {len(state.node_position)}, {lane_memory} and "
            f"{state.motion.shape[1]}: make it with rest_state(model, shape_count=...)"
        )
    for name in NODE_FIELDS:
        getattr(state, name)[:, :, lane] = getattr(organ, name)
    for name in ARM_FIELDS:
        getattr(state, name)[:, lane] = getattr(organ, name)
    for name in CONTACT_FIELDS:
        values = getattr(organ, name)
        getattr(state, name)[lane][tuple(slice(length) for length in values.shape)] = values
    # Where nothing moves the ground, no kernel writes it.
    state.ground_foundation[lane] = organ.ground_foundation
    state.surface_count[lane], state.support_count[lane] = points // QUADRATURE_COUNT, len(organ.support_stretch)
    state.volume_ratio_smallest[0, lane] = organ.volume_ratio_smallest[0]
    state.lane_fault[lane] = FAULT_NONE


def get_lane(state: LaneState, lane: int) -> OrganState:
    """A copy of one lane's state as that of an organ alone, in float64: to measure, to save, to describe a fault.

    Raises:
        OrganError: no such lane.
    """
    check_lane(lane, len(state.lane_fault))
    nodes, surface, supports = len(state.node_position), state.surface_count[lane], state.support_count[lane]
    rows = {name: aligned_zeros((nodes, 4)) for name in ("row_position", "row_velocity", "row_force")}
    points = np.s_[:, : surface * QUADRATURE_COUNT]
    return OrganState(
        **{name: np.array(getattr(state, name)[:, :, lane], dtype=np.float64, order="C") for name in NODE_FIELDS},
        **{name: getattr(state, name)[:, lane].astype(np.float64) for name in ARM_FIELDS},
        node_pairs=aligned_zeros((len(state.node_steepness), 2)),
        node_steepness=np.zeros(len(state.node_steepness)),
        spring_lengths=np.zeros(len(state.steep_springs)),
        steep_springs=np.zeros_like(state.steep_springs),
        steep_places=np.zeros_like(state.steep_places),
        steep_rows=np.zeros(state.steep_rows.shape[:-1]),
        steep_speed=np.zeros(state.steep_speed.shape[:-1]),
        contact_engaged=state.contact_engaged[lane][points].copy(),
        contact_stretch=state.contact_stretch[lane][points].copy(),
        contact_passed=state.contact_passed[lane].copy(),
        support_stretch=state.support_stretch[lane, :supports].copy(),
        motion=state.motion[lane].copy(),
        **{name: getattr(state, name)[lane].copy() for name in GROUND_FIELDS},
        ground_rate=np.zeros(state.motion.shape[1]),
        **rows,
        node_tension=np.zeros(nodes),
        squeezed_tets=np.zeros_like(state.squeezed_tets),
        contact_candidates=state.contact_candidates[lane, :, :surface].copy(),
        contact_rows=np.zeros((state.contact_engaged.shape[1] * surface * QUADRATURE_COUNT, ROW_WIDTH)),
        contact_places=np.zeros((state.contact_engaged.shape[1] * surface * QUADRATURE_COUNT, PLACE_WIDTH), np.int32),
        contact_hold=np.zeros(nodes),
        volume_ratio_smallest=state.volume_ratio_smallest[:, lane].astype(np.float64),
        lane_fault=state.lane_fault[lane : lane + 1].copy(),
        moving=np.ones(1),
        finite_sum=np.zeros(1),
        candidate_count=np.zeros(1, dtype=np.int32),
        contact_kept=np.ones(1, dtype=np.uint8),
        contact_count=np.zeros(1, dtype=np.int32),
    )


def stack_shapes(shapes: Sequence[ContactShapes], lanes: int = 8) -> ContactShapes:
    """The contact shapes of several lanes, equally many each, with the lane as first index; the last one fills up.

    `lane_shapes` gives one lane of it to write to.
    """
    filled = [shapes[min(lane, len(shapes) - 1)] for lane in range(lanes)]
    return ContactShapes(*(np.stack(arrays) for arrays in zip(*filled, strict=True)))


def lane_shapes(shapes: ContactShapes, lane: int) -> ContactShapes:
    """One lane of stacked shapes, in place: what is written to it is seen by `advance_lanes`."""
    return ContactShapes(*(array[lane] for array in shapes))


def lane_responses(tool_count: int, lanes: int = 8) -> ToolResponse:
    """The responses of every lane's tools, with the lane as first index; zeros: tools that follow their twist."""
    return ToolResponse(*(np.stack([array] * lanes) for array in unyielding(tool_count)))


def advance_lanes(
    model: LaneModel,
    state: LaneState,
    shapes: ContactShapes,
    contact: ContactLaw,
    dt: float,
    substep_count: int,
    wrench: FloatArray,
    response: ToolResponse | None = None,
) -> NDArray[np.int32]:
    """Advance organs side by side in place by `substep_count` steps of dt [s]: `advance_organ` for each of them.

    Args:
        model: the organs.
        state: their states; lanes whose `lane_fault` is not FAULT_NONE do not change by a bit.
        shapes: every lane's contact shapes, the lane as first index, moved along their twist.
        contact: the contact law of all lanes.
        dt: substep [s]; that it is stable with contact is checked by the caller (`stable_dt`).
        substep_count: how many.
        wrench: receives each lane's mean wrench on its tools [N, N m], shape (n_lane, n_tool, 6).
        response: how tools yield, the lane as first index; None where they follow their twist.

    Returns:
        `state.lane_fault` (n_lane,), a FAULT_ code each: what stopped a lane in this call or before it.

    Raises:
        OrganError: arrays that do not fit the organs, no substep, a dt above an organ's stable step without contact.
    """
    lanes, tools = len(state.lane_fault), shapes.tool_centre.shape[1]
    if response is None:
        response = lane_responses(tools, lanes)
    _check_fit(model, state, shapes, wrench, response)
    limit = float(model.stable_step.min())
    if substep_count < 1 or not 0.0 < dt <= limit:
        slowest = int(np.argmin(model.stable_step))
        raise OrganError(
            f"{substep_count} substeps of {dt:g} s: at least one is needed, above 0 and at most {limit:.4g} s long, "
            f"the stable step of lane {slowest} of {lanes}"
        )
    decay = float(exp(-model.alpha * dt))
    reference = shapes.tool_centre.copy()
    advance_substeps(model, state, shapes, contact, response, dt, decay, substep_count, reference, wrench)
    return state.lane_fault


def _check_fit(
    model: LaneModel, state: LaneState, shapes: ContactShapes, wrench: FloatArray, response: ToolResponse
) -> None:
    """Registers are loaded without looking at an array's bounds: what does not fit must not get there."""
    lanes, count = shapes.shape_radius.shape
    tools = shapes.tool_centre.shape[1]
    nodes, own = len(model.node_mass), int(has_own_rest(model))
    surface, support_nodes = model.surface_triangles.shape[own], model.support_nodes.shape[own]
    fits = {
        "node_position": (state.node_position, (nodes, 3, len(model.lanes))),
        "contact_engaged": (state.contact_engaged, (lanes, count, surface * QUADRATURE_COUNT)),
        "support_stretch": (state.support_stretch, (lanes, support_nodes, len(model.support_kind), 3)),
        "motion": (state.motion, (lanes, len(model.motion_node_shift), 4)),
        "ground_foundation": (state.ground_foundation, (lanes, len(model.foundation_nodes), 3)),
        "ground_support": (state.ground_support, (lanes, len(model.support_kind), 2, 3)),
        "shape_ends": (shapes.shape_ends, (len(state.lane_fault), count, 2, 3)),
        "shape_span": (shapes.shape_span, (lanes, count, 3)),
        "shape_friction": (shapes.shape_friction, (lanes, count)),
        "tool_twist": (shapes.tool_twist, (lanes, tools, 6)),
        "tool_mobility": (response.tool_mobility, (lanes, tools, tools, 6, 6)),
        "wrench": (wrench, (lanes, tools, 6)),
    }
    for name, (array, shape) in fits.items():
        if array.shape != shape:
            raise OrganError(f"{name} has shape {array.shape}; with these organs, shapes and tools it is {shape}")
    for name in ("surface_count", "support_count"):
        if not np.array_equal(getattr(model, name), getattr(state, name)):
            raise OrganError(f"{name} of the lanes' organs and of their states differ: put_lane goes with set_lane")
    if model.node_mass.dtype != state.node_position.dtype:
        raise OrganError(f"the organs are {model.node_mass.dtype}, their states {state.node_position.dtype}")
