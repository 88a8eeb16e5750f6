"""Several organs of one mesh side by side in time: their structures, and the compiled loop over substeps.

What `kernels` is for one organ. Springs, volume term and integration work on all organs at once, in
`lane_tissue_kernels`; contact, guard and tools are the single organ's own functions, given views of one organ ("lane")
after the other. An organ that stops, by a fault or because its lane is empty, stands still while its neighbours go on
untouched.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from msdm_core.contact_kernels import add_contact_forces, find_candidates, stretch_by_lag
from msdm_core.guard_kernels import guard_axes
from msdm_core.kernels import (
    FAULT_CONTACT_LOST,
    FAULT_INVERTED_TET,
    FAULT_NONE,
    FAULT_NOT_FINITE,
    ContactShapes,
    FloatArray,
    ToolResponse,
    move_shapes,
    push_tools,
)
from msdm_core.lane_tissue_kernels import (
    add_spring_damping,
    add_spring_forces,
    add_tet_forces,
    add_volume_damping,
    average_volumes,
    integrate,
    put_back,
    set_gravity,
)
from msdm_core.squeeze_kernels import hold_squeezed
from msdm_core.support_kernels import add_support_forces

# In place of a fault: no organ is in this lane, or it is to stand still.
LANE_EMPTY = -1

# float64 or float32, eight or sixteen lanes.
LaneArray = NDArray[Any]


class LaneModel(NamedTuple):
    """What organs side by side are: read-only arrays, SI units; the mesh is shared, the lane is the last index.

    Fields:
        lanes: as many zeros as there are lanes; their number is part of the compiled type
        node_mass: lumped mass [kg]                                              (n_node, n_lane)
        node_inverse_mass: 1 / mass [1/kg], 0 where the node is anchored         (n_node, n_lane)
        spring_nodes: the two nodes of each spring; spring t is tet t's first edge (n_spring, 2)
        spring_stiffness: [N/m]                                                  (n_spring, n_lane)
        spring_rest_length: [m]                                                  (n_spring,)
        tet_nodes: corners of each tet                                           (n_tet, 4)
        tet_inverse_volume: 1 / rest volume [1/m^3]                              (n_tet,)
        tet_bulk: modulus of the volume term of each tet [Pa]                    (n_tet, n_lane)
        tet_averaged_bulk: what a tet gives to the averaged volume term [Pa]     (n_tet, n_lane)
        node_inverse_volume: 1 / volume averaged at a node [1/m^3]               (n_node,)
        node_bulk: modulus of the volume term averaged at nodes [Pa]             (n_node, n_lane)
        averages_volume: whether any node_bulk of the lane is above 0            (n_lane,)
        node_rest_position: undeformed position [m]                              (n_node, 3)
        surface_triangles: outer triangles an instrument may touch, outward      (n_surface, 3)
        surface_rest_area: [m^2]                                                 (n_surface,)
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


class _Surface(NamedTuple):
    """What contact reads of one lane's model."""

    surface_triangles: NDArray[np.int32]
    surface_rest_area: FloatArray
    node_inverse_mass: LaneArray


class _Touched(NamedTuple):
    """What contact reads and writes of one lane's state."""

    node_position: LaneArray
    node_velocity: LaneArray
    node_force: LaneArray
    contact_engaged: NDArray[np.uint8]
    contact_stretch: FloatArray
    contact_candidates: NDArray[np.int32]
    contact_passed: NDArray[np.int32]


@njit(forceinline=True, error_model="numpy")
def _surface_of(model, lane):
    return _Surface(model.surface_triangles, model.surface_rest_area, model.node_inverse_mass[:, lane])


@njit(forceinline=True, error_model="numpy")
def _touched_of(state, lane):
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


@njit(cache=True, nogil=True, error_model="numpy")
def _begin(model, state, shapes, response, duration, wrench):
    """Note who moves, keep the forces of those that do not, and look for the triangles in reach."""
    wrench[:, :, :] = 0.0
    stands = False
    for lane in range(state.lane_fault.shape[0]):
        moves = state.lane_fault[lane] == FAULT_NONE
        state.moving[0, lane] = 1.0 if moves else 0.0
        if not moves:
            stands = True
            continue
        response.tool_wrench[lane, :, :] = 0.0
        response.tool_lag[lane, :, :] = 0.0
        state.candidate_count[lane] = find_candidates(
            _surface_of(model, lane), _touched_of(state, lane), shapes_of(shapes, lane), duration
        )
    if stands:
        state.kept_force[:, :, :] = state.node_force


@njit(cache=True, nogil=True, error_model="numpy")
def _stop(state, lane, fault):
    """Let one lane stand still from now on, as it is."""
    state.lane_fault[lane] = fault
    state.moving[0, lane] = 0.0
    force, kept = state.node_force, state.kept_force
    for node in range(force.shape[0]):
        for axis in range(3):
            kept[node, axis, lane] = force[node, axis, lane]


