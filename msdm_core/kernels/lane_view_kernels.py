"""Views of a single organ in model, state, shapes and tools: all of an organ alone, or the part of a lane.

`lanes` is empty for an organ alone, see `layout_kernels`.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numba.extending import overload
from numpy.typing import NDArray

from msdm_core.kernels.option_kernels import INLINED, INLINED_VIEW, JITABLE
from msdm_core.kernels.structure_kernels import (
    ContactShapes,
    FloatArray,
    LaneArray,
    LaneModel,
    OrganModel,
    ToolResponse,
)


class TissueLaw(NamedTuple):
    """Departures of tissue from linear elasticity in one substep.

    Fields:
        stiffens: True if any node has a factor other than 1
        steepens: True if any node has a steepness above STEEP_EXCESS
        fades: True if the arms relax in this substep
        fade: relative loss of tension of each arm then
    """

    stiffens: bool
    steepens: bool
    fades: bool
    fade: tuple[float, float, float]


class SurfaceView(NamedTuple):
    """Surface of a lane's model, for contact."""

    surface_triangles: NDArray[np.int32]
    surface_rest_area: FloatArray
    surface_around: NDArray[np.int32]
    surface_rise: FloatArray
    node_inverse_mass: LaneArray


class _Supports(NamedTuple):
    """Supports of a lane's model."""

    support_kind: NDArray[np.int32]
    support_position: FloatArray
    support_rotation: FloatArray
    support_size: FloatArray
    support_friction: FloatArray
    support_nodes: NDArray[np.int32]
    support_area: FloatArray
    support_stiffness: float
    support_damping: float
    support_tangential_stiffness: float


class _Ground(NamedTuple):
    """Foundations and motion of the ground of a lane's model."""

    support_position: FloatArray
    foundation_nodes: NDArray[np.int32]
    foundation_position: FloatArray
    foundation_stiffness: FloatArray
    motion_node_shift: LaneArray
    motion_anchored_nodes: NDArray[np.intp]
    motion_foundation_shift: FloatArray
    motion_support_shift: FloatArray


class TouchedView(NamedTuple):
    """Contact's part of a lane's state."""

    node_position: LaneArray
    node_velocity: LaneArray
    node_force: LaneArray
    contact_engaged: NDArray[np.uint8]
    contact_stretch: FloatArray
    contact_candidates: NDArray[np.int32]
    contact_rows: FloatArray
    contact_places: NDArray[np.int32]
    contact_hold: FloatArray
    contact_passed: NDArray[np.int32]


def lanes_of(model: OrganModel | LaneModel) -> tuple[int, ...]:
    """A zero for each organ side by side; none for an organ alone."""
    return model.lanes if isinstance(model, LaneModel) else ()


@overload(lanes_of, jit_options=JITABLE)
def _(model):
    return (lambda model: model.lanes) if model.instance_class is LaneModel else (lambda model: ())


# The length of `lanes` and the dimensions of arrays are known at compile time: a single branch remains.


@njit(**INLINED)
def entry_of(values, lane):
    """Number of a lane in an array (1, n_lane), or of an organ alone in an array (1,)."""
    if values.ndim == 2:
        return values[0, lane]
    return values[lane]


@njit(**INLINED)
def set_entry(values, lane, value):
    """Store for `entry_of`."""
    if values.ndim == 2:
        values[0, lane] = value
    else:
        values[lane] = value


@njit(**INLINED_VIEW)
def column_of(values, lane):
    """Numbers of a lane in an array (n, n_lane), or in an array (n,) of all lanes."""
    if values.ndim == 2:
        return values[:, lane]
    return values


@njit(**INLINED_VIEW)
def part_of(lanes, values, lane):
    """Part of a lane in an array with the lane as first index; an organ alone has the whole array."""
    if len(lanes) == 0:
        return values
    return values[lane]


@njit(**INLINED_VIEW)
def _triangles_of(values, lane, count):
    if values.ndim == 3:
        return values[lane, :count]
    return values


@njit(**INLINED_VIEW)
def _weights_of(values, lane, count):
    if values.ndim == 4:
        return values[lane, :count]
    return values


