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

from msdm_core.errors import OrganError
from msdm_core.kernels.contact_kernels import PLACE_WIDTH, QUADRATURE_COUNT, ROW_WIDTH
from msdm_core.kernels.structure_kernels import (
    FAULT_NONE,
    LANE_COLUMNS,
    LANE_EMPTY,
    LANE_NUMBERS,
    LANE_ROWS,
    LANE_SHARED,
    SCRATCH_FIELDS,
    ContactShapes,
    LaneModel,
    LaneState,
    OrganModel,
    OrganState,
    ToolResponse,
)
from msdm_core.kernels.vector_kernels import aligned_zeros, lane_counts
from msdm_core.organ.compile import blank_state
from msdm_core.organ.stepping import unyielding

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
        OrganError: an organ that differs in what the lanes share.
    """
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


def lanes_of(
    states: Sequence[OrganState],
    first: OrganModel,
    *,
    dtype: Any = np.float64,
    lanes: int | None = None,
    own_rest: bool = False,
) -> LaneState:
    """Lanes that start from the states of organs, of which `first` is the first; lanes beyond them are empty."""
    count = lane_count(dtype, lanes)
    if own_rest:
        rooms = surface_rooms(first)
        first = first._replace(
            surface_triangles=np.zeros((rooms["surface_triangles"], 3), dtype=np.int32),
            support_nodes=np.zeros(rooms["support_nodes"], dtype=np.int32),
        )
    blank = blank_state(first, shape_count=len(states[0].contact_engaged))
    # Steep springs are held in all lanes at once, between what makes these rows in each lane and what reads them.
    rooms_of_rows = count if first.stiffens else 1
    state = LaneState(
        **{name: aligned_zeros((*getattr(blank, name).shape, count), dtype) for name in LANE_COLUMNS},
        **{name: np.stack([getattr(blank, name)] * count) for name in LANE_ROWS},
        **{name: np.repeat(getattr(blank, name), count) for name in LANE_NUMBERS},
        **{name: getattr(blank, name) for name in LANE_SHARED},
        node_pairs=aligned_zeros((2, len(first.node_softness), count), dtype),
        contact_rows=np.stack([blank.contact_rows] * rooms_of_rows),
        contact_places=np.stack([blank.contact_places] * rooms_of_rows),
        kept_force=aligned_zeros((*blank.node_force.shape, count), dtype),
        surface_count=np.full(count, len(first.surface_triangles), dtype=np.int32),
        support_count=np.full(count, len(first.support_nodes), dtype=np.int32),
    )
    for lane in range(count):
        put_lane(state, lane, states[min(lane, len(states) - 1)])
    state.lane_fault[len(states) :] = LANE_EMPTY
    return state


def put_lane(state: LaneState, lane: int, organ: OrganState) -> None:
    """Let a lane go on from an organ's state, its fault forgotten; `rest_state(...)` restarts it."""
    for name in LANE_COLUMNS:
        if name not in SCRATCH_FIELDS:
            getattr(state, name)[..., lane] = getattr(organ, name)
    for name in LANE_ROWS:
        # Where nothing moves the ground, no kernel writes where foundations hold nodes.
        if name not in SCRATCH_FIELDS or name == "ground_foundation":
            values = getattr(organ, name)
            # Lanes with rest shapes of their own have room for the organ with the largest surface.
            getattr(state, name)[lane][tuple(slice(length) for length in values.shape)] = values
    state.surface_count[lane] = organ.contact_engaged.shape[1] // QUADRATURE_COUNT
    state.support_count[lane] = len(organ.support_stretch)
    state.lane_fault[lane] = FAULT_NONE


def get_lane(state: LaneState, lane: int) -> OrganState:
    """A copy of one lane's state as that of an organ alone, in float64: to measure, to save, to describe a fault."""
    nodes, surface, supports = len(state.node_position), state.surface_count[lane], state.support_count[lane]
    points = surface * QUADRATURE_COUNT
    columns = {name: getattr(state, name)[..., lane] for name in LANE_COLUMNS}
    rows = {name: getattr(state, name)[lane] for name in LANE_ROWS}
    for name, length in (("contact_engaged", points), ("contact_stretch", points), ("contact_candidates", surface)):
        rows[name] = rows[name][:, :length]
    rows["support_stretch"] = rows["support_stretch"][:supports]
    row_count = len(rows["contact_engaged"]) * points
    return OrganState(
        **{
            name: np.zeros(values.shape) if name in SCRATCH_FIELDS else np.array(values, dtype=np.float64, order="C")
            for name, values in columns.items()
        },
        **{name: values.copy() for name, values in rows.items()},
        **{name: getattr(state, name)[lane : lane + 1].copy() for name in LANE_NUMBERS},
        **{name: np.zeros_like(getattr(state, name)) for name in LANE_SHARED},
        **{name: aligned_zeros((nodes, 4)) for name in ("row_position", "row_velocity", "row_force")},
        node_pairs=aligned_zeros((len(state.node_steepness), 2)),
        contact_rows=np.zeros((row_count, ROW_WIDTH)),
        contact_places=np.zeros((row_count, PLACE_WIDTH), dtype=np.int32),
    )


def stack_shapes(shapes: Sequence[ContactShapes], lanes: int = 8) -> ContactShapes:
    """The contact shapes of several lanes, equally many each, with the lane as first index; the last one fills up.

    `lane_shapes` gives one lane of it to write to.
    """
    filled = [shapes[min(lane, len(shapes) - 1)] for lane in range(lanes)]
    return ContactShapes(*(np.stack(arrays) for arrays in zip(*filled, strict=True)))


def lane_shapes(shapes: ContactShapes, lane: int) -> ContactShapes:
    """One lane of stacked shapes, in place: what is written to it is seen by the kernels."""
    return ContactShapes(*(array[lane] for array in shapes))


def lane_responses(tool_count: int, lanes: int = 8) -> ToolResponse:
    """The responses of every lane's tools, with the lane as first index; zeros: tools that follow their twist."""
    return ToolResponse(*(np.stack([array] * lanes) for array in unyielding(tool_count)))
