"""Vectorised organs of one mesh: eight float64 or sixteen float32 side by side, each as it would advance alone.

Each organ has a lane of its own, with its own masses, springs, moduli, contact and tools; mesh, anchors, supports,
damping, gravity and the laws of stiffening and relaxation are shared. With `own_rest` organs of the same tets may also
differ in rest shape, anchored nodes and stiffness of foundations at the same nodes, for a few hundredths of the time.
In float64 an organ moves to the bit as by `stepping.advance_organ`, independent of its neighbours.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.errors import OrganError
from msdm_core.kernels.contact_kernels import QUADRATURE_COUNT
from msdm_core.kernels.structure_kernels import (
    FAULT_NONE,
    KEPT_NAMES,
    LANE_EMPTY,
    MODEL_FIELDS,
    STATE_FIELDS,
    ContactShapes,
    Field,
    LaneModel,
    LaneState,
    OrganModel,
    OrganState,
    ToolResponse,
)
from msdm_core.kernels.vector_kernels import aligned_zeros, lane_counts
from msdm_core.mesh.tet_mesh import outer_faces
from msdm_core.organ.state import field_sizes, state_sizes, zero_state
from msdm_core.organ.stepping import unyielding

SHARED = tuple(field.name for field in MODEL_FIELDS if field.lanes == "shared")
# Fields that follow from the rest shape, shared or each lane's own.
REST = tuple(field.name for layout in ("rest", "rows", "first") for field in MODEL_FIELDS if field.lanes == layout)
# Fields copied into lanes: scratch in rows too, as no kernel writes the places of a resting ground.
PART_FIELDS = tuple(field for field in STATE_FIELDS if field.name in KEPT_NAMES or field.lanes == "rows")
# Numbers of rows in use by a lane, each with a field of that length.
COUNTS = {
    "surface_count": "surface_triangles",
    "support_count": "support_nodes",
    "anchor_count": "motion_anchored_nodes",
}


def stack_organs(
    organs: Sequence[OrganModel], *, dtype: Any = np.float64, lanes: int | None = None, own_rest: bool = False
) -> LaneModel:
    """Organs of one mesh side by side, in the given order; the remaining lanes have copies of the last.

    Args:
        organs: at most one for each lane.
        dtype: np.float64 or np.float32.
        lanes: 8 in float64; 16 (the default) or 8 in float32, for two groups on two cores.
        own_rest: True for a rest shape and anchors of each lane's own; all have the same tets in any case.

    Raises:
        OrganError: no organ or too many, another dtype or number of lanes, or an organ that differs from the first in
            a shared field: mesh, anchors, supports, damping or gravity. Names the lane and the field.
    """
    count = lane_count(dtype, lanes)
    if not 1 <= len(organs) <= count:
        raise OrganError(
            f"{len(organs)} organs for the {count} lanes of {np.dtype(dtype)}: stack them in several groups"
        )
    first = organs[0]
    sizes = field_sizes(MODEL_FIELDS, first) | (surface_rooms(first) if own_rest else {})
    shared = ("shared", "first") if own_rest else ("shared", "first", "rest", "rows")
    model = LaneModel(
        lanes=(0,) * count,
        **{
            field.name: getattr(first, field.name) if field.lanes in shared else _lane_zeros(field, sizes, count, dtype)
            for field in MODEL_FIELDS
            if field.lanes != "alone"
        },
        **{name: np.zeros(count, dtype=np.int32) for name in COUNTS},
    )
    for lane in range(count):
        organ = organs[min(lane, len(organs) - 1)]
        _check_shared(model, lane, organ, first.node_inverse_mass == 0.0)
        _write_lane(model, lane, organ)
    return model


def _lane_zeros(field: Field, sizes: Mapping[int | str, int], lanes: int, dtype: Any) -> NDArray[Any]:
    """Array of a field for a number of lanes, in its layout."""
    lengths = field.lengths(sizes)
    match field.lanes:
        case "own" | "rest":
            return aligned_zeros((*lengths, lanes), dtype if lengths else field.dtype)
        case "halves":
            return aligned_zeros((*lengths[::-1], lanes), dtype)
        case "rows" | "turns":
            return aligned_zeros((lanes, *lengths) if lengths != (1,) else (lanes,), field.dtype)
    return aligned_zeros(lengths, field.dtype)


def surface_rooms(organ: OrganModel) -> dict[int | str, int]:
    """Largest numbers of rows of an organ of these tets with any anchors, by name."""
    outer, _ = outer_faces(organ.tet_nodes)
    return {
        "n_surface": len(outer),
        "n_support_node": len(np.unique(outer)) if len(organ.support_kind) else 0,
        "n_anchored": len(organ.node_mass) if len(organ.motion_node_shift) else 0,
    }


def has_own_rest(model: LaneModel) -> bool:
    """True if each lane has a rest shape and anchors of its own."""
    return model.surface_triangles.ndim == 3


def same_rest(first: OrganModel, second: OrganModel) -> bool:
    """True if two organs have the same rest shape and anchors, which lanes can then share."""
    same = all(_equal(getattr(first, name), getattr(second, name)) for name in REST)
    return same and np.array_equal(first.node_inverse_mass == 0.0, second.node_inverse_mass == 0.0)


def lane_count(dtype: Any, lanes: int | None) -> int:
    """Number of lanes of a type, the largest by default.

    Raises:
        OrganError: another type or number.
    """
    if np.dtype(dtype) not in (np.float64, np.float32):
        raise OrganError(f"dtype is {np.dtype(dtype)}; lanes are float64 (8 organs) or float32 (16 or 8 organs)")
    known = lane_counts(dtype)
    if lanes is not None and lanes not in known:
        raise OrganError(f"lanes is {lanes}; in {np.dtype(dtype)} there are {' or '.join(map(str, known))}")
    return known[0] if lanes is None else lanes


def set_lane(model: LaneModel, lane: int, organ: OrganModel) -> None:
    """Put another organ of the same mesh into a lane, for instance with another lesion; `put_lane` sets its state.

    With rest shapes of the lanes' own, the same tets are enough.

    Raises:
        OrganError: an organ that differs in a shared field.
    """
    _check_shared(model, lane, organ, model.node_inverse_mass[:, lane] == 0.0)
    _write_lane(model, lane, organ)


def _check_shared(model: LaneModel, lane: int, organ: OrganModel, anchored: NDArray[np.bool_]) -> None:
    own = has_own_rest(model)
    differing = _differing(model, organ, SHARED if own else (*SHARED, *REST), anchored)
    if differing:
        shared = "tets" if own else "mesh, anchors"
        way = "a group of its own" if own else "a group of its own, or stack them with own_rest"
        raise OrganError(
            f"the organ for lane {lane} has another {differing} than its neighbours: organs side by side share "
            f"{shared}, supports, damping, gravity and the laws of their springs; put it into {way}"
        )


def _differing(model: LaneModel, organ: OrganModel, names: Sequence[str], anchored: NDArray[np.bool_]) -> str:
    """First field of several in which an organ differs from the lanes, or "anchors"; "" for none."""
    for name in names:
        if not _equal(getattr(model, name), getattr(organ, name)):
            return name
    return "" if has_own_rest(model) or np.array_equal(organ.node_inverse_mass == 0.0, anchored) else "anchors"


def _equal(a: Any, b: Any) -> bool:
    return a is b or np.array_equal(a, b)


def _write_lane(model: LaneModel, lane: int, organ: OrganModel) -> None:
    # Writable for this moment only: a kernel that writes to the model does not compile.
    own_rest = has_own_rest(model)
    for field in MODEL_FIELDS:
        values = getattr(organ, field.name)
        if field.lanes == "own" or (own_rest and field.lanes == "rest"):
            _write(getattr(model, field.name), (..., lane), values)
        elif own_rest and field.lanes == "rows":
            _write(getattr(model, field.name), (lane, slice(len(values))), values)
    for name, rows in COUNTS.items():
        _write(getattr(model, name), lane, len(getattr(organ, rows)))


def _write(array: NDArray[Any], place: Any, values: Any) -> None:
    array.setflags(write=True)
    array[place] = values
    array.setflags(write=False)


def stack_states(
    states: Sequence[OrganState],
    first: OrganModel,
    *,
    dtype: Any = np.float64,
    lanes: int | None = None,
    own_rest: bool = False,
) -> LaneState:
    """Lanes with the states of organs, `first` the first of these; the remaining lanes are empty."""
    count = lane_count(dtype, lanes)
    sizes = field_sizes(MODEL_FIELDS, first) | (surface_rooms(first) if own_rest else {})
    sizes = state_sizes(sizes, shape_count=len(states[0].contact_engaged))
    # Steep springs of all lanes at once come between the writing and the reading of these rows in each lane.
    turns = count if first.stiffens else 1
    state = LaneState(
        **{
            field.name: _lane_zeros(field, sizes, turns if field.lanes == "turns" else count, dtype)
            for field in STATE_FIELDS
            if field.lanes != "alone"
        },
        kept_force=aligned_zeros((*states[0].node_force.shape, count), dtype),
        surface_count=np.zeros(count, dtype=np.int32),
        support_count=np.zeros(count, dtype=np.int32),
    )
    for lane in range(count):
        put_lane(state, lane, states[min(lane, len(states) - 1)])
    state.lane_fault[len(states) :] = LANE_EMPTY
    return state


def _lane_part(field: Field, state: LaneState, lane: int) -> NDArray[Any]:
    """Part of a field's array in use by a lane, in place, shaped as of an organ alone."""
    array = getattr(state, field.name)
    match field.lanes:
        case "own":
            return array[..., lane]
        case "halves":
            return array[..., lane].T
        case "rows":
            return array[lane] if array.ndim > 1 else array[lane : lane + 1]
        case "turns":
            return array[0]
    return array


