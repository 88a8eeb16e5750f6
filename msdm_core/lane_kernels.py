"""Several organs of the same tets side by side in time: the compiled loop over substeps.

What `kernels` is for one organ. Springs, volume term and integration work on all organs at once, in
`lane_tissue_kernels`; contact, guard and tools are the single organ's own functions, given views of one organ ("lane")
after the other. An organ that stops, by a fault or because its lane is empty, stands still while its neighbours go on
untouched.
"""

import math

from numba import njit

from msdm_core.contact_kernels import add_contact_forces, find_candidates, stretch_by_lag
from msdm_core.guard_kernels import guard_axes
from msdm_core.kernels import (
    FAULT_CONTACT_LOST,
    FAULT_INVERTED_TET,
    FAULT_NONE,
    FAULT_NOT_FINITE,
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
from msdm_core.lane_view_kernels import column_of, response_of, shapes_of, supports_of, surface_of, touched_of
from msdm_core.squeeze_kernels import hold_squeezed
from msdm_core.support_kernels import add_support_forces


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
            surface_of(model, lane), touched_of(state, lane), shapes_of(shapes, lane), duration
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
        surface, touched, moved = surface_of(model, lane), touched_of(state, lane), shapes_of(shapes, lane)
        if model.support_kind.shape[0] > 0:
            add_support_forces(
                supports_of(model, lane), touched.node_position, touched.node_velocity, touched.node_force,
                state.support_stretch[lane], dt,
            )  # fmt: skip
        if count == 0 and squeezed_count == 0:
            continue
        add_contact_forces(surface, touched, moved, law, dt, count, about, push)
        if not guard_axes(surface, touched, moved, law, response_of(response, lane), dt, count, about, push):
            state.contact_kept[lane] = 0
        hold_squeezed(
            touched.node_position, touched.node_velocity, touched.node_force, surface.node_inverse_mass,
            model.tet_nodes, column_of(model.tet_inverse_volume, lane), model.tet_averaged_bulk[:, lane],
            state.squeezed_tets, squeezed_count, 1, dt,
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
                surface_of(model, lane), touched_of(state, lane), shapes_of(shapes, lane),
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
