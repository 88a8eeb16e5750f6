"""The substep: the sequence of forces, integration and tools, for an organ alone and for organs side by side.

The type of the model decides between the two at compile time: `lanes` is empty for an `OrganModel`. Springs, volume
term and integration work on all lanes at once (`tissue_kernels`); supports, contact, guard and tools on the lanes in
turn. A stopped organ (after a fault, or an empty lane) does not affect the lanes beside it. Kernels work in place,
allocate nothing and use no fastmath: a run repeats to the bit.
"""

import math

from numba import njit

from msdm_core.kernels.contact_kernels import (
    add_contact_forces,
    end_of,
    find_candidates,
    hold_contact,
    stretch_by_lag,
    tool_velocity,
)
from msdm_core.kernels.element_kernels import faded_share
from msdm_core.kernels.guard_kernels import guard_axes
from msdm_core.kernels.lane_view_kernels import (
    TissueLaw,
    column_of,
    entry_of,
    ground_of,
    lanes_of,
    nodes_of,
    part_of,
    response_of,
    set_entry,
    shapes_of,
    supports_of,
    surface_of,
    touched_of,
)
from msdm_core.kernels.layout_kernels import group_width, load_part, store_part
from msdm_core.kernels.option_kernels import INLINED, INNER, KERNEL
from msdm_core.kernels.space_kernels import add_to_row, part_of_row, row_of, times, vector_product
from msdm_core.kernels.squeeze_kernels import SWEEPS_LEAST, hold_squeezed, hold_steep
from msdm_core.kernels.structure_kernels import (
    FAULT_CONTACT_LOST,
    FAULT_INVERTED_TET,
    FAULT_NONE,
    FAULT_NOT_FINITE,
)
from msdm_core.kernels.support_kernels import (
    add_foundation_forces,
    add_support_forces,
    carry_anchors,
    drag_along,
    move_ground,
    place_ground,
)
from msdm_core.kernels.taxel_kernels import add_taxel_forces
from msdm_core.kernels.tissue_kernels import (
    add_energies,
    add_spring_damping,
    add_spring_forces,
    add_tet_forces,
    add_volume_damping,
    add_volume_rates,
    integrate,
    put_back,
    set_gravity,
    set_node_laws,
    set_node_tension,
    sum_at_nodes,
)

# Interval of the relaxation of Maxwell arms [s]: no longer than their shortest time, usually much shorter.
FADE_INTERVAL = 1e-3


@njit(**INNER)
def move_shapes(shapes, dt):
    """Move the shapes along the twist of their tool for one substep: x <- x + dt (v + w x (x - c)).

    In:  dt [s], shapes: tool_twist [m/s, rad/s] (n_tool, 6), shape_tool (n_shape,)
    Out: shapes: shape_ends [m] (n_shape, 2, 3), shape_span [m] (n_shape, 3), tool_centre [m] (n_tool, 3)
    """
    twist, spans = shapes.tool_twist, shapes.shape_span
    for shape in range(shapes.shape_radius.shape[0]):
        tool = shapes.shape_tool[shape]
        for end in range(2):
            speed = tool_velocity(shapes, tool, end_of(shapes, shape, end))
            add_to_row(shapes.shape_ends[shape], end, times(dt, speed))
        turning = vector_product(part_of_row(twist, tool, 3), row_of(spans, shape))
        add_to_row(spans, shape, times(dt, turning))
    for tool in range(shapes.tool_centre.shape[0]):
        add_to_row(shapes.tool_centre, tool, times(dt, row_of(twist, tool)))