def put_lane(state: LaneState, lane: int, organ: OrganState) -> None:
    """Set a lane to an organ's state, without fault; `rest_state(...)` restarts it."""
    for field in PART_FIELDS:
        values = getattr(organ, field.name)
        # Lanes with rest shapes of their own have room for the organ with the largest surface.
        _lane_part(field, state, lane)[tuple(map(slice, values.shape))] = values
    state.surface_count[lane] = organ.contact_engaged.shape[1] // QUADRATURE_COUNT
    state.support_count[lane] = len(organ.support_stretch)
    state.lane_fault[lane] = FAULT_NONE


def take_lane(state: LaneState, lane: int, organ: OrganState) -> None:
    """Set an organ's state to that of its lane, in float64; its scratch stays."""
    for field in PART_FIELDS:
        values = getattr(organ, field.name)
        values[...] = _lane_part(field, state, lane)[tuple(map(slice, values.shape))]


def get_lane(state: LaneState, lane: int) -> OrganState:
    """Copy of a lane's state as that of an organ alone, in float64."""
    parts = {field: _lane_part(field, state, lane) for field in STATE_FIELDS if field.lanes != "alone"}
    sizes = field_sizes(parts, parts.values())
    surface, points = state.surface_count[lane], QUADRATURE_COUNT * state.surface_count[lane]
    sizes |= {"n_surface": surface, "n_point": points, "n_row": points * sizes["n_shape"]}
    organ = zero_state(sizes | {"n_support_node": state.support_count[lane]})
    take_lane(state, lane, organ)
    return organ


def stack_shapes(shapes: Sequence[ContactShapes], lanes: int = 8) -> ContactShapes:
    """Contact shapes of several lanes, equally many each, with the lane as first index; the last fill the remainder.

    `lane_shapes` is the writable view of a lane.
    """
    filled = [shapes[min(lane, len(shapes) - 1)] for lane in range(lanes)]
    return ContactShapes(*(np.stack(arrays) for arrays in zip(*filled, strict=True)))


def lane_shapes(shapes: ContactShapes, lane: int) -> ContactShapes:
    """Writable view of a lane in stacked shapes."""
    return ContactShapes(*(array[lane] for array in shapes))


def lane_responses(tool_count: int, lanes: int = 8) -> ToolResponse:
    """Responses of all lanes' tools, with the lane as first index, all 0: tools with a prescribed twist."""
    return ToolResponse(*(np.stack([array] * lanes) for array in unyielding(tool_count)))
