"""Organs of the same tets side by side: their structures, and what the single organ's functions see of one lane."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from msdm_core.kernels import ContactShapes, FloatArray, ToolResponse

# In place of a fault: no organ is in this lane, or it is to stand still.
LANE_EMPTY = -1

# float64 or float32, eight or sixteen lanes.
LaneArray = NDArray[Any]


class LaneModel(NamedTuple):
    """What organs side by side are: read-only arrays, SI units; tets are shared, the lane is the last index.

    Rest shapes and anchors are shared too, or each lane's own. Their arrays are then (n, n_lane) in place of (n,), and
    those of surface and supports have the lane as their first index, of which a lane uses as many rows as it has.

    Fields:
        lanes: as many zeros as there are lanes; their number is part of the compiled type
        node_mass: lumped mass [kg]                                              (n_node, n_lane)
        node_inverse_mass: 1 / mass [1/kg], 0 where the node is anchored         (n_node, n_lane)
        spring_nodes: the two nodes of each spring; spring t is tet t's first edge (n_spring, 2)
        spring_stiffness: [N/m]                                                  (n_spring, n_lane)
        spring_rest_length: [m]                                                  (n_spring,) or own
        tet_nodes: corners of each tet                                           (n_tet, 4)
        tet_inverse_volume: 1 / rest volume [1/m^3]                              (n_tet,) or own
        tet_bulk: modulus of the volume term of each tet [Pa]                    (n_tet, n_lane)
        tet_averaged_bulk: what a tet gives to the averaged volume term [Pa]     (n_tet, n_lane)
        node_inverse_volume: 1 / volume averaged at a node [1/m^3]               (n_node,) or own
        node_bulk: modulus of the volume term averaged at nodes [Pa]             (n_node, n_lane)
        averages_volume: whether any node_bulk of the lane is above 0            (n_lane,)
        node_rest_position: undeformed position, of lane 0 if they differ [m]    (n_node, 3)
        surface_triangles: outer triangles an instrument may touch, outward      (n_surface, 3) or own
        surface_rest_area: [m^2]                                                 (n_surface,) or own
        surface_count: how many of them each lane has                            (n_lane,)
        support_nodes, support_area: as in OrganModel                            (n_support_node,) or own
        support_count: how many of them each lane has                            (n_lane,)
        support_kind and the other support_ fields: as in OrganModel
        gravity: [m/s^2]                                                         (3,)
        alpha: mass-proportional damping rate [1/s]                              scalar
        beta: stiffness-proportional damping time [s]                            scalar
        stable_step: largest stable step without contact of instruments [s]      (n_lane,)
    """

    lanes: tuple[int, ...]
    node_mass: LaneArray
    node_inverse_mass: LaneArray
    spring_nodes: NDArray[np.int32]
    spring_stiffness: LaneArray
    spring_rest_length: FloatArray
    tet_nodes: NDArray[np.int32]
    tet_inverse_volume: FloatArray
    tet_bulk: LaneArray
    tet_averaged_bulk: LaneArray
    node_inverse_volume: FloatArray
    node_bulk: LaneArray
    averages_volume: NDArray[np.bool_]
    node_rest_position: FloatArray
    surface_triangles: NDArray[np.int32]
    surface_rest_area: FloatArray
    surface_count: NDArray[np.int32]
    support_kind: NDArray[np.int32]
    support_position: FloatArray
    support_rotation: FloatArray
    support_size: FloatArray
    support_friction: FloatArray
    support_nodes: NDArray[np.int32]
    support_area: FloatArray
    support_count: NDArray[np.int32]
    support_stiffness: float
    support_damping: float
    support_tangential_stiffness: float
    gravity: FloatArray
    alpha: float
    beta: float
    stable_step: FloatArray


class LaneState(NamedTuple):
    """What changes while organs side by side move, SI units.

    Fields:
        node_position: [m]                                                       (n_node, 3, n_lane)
        node_velocity: [m/s]                                                     (n_node, 3, n_lane)
        node_force: force of the last substep, without anchors' reactions [N]    (n_node, 3, n_lane)
        volume_ratio_smallest: smallest V / V0 seen since it was last set to 1   (1, n_lane)
        lane_fault: a FAULT_ code, or LANE_EMPTY; stands still unless FAULT_NONE (n_lane,)
        contact_engaged: 1 where a quadrature point is held off by a shape       (n_lane, n_shape, n_surface * 4)
        contact_stretch: tangential stretch of sticking friction [m]             (n_lane, n_shape, n_surface * 4, 3)
        contact_candidates: scratch: triangles in reach, shape by shape          (n_lane, n_shape, n_surface)
        contact_passed: the shape and the triangle it passed through, after such a fault  (n_lane, 2)
        support_stretch: tangential stretch of nodes that stick to supports [m]  (n_lane, n_support_node, n_support, 3)
        node_tension: scratch: tension of the averaged volume term [Pa]          (n_node, n_lane)
        squeezed_tets: scratch: tets that a lane has squeezed below SQUEEZED_RATIO (n_tet,)
        kept_force: scratch: node_force of the lanes that stand still [N]        (n_node, 3, n_lane)
        moving: scratch: 1 where a lane moves, else 0                            (1, n_lane)
        finite_sum: scratch: finite where a lane's positions and velocities are  (1, n_lane)
        candidate_count: scratch: candidates of the busiest shape                (n_lane,)
        contact_kept: scratch: 0 where the surface passed through an axis        (n_lane,)
        surface_count, support_count: how much of the memory belongs to a lane   (n_lane,)
    """

    node_position: LaneArray
    node_velocity: LaneArray
    node_force: LaneArray
    volume_ratio_smallest: LaneArray
    lane_fault: NDArray[np.int32]
    contact_engaged: NDArray[np.uint8]
    contact_stretch: FloatArray
    contact_candidates: NDArray[np.int32]
    contact_passed: NDArray[np.int32]
    support_stretch: FloatArray
    node_tension: LaneArray
    squeezed_tets: NDArray[np.int32]
    kept_force: LaneArray
    moving: LaneArray
    finite_sum: LaneArray
    candidate_count: NDArray[np.int32]
    contact_kept: NDArray[np.uint8]
    surface_count: NDArray[np.int32]
    support_count: NDArray[np.int32]


class _Surface(NamedTuple):
    """What contact reads of one lane's model."""

    surface_triangles: NDArray[np.int32]
    surface_rest_area: FloatArray
    node_inverse_mass: LaneArray