@njit(**INNER)
def push_tools(shapes, response, dt, substep, wrench):
    """Change the tools' twists by the wrench of a substep, before the shapes move along them: twist += dt (a + B w).

    In:  dt [s], substep: its number, wrench: sum of the substeps' wrenches so far [N, N m] (n_tool, 6)
    Out: shapes: tool_twist [m/s, rad/s] (n_tool, 6), response: tool_wrench [N, N m], tool_lag [m, rad] (n_tool, 6)
    """
    twist, before, lag = shapes.tool_twist, response.tool_wrench, response.tool_lag
    acceleration, mobility = response.tool_acceleration, response.tool_mobility
    for tool in range(twist.shape[0]):
        for row in range(6):
            rate = acceleration[tool, row]
            for other in range(twist.shape[0]):
                for column in range(6):
                    rate += mobility[tool, other, row, column] * (wrench[other, column] - before[other, column])
            twist[tool, row] += dt * rate
            lag[tool, row] += dt * dt * substep * rate
    for tool in range(twist.shape[0]):
        for row in range(6):
            before[tool, row] = wrench[tool, row]


@njit(**INNER)
def _copy_rows(source, target):
    """Copy the first three columns of an array."""
    for node in range(source.shape[0]):
        for axis in range(3):
            target[node, axis] = source[node, axis]


@njit(**INLINED)
def _load_rows(lanes, state):
    """Copy positions and velocities of an organ alone into its rows of four."""
    if len(lanes) == 0:
        _copy_rows(state.node_position, state.row_position)
        _copy_rows(state.node_velocity, state.row_velocity)


@njit(**INLINED)
def _averages(lanes, averages_volume):
    """True if any lane has an averaged volume term."""
    if len(lanes) == 0:
        return averages_volume
    return averages_volume.any()


@njit(**INNER)
def _evaluate(model, state, fades, fade_duration):
    """Set the force of all lanes to gravity, springs and volume term.

    In: fades: True if the arms of springs relax, for fade_duration [s]
    Returns the number of entries in `squeezed_tets` and `steep_springs`.
    """
    fade = (0.0, 0.0, 0.0)
    if fades:
        time = model.arm_time
        fade = (
            faded_share(fade_duration, time[0]), faded_share(fade_duration, time[1]),
            faded_share(fade_duration, time[2]),
        )  # fmt: skip
    lanes, beta = lanes_of(model), model.beta
    averages, stiffens, steepens = _averages(lanes, model.averages_volume), model.stiffens, False
    if stiffens:
        state.node_pairs[:] = 0.0
    else:
        state.node_tension[:] = 0.0
    if averages or stiffens:
        sum_at_nodes(lanes, model, state)
    law = TissueLaw(stiffens, steepens, fades, fade)
    if stiffens:
        add_energies(lanes, model, state)
        stiffens, steepens = set_node_laws(lanes, model, state, law)
        law = TissueLaw(stiffens, steepens, fades, fade)
    elif averages:
        set_node_tension(lanes, model, state, law)
    if averages and beta > 0.0:
        add_volume_rates(lanes, model, state)
    set_gravity(lanes, model, state)
    steep_count = add_spring_forces(lanes, model, state, law)
    if beta > 0.0:
        add_spring_damping(lanes, model, state)
    squeezed_count, steep_count = add_tet_forces(lanes, model, state, law, steep_count)
    if beta > 0.0:
        add_volume_damping(lanes, model, state)
    return squeezed_count, steep_count


@njit(**INLINED)
def _lane_count(lanes):
    """Number of organs."""
    if len(lanes) == 0:
        return 1
    return len(lanes)


@njit(**INLINED)
def _wake(lanes, state):
    """Clear the fault of an organ alone at the start of a call; a lane keeps its fault until `put_lane`."""
    if len(lanes) == 0:
        state.lane_fault[0] = FAULT_NONE


@njit(**INLINED)
def _keep_forces(lanes, state):
    """Keep the forces of stopped lanes: the tissue's kernels overwrite them."""
    if len(lanes) > 0:
        for part in range(3 * state.node_force.shape[0]):
            store_part(lanes, state.kept_force, part, load_part(lanes, state.node_force, part))


@njit(**INLINED)
def _put_back_forces(lanes, state):
    """Restore the forces of stopped lanes."""
    if len(lanes) > 0:
        put_back(lanes, state)