@njit(cache=True, nogil=True, error_model="numpy")
def _evaluate(model, state):
    """Gravity, springs and volume term of all lanes; returns how many tets are squeezed in one of them."""
    position, velocity, force = state.node_position, state.node_velocity, state.node_force
    lanes, tension, tets, beta = model.lanes, state.node_tension, model.tet_nodes, model.beta
    set_gravity(lanes, force, model.node_mass, model.gravity)
    add_spring_forces(
        model.lanes,
        position,
        force,
        model.spring_nodes,
        model.spring_stiffness,
        model.spring_rest_length,
        tets.shape[0],
    )
    if beta > 0.0:
        add_spring_damping(lanes, position, velocity, force, model.spring_nodes, model.spring_stiffness, beta)
    averages = False
    for lane in range(model.averages_volume.shape[0]):
        averages = averages or model.averages_volume[lane]
    if averages:
        average_volumes(lanes, position, velocity, tension, tets, model.node_inverse_volume, model.node_bulk, beta)
    else:
        tension[:, :] = 0.0
    squeezed_count = add_tet_forces(
        lanes, position, force, tension, tets, model.tet_inverse_volume, model.tet_bulk, model.tet_averaged_bulk,
        model.spring_stiffness, model.spring_rest_length, state.volume_ratio_smallest, state.moving,
        state.squeezed_tets,
    )  # fmt: skip
    if beta > 0.0:
        add_volume_damping(lanes, position, velocity, force, tets, model.tet_inverse_volume, model.tet_bulk, beta)
    return squeezed_count


@njit(cache=True, nogil=True, error_model="numpy")
def _touch(model, state, shapes, law, response, dt, squeezed_count, reference, wrench):
    """Supports, contact, guard and squeezed tets, lane by lane; an inverted tet stops its lane before it moves."""
    for lane in range(state.lane_fault.shape[0]):
        if state.lane_fault[lane] != FAULT_NONE:
            continue
        if not state.volume_ratio_smallest[0, lane] > 0.0:
            _stop(state, lane, FAULT_INVERTED_TET)
            continue
        state.contact_kept[lane] = 1
        count, about, push = state.candidate_count[lane], reference[lane], wrench[lane]
        surface, touched, moved = _surface_of(model, lane), _touched_of(state, lane), shapes_of(shapes, lane)
        add_support_forces(
            model, touched.node_position, touched.node_velocity, touched.node_force, state.support_stretch[lane], dt
        )
        if count == 0 and squeezed_count == 0:
            continue
        add_contact_forces(surface, touched, moved, law, dt, count, about, push)
        if not guard_axes(surface, touched, moved, law, response_of(response, lane), dt, count, about, push):
            state.contact_kept[lane] = 0
        hold_squeezed(
            touched.node_position, touched.node_velocity, touched.node_force, surface.node_inverse_mass,
            model.tet_nodes, model.tet_inverse_volume, model.tet_averaged_bulk[:, lane], state.squeezed_tets,
            squeezed_count, 1, dt,
        )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _move_tools(state, shapes, response, dt, substep, wrench):
    """Tools yield and move, lane by lane; then see which lanes have to stop."""
    for lane in range(state.lane_fault.shape[0]):
        if state.lane_fault[lane] != FAULT_NONE:
            continue
        moved = shapes_of(shapes, lane)
        push_tools(moved, response_of(response, lane), dt, substep, wrench[lane])
        move_shapes(moved, dt)
        if not math.isfinite(state.finite_sum[0, lane]):
            _stop(state, lane, FAULT_NOT_FINITE)
        elif state.contact_kept[lane] == 0:
            _stop(state, lane, FAULT_CONTACT_LOST)


@njit(cache=True, nogil=True, error_model="numpy")
def _end(model, state, shapes, law, response, substep_count, wrench):
    """Mean wrenches and friction's lag of the lanes that move; forces put back where one stands still."""
    stands = False
    for lane in range(state.lane_fault.shape[0]):
        if state.lane_fault[lane] != FAULT_NONE:
            stands = True
            continue
        if law.friction > 0.0:
            stretch_by_lag(
                _surface_of(model, lane), _touched_of(state, lane), shapes_of(shapes, lane),
                response_of(response, lane), state.candidate_count[lane],
            )  # fmt: skip
        for tool in range(wrench.shape[1]):
            for part in range(6):
                wrench[lane, tool, part] /= substep_count
    if stands:
        put_back(model.lanes, state.node_force, state.kept_force, state.moving)


@njit(cache=True, nogil=True, error_model="numpy")
def advance_lane_substeps(model, state, shapes, law, response, dt, decay, substep_count, reference, wrench):
    """Advance organs side by side by some substeps; the kernel behind `lanes.advance_lanes`.

    As `kernels.advance_substeps` does with each of them; shapes, response, reference and wrench have the lane as their
    first index. What a lane ran into stands in `state.lane_fault`; it stops at the substep that showed it, for good.

    Model: model, law, response
    In:    dt [s], decay = exp(-alpha dt), substep_count, reference: point of each torque [m] (n_lane, n_tool, 3)
    Out:   state, shapes (moved), wrench: MEAN force [N] and torque [N m] on each tool (n_lane, n_tool, 6)
    """
    _begin(model, state, shapes, response, dt * substep_count, wrench)
    for substep in range(substep_count):
        squeezed_count = _evaluate(model, state)
        _touch(model, state, shapes, law, response, dt, squeezed_count, reference, wrench)
        integrate(
            model.lanes, state.node_position, state.node_velocity, state.node_force, model.node_inverse_mass, dt, decay,
            state.moving, state.finite_sum,
        )  # fmt: skip
        _move_tools(state, shapes, response, dt, substep, wrench)
    _end(model, state, shapes, law, response, substep_count, wrench)


@njit(cache=True, nogil=True, error_model="numpy")
def evaluate_lane_forces(model, state):
    """Internal forces and gravity of all lanes into `state.node_force` [N], without contact and supports."""
    _evaluate(model, state)