class _Supports(NamedTuple):
    """What supports read of one lane's model."""

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


class _Touched(NamedTuple):
    """What contact reads and writes of one lane's state."""

    node_position: LaneArray
    node_velocity: LaneArray
    node_force: LaneArray
    contact_engaged: NDArray[np.uint8]
    contact_stretch: FloatArray
    contact_candidates: NDArray[np.int32]
    contact_passed: NDArray[np.int32]


# How many indices an array has is known when these are compiled: one of the two ways is left.


@njit(forceinline=True, error_model="numpy")
def _triangles_of(values, lane, count):
    if values.ndim == 3:
        return values[lane, :count]
    return values


@njit(forceinline=True, error_model="numpy")
def _numbers_of(values, lane, count):
    if values.ndim == 2:
        return values[lane, :count]
    return values


@njit(forceinline=True, error_model="numpy")
def column_of(values, lane):
    """One lane's numbers of an array (n, n_lane), or of all lanes' array (n,)."""
    if values.ndim == 2:
        return values[:, lane]
    return values


@njit(forceinline=True, error_model="numpy")
def surface_of(model, lane):
    """One lane's surface, as contact reads it."""
    count = model.surface_count[lane]
    return _Surface(
        _triangles_of(model.surface_triangles, lane, count), _numbers_of(model.surface_rest_area, lane, count),
        model.node_inverse_mass[:, lane],
    )  # fmt: skip


@njit(forceinline=True, error_model="numpy")
def supports_of(model, lane):
    """What one lane rests on."""
    count = model.support_count[lane]
    return _Supports(
        model.support_kind, model.support_position, model.support_rotation, model.support_size, model.support_friction,
        _numbers_of(model.support_nodes, lane, count), _numbers_of(model.support_area, lane, count),
        model.support_stiffness, model.support_damping, model.support_tangential_stiffness,
    )  # fmt: skip


@njit(forceinline=True, error_model="numpy")
def touched_of(state, lane):
    """One lane's state, as contact reads and writes it."""
    return _Touched(
        state.node_position[:, :, lane], state.node_velocity[:, :, lane], state.node_force[:, :, lane],
        state.contact_engaged[lane], state.contact_stretch[lane], state.contact_candidates[lane],
        state.contact_passed[lane],
    )  # fmt: skip


@njit(forceinline=True, error_model="numpy")
def shapes_of(shapes, lane):
    """One lane's contact shapes."""
    return ContactShapes(
        shapes.shape_ends[lane], shapes.shape_radius[lane], shapes.shape_tool[lane], shapes.tool_centre[lane],
        shapes.tool_twist[lane], shapes.shape_span[lane], shapes.shape_friction[lane],
    )  # fmt: skip


@njit(forceinline=True, error_model="numpy")
def response_of(response, lane):
    """How one lane's tools yield."""
    return ToolResponse(
        response.tool_acceleration[lane], response.tool_mobility[lane], response.tool_wrench[lane],
        response.tool_lag[lane],
    )  # fmt: skip