@njit(**INLINED)
def _store_motion(lanes, state):
    """Copy positions and velocities of an organ alone from its rows of four."""
    if len(lanes) == 0:
        _copy_rows(state.row_position, state.node_position)
        _copy_rows(state.row_velocity, state.node_velocity)


@njit(**INLINED)
def _store_force(lanes, state):
    """Copy forces of an organ alone from its rows of four."""
    if len(lanes) == 0:
        _copy_rows(state.row_force, state.node_force)


@njit(**INNER)
def _keep_force(state, lane):
    """Keep the forces of a lane."""
    force, kept = state.node_force, state.kept_force
    for node in range(force.shape[0]):
        for axis in range(3):
            kept[node, axis, lane] = force[node, axis, lane]


@njit(**INLINED)
def _stop(lanes, state, lane, fault):
    """Stop a lane in its present state."""
    state.lane_fault[lane] = fault
    set_entry(state.moving, lane, 0.0)
    if len(lanes) > 0:
        _keep_force(state, lane)


@njit(**INLINED)
def _begin(lanes, model, state, shapes, response, duration):
    """Set the moving lanes, their ground and the candidate triangles of their shapes."""
    stands = False
    for lane in range(_lane_count(lanes)):
        if state.lane_fault[lane] != FAULT_NONE:
            set_entry(state.moving, lane, 0.0)
            stands = True
            continue
        set_entry(state.moving, lane, 1.0)
        if model.motion_node_shift.shape[0] > 0:
            motion = part_of(lanes, state.motion, lane)
            for number in range(motion.shape[0]):
                column_of(state.ground_rate, lane)[number] = motion[number, 1]
            ground = ground_of(lanes, model, lane)
            carry_anchors(ground, motion, touched_of(lanes, state, lane).node_velocity)
            place_ground(
                ground,
                motion,
                part_of(lanes, state.ground_foundation, lane),
                part_of(lanes, state.ground_support, lane),
            )
        answer = response_of(lanes, response, lane)
        answer.tool_wrench[:, :] = 0.0
        answer.tool_lag[:, :] = 0.0
        part_of(lanes, shapes.taxel_force, lane)[:, :] = 0.0
        state.candidate_count[lane] = find_candidates(
            surface_of(lanes, model, lane), touched_of(lanes, state, lane), shapes_of(lanes, shapes, lane), duration
        )
    if stands:
        _keep_forces(lanes, state)


@njit(**INLINED)
def _push_apart(lanes, model, state, shapes, law, response, dt, reference, wrench, lane):
    """Contact and guard of a lane; sets its number of points in contact."""
    surface, touched = surface_of(lanes, model, lane), touched_of(lanes, state, lane)
    moved, count = shapes_of(lanes, shapes, lane), state.candidate_count[lane]
    about, push = part_of(lanes, reference, lane), part_of(lanes, wrench, lane)
    state.contact_count[lane] = add_contact_forces(surface, touched, moved, law, dt, count, about, push)
    answer = response_of(lanes, response, lane)
    if not guard_axes(surface, touched, moved, law, answer, dt, count, about, push):
        state.contact_kept[lane] = 0


@njit(**INLINED)
def _hold(lanes, model, state, shapes, law, dt, decay, squeezed_count, reference, wrench, lane):
    """Implicit contact, taxels and squeezed tets of a lane."""
    surface, touched, moved = (
        surface_of(lanes, model, lane),
        touched_of(lanes, state, lane),
        shapes_of(lanes, shapes, lane),
    )
    hold_contact(
        surface, touched, moved, law, dt, decay, state.contact_count[lane], part_of(lanes, reference, lane),
        part_of(lanes, wrench, lane),
    )  # fmt: skip
    if moved.patch_layout.shape[0] > 0:
        add_taxel_forces(touched, moved, law, state.contact_count[lane])
    hold_squeezed(
        touched.node_position, touched.node_velocity, touched.node_force, surface.node_inverse_mass, model.tet_nodes,
        column_of(model.tet_inverse_volume, lane), column_of(model.tet_barrier_bulk, lane),
        state.squeezed_tets, squeezed_count, group_width(lanes), dt,
    )  # fmt: skip