@njit(**INLINED_VIEW)
def _numbers_of(values, lane, count):
    if values.ndim == 2:
        return values[lane, :count]
    return values


@njit(**INLINED)
def surface_of(lanes, model, lane):
    """Surface of a lane; the OrganModel of an organ alone serves as well."""
    if len(lanes) == 0:
        return model
    count = model.surface_count[lane]
    return SurfaceView(
        _triangles_of(model.surface_triangles, lane, count), _numbers_of(model.surface_rest_area, lane, count),
        _triangles_of(model.surface_around, lane, count), _weights_of(model.surface_rise, lane, count),
        model.node_inverse_mass[:, lane],
    )  # fmt: skip


@njit(**INLINED)
def supports_of(lanes, model, lane):
    """Supports of a lane; the OrganModel of an organ alone serves as well."""
    if len(lanes) == 0:
        return model
    count = model.support_count[lane]
    return _Supports(
        model.support_kind, model.support_position, model.support_rotation, model.support_size, model.support_friction,
        _numbers_of(model.support_nodes, lane, count), _numbers_of(model.support_area, lane, count),
        model.support_stiffness, model.support_damping, model.support_tangential_stiffness,
    )  # fmt: skip


@njit(**INLINED_VIEW)
def _places_of(values, lane):
    if values.ndim == 3:
        return values[lane]
    return values


@njit(**INLINED_VIEW)
def _blocks_of(values, lane):
    if values.ndim == 4:
        return values[lane]
    return values


@njit(**INLINED_VIEW)
def _shifts_of(values, lane):
    if values.ndim == 4:
        return values[:, :, :, lane]
    return values


@njit(**INLINED)
def ground_of(lanes, model, lane):
    """Foundations of a lane and motion of its ground; the OrganModel of an organ alone serves as well."""
    if len(lanes) == 0:
        return model
    return _Ground(
        model.support_position, model.foundation_nodes, _places_of(model.foundation_position, lane),
        _blocks_of(model.foundation_stiffness, lane), _shifts_of(model.motion_node_shift, lane),
        _numbers_of(model.motion_anchored_nodes, lane, model.anchor_count[lane]),
        _blocks_of(model.motion_foundation_shift, lane), model.motion_support_shift,
    )  # fmt: skip


@njit(**INLINED)
def nodes_of(lanes, state):
    """Position, velocity and force for the tissue's kernels: of an organ alone in rows of four."""
    if len(lanes) == 0:
        return state.row_position, state.row_velocity, state.row_force
    return state.node_position, state.node_velocity, state.node_force


@njit(**INLINED)
def touched_of(lanes, state, lane):
    """Contact's part of a lane's state, within a call."""
    if len(lanes) == 0:
        return TouchedView(
            state.row_position, state.row_velocity, state.row_force,
            state.contact_engaged, state.contact_stretch, state.contact_candidates,
            state.contact_rows, state.contact_places, state.contact_hold, state.contact_passed,
        )  # fmt: skip
    room = lane if state.contact_rows.shape[0] > 1 else 0
    return TouchedView(
        state.node_position[:, :, lane], state.node_velocity[:, :, lane], state.node_force[:, :, lane],
        state.contact_engaged[lane], state.contact_stretch[lane], state.contact_candidates[lane],
        state.contact_rows[room], state.contact_places[room], state.contact_hold, state.contact_passed[lane],
    )  # fmt: skip


@njit(**INLINED)
def shapes_of(lanes, shapes, lane):
    """Contact shapes of a lane."""
    if len(lanes) == 0:
        return shapes
    return ContactShapes(
        shapes.shape_ends[lane], shapes.shape_radius[lane], shapes.shape_tool[lane], shapes.tool_centre[lane],
        shapes.tool_twist[lane], shapes.shape_span[lane], shapes.shape_friction[lane], shapes.patch_layout[lane],
        shapes.patch_frame[lane], shapes.taxel_force[lane],
    )  # fmt: skip


@njit(**INLINED)
def response_of(lanes, response, lane):
    """Response of a lane's tools."""
    if len(lanes) == 0:
        return response
    return ToolResponse(
        response.tool_acceleration[lane], response.tool_mobility[lane], response.tool_wrench[lane],
        response.tool_lag[lane],
    )  # fmt: skip
