"""Stacking organs of one mesh into lanes: which arrays the lanes share, and which each lane has of its own."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.errors import OrganError
from msdm_core.kernels.structure_kernels import LaneModel, OrganModel
from msdm_core.kernels.vector_kernels import aligned_zeros, lane_counts

# Of an organ's arrays, those that each lane has of its own; all others are shared.
OWN_FIELDS = ("node_mass", "node_inverse_mass", "spring_stiffness", "tet_bulk", "tet_averaged_bulk", "node_bulk")
OWN_NUMBERS = ("averages_volume", "stable_step")
# Fields that follow from the rest shape, shared or each lane's own; and the rows of surface and supports, which depend
# on the anchors too and of which lanes may have different numbers.
REST_FIELDS = ("spring_rest_length", "tet_inverse_volume", "node_inverse_volume")
ROW_FIELDS = ("surface_triangles", "surface_rest_area", "support_nodes", "support_area")
COUNTS = ("surface_count", "support_count")
ALWAYS_SHARED = tuple(
    name
    for name in LaneModel._fields
    if name not in (*OWN_FIELDS, *OWN_NUMBERS, *REST_FIELDS, *ROW_FIELDS, *COUNTS, "node_rest_position", "lanes")
)
SHARED_REST = (*REST_FIELDS, *ROW_FIELDS, "node_rest_position")


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
        rest = {name: aligned_zeros((len(getattr(first, name)), count), dtype) for name in REST_FIELDS}
        rest |= {name: _room_for(getattr(first, name), room, count) for name, room in surface_rooms(first).items()}
    else:
        rest = {name: getattr(first, name) for name in (*REST_FIELDS, *ROW_FIELDS)}
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
    return dict(zip(ROW_FIELDS, (len(outer), len(outer), nodes, nodes), strict=True))


def _room_for(rows: NDArray[Any], room: int, lanes: int) -> NDArray[Any]:
    return np.zeros((lanes, room, *rows.shape[1:]), dtype=rows.dtype)


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
            f"{shared}, supports, damping and gravity; put it into {way}"
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
    for name in ROW_FIELDS if own else ():
        rows = getattr(organ, name)
        _write(getattr(model, name), (lane, slice(len(rows))), rows)
    for name, rows in zip(COUNTS, (organ.surface_triangles, organ.support_nodes), strict=True):
        _write(getattr(model, name), lane, len(rows))


def _write(array: NDArray[Any], place: Any, values: Any) -> None:
    array.setflags(write=True)
    array[place] = values
    array.setflags(write=False)


def check_lane(lane: int, count: int) -> None:
    """OrganError for a lane that does not exist."""
    if not 0 <= lane < count:
        raise OrganError(f"lane {lane} does not exist; there are lanes 0 to {count - 1}")