@njit(**INLINED)
def _touch(lanes, model, state, shapes, law, response, dt, decay, squeezed_count, steep_count, reference, wrench):
    """Supports, contact, guard, steep springs and squeezed tets, lane by lane; returns the number of moving lanes.

    Steep springs are integrated in all lanes at once, in the same order as alone within each lane. An inverted tet
    stops its lane before any motion, so that the state shows the tet.
    """
    moving = 0
    for lane in range(_lane_count(lanes)):
        if state.lane_fault[lane] != FAULT_NONE:
            continue
        if not entry_of(state.volume_ratio_smallest, lane) > 0.0:
            _stop(lanes, state, lane, FAULT_INVERTED_TET)
            continue
        moving += 1
        state.contact_kept[lane] = 1
        touched = touched_of(lanes, state, lane)
        position, velocity, force = touched.node_position, touched.node_velocity, touched.node_force
        if model.support_kind.shape[0] > 0:
            add_support_forces(
                supports_of(lanes, model, lane), part_of(lanes, state.ground_support, lane), position, velocity, force,
                part_of(lanes, state.support_stretch, lane), part_of(lanes, state.ground_load, lane), dt,
            )  # fmt: skip
        if model.foundation_nodes.shape[0] > 0:
            add_foundation_forces(
                model.foundation_nodes, part_of(lanes, state.ground_foundation, lane),
                ground_of(lanes, model, lane).foundation_stiffness, position, force,
            )  # fmt: skip
        if state.candidate_count[lane] == 0 and squeezed_count == 0 and steep_count == 0:
            continue
        _push_apart(lanes, model, state, shapes, law, response, dt, reference, wrench, lane)
        if steep_count == 0:
            _hold(lanes, model, state, shapes, law, dt, decay, squeezed_count, reference, wrench, lane)
    if steep_count > 0 and moving > 0:
        hold_steep(lanes, model, state, steep_count, SWEEPS_LEAST, dt)
        for lane in range(_lane_count(lanes)):
            if state.lane_fault[lane] == FAULT_NONE:
                _hold(lanes, model, state, shapes, law, dt, decay, squeezed_count, reference, wrench, lane)
    return moving


@njit(**INLINED)
def _move_ground(lanes, model, state, dt, decay):
    """Move the ground of the moving organs: foundations and supports now, anchored nodes by the integration."""
    if model.motion_node_shift.shape[0] == 0:
        return
    _, velocity, _ = nodes_of(lanes, state)
    drag_along(lanes, model.motion_node_shift, state.ground_rate, state.moving, decay, velocity)
    for lane in range(_lane_count(lanes)):
        if state.lane_fault[lane] != FAULT_NONE:
            continue
        touched = touched_of(lanes, state, lane)
        motion, foundation = part_of(lanes, state.motion, lane), part_of(lanes, state.ground_foundation, lane)
        ground = ground_of(lanes, model, lane)
        move_ground(
            ground, touched.node_position, touched.node_force, foundation,
            part_of(lanes, state.ground_load, lane), motion, dt,
        )  # fmt: skip
        place_ground(ground, motion, foundation, part_of(lanes, state.ground_support, lane))


@njit(**INLINED)
def _move_tools(lanes, state, shapes, response, dt, substep, wrench):
    """Advance the tools, lane by lane, and stop lanes with a fault; returns the number of moving lanes."""
    moving = 0
    for lane in range(_lane_count(lanes)):
        if state.lane_fault[lane] != FAULT_NONE:
            continue
        moved = shapes_of(lanes, shapes, lane)
        push_tools(moved, response_of(lanes, response, lane), dt, substep, part_of(lanes, wrench, lane))
        move_shapes(moved, dt)
        if not math.isfinite(entry_of(state.finite_sum, lane)):
            _stop(lanes, state, lane, FAULT_NOT_FINITE)
        elif state.contact_kept[lane] == 0:
            _stop(lanes, state, lane, FAULT_CONTACT_LOST)
        else:
            moving += 1
    return moving


@njit(**INLINED)
def _end(lanes, model, state, shapes, law, response, substep_count, wrench):
    """Set mean wrenches, mean forces of taxels and the lag of friction of moving lanes; restore those stopped."""
    stands = False
    for lane in range(_lane_count(lanes)):
        if state.lane_fault[lane] != FAULT_NONE:
            stands = True
            continue
        if law.friction > 0.0:
            stretch_by_lag(
                surface_of(lanes, model, lane), touched_of(lanes, state, lane), shapes_of(lanes, shapes, lane),
                response_of(lanes, response, lane), state.candidate_count[lane],
            )  # fmt: skip
        push = part_of(lanes, wrench, lane)
        for tool in range(push.shape[0]):
            for part in range(6):
                push[tool, part] /= substep_count
        taxels = part_of(lanes, shapes.taxel_force, lane)
        for taxel in range(taxels.shape[0]):
            for axis in range(3):
                taxels[taxel, axis] /= substep_count
    if stands:
        _put_back_forces(lanes, state)


@njit(**INNER)
def advance_inside(model, state, shapes, law, response, dt, decay, substep_count, reference, wrench):
    """`advance_substeps` for other kernels."""
    lanes = lanes_of(model)
    wrench[:] = 0.0
    _wake(lanes, state)
    _load_rows(lanes, state)
    _begin(lanes, model, state, shapes, response, dt * substep_count)
    fade_every = max(1, int(FADE_INTERVAL / dt + 0.5))
    faded = 0
    for substep in range(substep_count):
        fades = model.relaxes and (substep + 1 == substep_count or substep + 1 - faded == fade_every)
        squeezed_count, steep_count = _evaluate(model, state, fades, (substep + 1 - faded) * dt)
        if fades:
            faded = substep + 1
        if (
            _touch(
                lanes, model, state, shapes, law, response, dt, decay, squeezed_count, steep_count, reference, wrench
            )
            == 0
        ):
            break
        _move_ground(lanes, model, state, dt, decay)
        integrate(lanes, model, state, dt, decay)
        if _move_tools(lanes, state, shapes, response, dt, substep, wrench) == 0:
            break
    _end(lanes, model, state, shapes, law, response, substep_count, wrench)
    _store_motion(lanes, state)
    _store_force(lanes, state)
    return state.lane_fault[0]


@njit(**KERNEL)
def advance_substeps(model, state, shapes, law, response, dt, decay, substep_count, reference, wrench):
    """Advance organs by substeps against moving shapes; the kernel behind `organ.advance` and `advance_lanes`.

    Organs side by side (LaneModel, LaneState) have the lane as first index of shapes, response, reference and wrench.
    A fault stops an organ at its substep: an organ alone until the next call, a lane for good.

    Model: model, law, response
    In:    dt [s], decay = exp(-alpha dt), substep_count, reference: point of each tool's torque [m] (n_tool, 3)
    Out:   state, shapes (moved), wrench: MEAN force [N] and torque [N m] on each tool (n_tool, 6)
    Returns the FAULT_ code of an organ alone, or of the first lane; `state.lane_fault` has all of them.
    """
    return advance_inside(model, state, shapes, law, response, dt, decay, substep_count, reference, wrench)


@njit(**KERNEL)
def evaluate_forces(model, state):
    """Internal forces and gravity of a state, without contact, supports and foundations.

    In:  model, state: positions [m] and velocities [m/s] (n_node, 3)
    Out: state: node_force [N] (n_node, 3), volume_ratio_smallest (1,)
    """
    lanes = lanes_of(model)
    _load_rows(lanes, state)
    _evaluate(model, state, False, 0.0)
    _store_force(lanes, state)
