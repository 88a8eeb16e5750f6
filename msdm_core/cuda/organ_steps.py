"""Haptic steps of organs on a CUDA device: a block of threads for each organ, or all blocks for a single organ.

`device_functions` compiles this text for a floating-point type. Forces are gathered node by node, in the order of a
list: no two threads add to one number, so that runs repeat to the bit on one device. Barriers (`_wait`) separate the
passes; a single thread does the sequential parts: tools, the guard, squeezed tets.
"""

import math
from typing import Any, NamedTuple

from numba import cuda

from msdm_core.cuda.device_functions import REAL, REAL_TYPE
from msdm_core.kernels.contact_kernels import (
    QUADRATURE_BARYCENTRIC,
    QUADRATURE_COUNT,
    ROW_AREA,
    ROW_MORE,
    ROW_PRESSURE,
    ROW_STRETCH,
    SWEEPS,
    begin_hold,
    core_box,
    corner_force,
    facet_of,
    first_push,
    hold_rates,
    hold_share,
    is_in_reach,
    lag_point,
    may_meet,
    more_push,
    press_point,
    reach_margin,
    set_give,
    sweep_point,
)  # fmt: skip
from msdm_core.kernels.element_kernels import (
    SQUEEZED_RATIO,
    node_tension,
    spring_length,
    spring_scale,
    tet_scale,
    tet_shape,
    volume_ratio,
)  # fmt: skip
from msdm_core.kernels.guard_kernels import FAR, guard_axes, near_axis, watched_distance
from msdm_core.kernels.lane_view_kernels import SurfaceView, TouchedView
from msdm_core.kernels.space_kernels import (
    add_to_row,
    edge,
    minus,
    part_of_row,
    plus,
    row_of,
    scalar_product,
    set_row,
    shifted,
    take_from_row,
    times,
    vector_product,
)  # fmt: skip
from msdm_core.kernels.squeeze_kernels import hold_squeezed
from msdm_core.kernels.structure_kernels import (
    FAULT_CONTACT_LOST,
    FAULT_INVERTED_TET,
    FAULT_NONE,
    FAULT_NOT_FINITE,
    ContactShapes,
    ToolResponse,
)  # fmt: skip
from msdm_core.kernels.substep_kernels import move_shapes, push_tools

# Signals between threads within a substep: entries of `Scratch.flags`.
INVERTED, SQUEEZED, GUARDED, NOT_FINITE, PASSED, ENTRY_COUNT, NODE_COUNT, SQUEEZED_COUNT = range(8)
FLAG_COUNT = 8
# `Working` is in shared memory.
SHARED = True


class DeviceModel(NamedTuple):
    """Constants of organs on a device, SI units; own fields of lanes have the lane as first index.

    Fields:
        tet_nodes, tet_inverse_volume, spring_nodes, spring_rest_length, node_inverse_volume, surface_triangles,
            surface_rest_area, foundation_position, foundation_stiffness, gravity: as in `OrganModel`
        node_tet_count: number of tets at each node                              (n_node,)
        node_tets: each with its other corners in outward order                  (most, n_node, 4)
        node_spring_count, node_springs: each with its other end                 (n_node,), (most, n_node, 2)
        node_foundation: row of foundation_position; -1 for none                 (n_node,)
        surface_nodes: nodes of the surface                                      (n_surface_node,)
        facet_count, facets: triangles around each, times 3, plus the corner     (n_surface_node,), (.., most)
        node_mass, node_inverse_mass, node_bulk: own                             (n_lane, n_node)
        spring_stiffness: own                                                    (n_lane, n_spring)
        tet_bulk, tet_averaged_bulk: own                                         (n_lane, n_tet)
    """

    tet_nodes: Any
    tet_inverse_volume: Any
    spring_nodes: Any
    spring_rest_length: Any
    node_inverse_volume: Any
    surface_triangles: Any
    surface_rest_area: Any
    foundation_position: Any
    foundation_stiffness: Any
    gravity: Any
    node_tet_count: Any
    node_tets: Any
    node_spring_count: Any
    node_springs: Any
    node_foundation: Any
    surface_nodes: Any
    facet_count: Any
    facets: Any
    node_mass: Any
    node_inverse_mass: Any
    node_bulk: Any
    spring_stiffness: Any
    tet_bulk: Any
    tet_averaged_bulk: Any


class DeviceState(NamedTuple):
    """State of organs on a device, as in `OrganState` with the lane as first index."""

    node_position: Any
    node_velocity: Any
    contact_engaged: Any
    contact_stretch: Any
    contact_passed: Any
    volume_ratio_smallest: Any
    fault: Any


class Scratch(NamedTuple):
    """Working memory of a block; the block is the first index.

    Fields:
        flags: signals, at INVERTED and so on                                    (n_block, FLAG_COUNT)
        counts: of each thread                                                   (n_block, n_thread)
        candidates: triangles in reach of each shape, as in `OrganState`         (n_block, n_shape, n_surface)
        entry: place of a triangle in `listed`, or -1                            (n_block, n_shape, n_surface)
        listed: shape and triangle of each candidate                             (n_block, n_shape * n_surface, 2)
        rows, places: as in `OrganState`                                         (n_block, n_slot, ...)
        touched: places in surface_nodes of nodes in reach                       (n_block, n_surface_node)
        hold: as contact_hold in `OrganState`                                    (n_block, n_node)
        squeezed: squeezed tets                                                  (n_block, n_tet)
        pool: `Working`, if too large for shared memory                          (n_block, n_number)
    """

    flags: Any
    counts: Any
    candidates: Any
    entry: Any
    listed: Any
    rows: Any
    places: Any
    touched: Any
    hold: Any
    squeezed: Any
    pool: Any


class Tools(NamedTuple):
    """Tools of all lanes: `ContactShapes`, `ToolResponse` and the results, with the lane as first index.

    Fields:
        radius, tool, friction: of each shape, for all lanes                     (n_shape,)
        ends, span, centre, twist: see ContactShapes                             (n_lane, ...)
        acceleration, mobility, pushed, lag: see ToolResponse                    (n_lane, ...)
        reference: centres of mass at the start of a haptic step [m]             (n_lane, n_tool, 3)
        mean: wrench of the last haptic step [N, N m]                            (n_lane, n_tool, 6)
    """

    radius: Any
    tool: Any
    friction: Any
    ends: Any
    span: Any
    centre: Any
    twist: Any
    acceleration: Any
    mobility: Any
    pushed: Any
    lag: Any
    reference: Any
    mean: Any


class StepNumbers(NamedTuple):
    """Numbers of a substep: duration [s], decay exp(-alpha dt); substeps in a haptic step; haptic steps."""

    dt: Any
    decay: Any
    substep_count: int
    step_count: int


class Working(NamedTuple):
    """Numbers of a block's organ: positions, velocities and forces (n_node, 3), then one per item."""

    position: Any
    velocity: Any
    force: Any
    tension: Any
    tet: Any
    spring: Any


def working_size(nodes: int, tets: int, springs: int) -> int:
    """Number of elements in `Working`."""
    return 10 * nodes + tets + springs


def _wait(grid):
    """Barrier for all threads of the organ: those of the block, or of the grid."""
    if grid is None:
        cuda.syncthreads()
    else:
        grid.sync()


# ---- tissue -------------------------------------------------------------------------------------------------------


def _six_volumes(model, work, tet):
    """Six times the volume of a tet."""
    a, b, c, d = model.tet_nodes[tet, 0], model.tet_nodes[tet, 1], model.tet_nodes[tet, 2], model.tet_nodes[tet, 3]
    _, six = tet_shape(edge(work.position, a, b), edge(work.position, a, c), edge(work.position, a, d))
    return six


def _set_volumes(first, stride, model, work):
    """Six times the volume of each tet."""
    for tet in range(first, model.tet_nodes.shape[0], stride):
        work.tet[tet] = _six_volumes(model, work, tet)


def _set_tensions(first, stride, model, lane, work):
    """Tension of the volumes averaged at nodes."""
    for node in range(first, model.node_inverse_volume.shape[0], stride):
        total = REAL(0.0)
        for slot in range(model.node_tet_count[node]):
            total += work.tet[model.node_tets[slot, node, 0]]
        work.tension[node] = node_tension(total, model.node_inverse_volume[node], model.node_bulk[lane, node])


def _set_scales(first, stride, model, lane, work, flags, lowest):
    """Factors on gradients from volumes, and factors on the edges of springs; returns the smallest volume ratio."""
    tension = work.tension
    for tet in range(first, model.tet_nodes.shape[0], stride):
        ratio = volume_ratio(work.tet[tet], model.tet_inverse_volume[tet])
        if not ratio > 0.0:
            flags[INVERTED] = 1
        if ratio < SQUEEZED_RATIO:
            flags[SQUEEZED] = 1
        if not ratio >= lowest:
            lowest = ratio
        averaged = 0.25 * (
            tension[model.tet_nodes[tet, 0]] + tension[model.tet_nodes[tet, 1]]
            + tension[model.tet_nodes[tet, 2]] + tension[model.tet_nodes[tet, 3]]
        )  # fmt: skip
        work.tet[tet] = tet_scale(ratio, model.tet_bulk[lane, tet], model.tet_averaged_bulk[lane, tet], averaged)
    for spring in range(first, model.spring_nodes.shape[0], stride):
        along = edge(work.position, model.spring_nodes[spring, 0], model.spring_nodes[spring, 1])
        share = model.spring_rest_length[spring] / spring_length(along)
        work.spring[spring] = spring_scale(share, model.spring_stiffness[lane, spring])
    return lowest


def _set_forces(first, stride, model, lane, work):
    """Gravity, volume terms, springs and foundations, node by node."""
    position = work.position
    for node in range(first, position.shape[0], stride):
        force = (REAL(0.0), REAL(0.0), REAL(0.0))
        for slot in range(model.node_tet_count[node]):
            p = model.node_tets[slot, node, 1]
            # The gradient at a corner is the product of two edges of the opposite face.
            gradient = vector_product(
                edge(position, p, model.node_tets[slot, node, 2]), edge(position, p, model.node_tets[slot, node, 3])
            )
            force = shifted(force, work.tet[model.node_tets[slot, node, 0]], gradient)
        for slot in range(model.node_spring_count[node]):
            along = edge(position, node, model.node_springs[slot, node, 1])
            force = shifted(force, work.spring[model.node_springs[slot, node, 0]], along)
        gravity = (model.gravity[0], model.gravity[1], model.gravity[2])
        set_row(work.force, node, 0, shifted(force, model.node_mass[lane, node], gravity))
        held = model.node_foundation[node]
        if held >= 0:
            stretch = minus(row_of(position, node), row_of(model.foundation_position, held))
            for axis in range(3):
                stiffness = row_of(model.foundation_stiffness[held], axis)
                work.force[node, axis] -= scalar_product(stiffness, stretch)


def _integrate(first, stride, model, lane, work, numbers, flags):
    """Symplectic Euler: v = decay v + dt f / m, x = x + dt v."""
    for node in range(first, work.position.shape[0], stride):
        rate = model.node_inverse_mass[lane, node] * numbers.dt
        for axis in range(3):
            speed = work.velocity[node, axis] * numbers.decay + work.force[node, axis] * rate
            place = work.position[node, axis] + speed * numbers.dt
            work.velocity[node, axis] = speed
            work.position[node, axis] = place
            if not math.isfinite(place + speed):
                flags[NOT_FINITE] = 1


# ---- lists and sums in one block ----------------------------------------------------------------------------------


def _places(counts, own):
    """Place of a thread's first item in the ordered list of all threads' items, and the length of the list."""
    thread, threads = cuda.threadIdx.x, cuda.blockDim.x
    counts[thread] = own
    cuda.syncthreads()
    step = 1
    while step < threads:
        before = counts[thread - step] if thread >= step else 0
        cuda.syncthreads()
        counts[thread] += before
        cuda.syncthreads()
        step *= 2
    end, total = counts[thread], counts[threads - 1]
    cuda.syncthreads()
    return end - own, total


def _share(count):
    """A thread's items of a list: the first, and the end."""
    width = (count + cuda.blockDim.x - 1) // cuda.blockDim.x
    begin = min(cuda.threadIdx.x * width, count)
    return begin, min(begin + width, count)


def _add_up(sums):
    """Sum of each row of `sums` over the threads of a block, in a fixed order, into its first column."""
    thread, threads = cuda.threadIdx.x, cuda.blockDim.x
    cuda.syncthreads()
    step = 1
    while step < threads:
        if thread % (2 * step) == 0 and thread + step < threads:
            for part in range(sums.shape[0]):
                sums[part, thread] += sums[part, thread + step]
        cuda.syncthreads()
        step *= 2


# ---- contact: one block -------------------------------------------------------------------------------------------


def _find_candidates(model, engaged, shapes, position, duration, block, scratch):
    """Broad phase of a haptic step: triangles in reach of each shape, in order, and the nodes around them."""
    candidates, entry, listed = scratch.candidates[block], scratch.entry[block], scratch.listed[block]
    counts, touched, flags = scratch.counts[block], scratch.touched[block], scratch.flags[block]
    surface = model.surface_triangles
    begin, end = _share(surface.shape[0])
    base = 0
    for shape in range(shapes.shape_radius.shape[0]):
        margin = reach_margin(shapes, shape, duration)
        box = core_box(shapes, shape, margin)
        own = 0
        for triangle in range(begin, end):
            entry[shape, triangle] = -1
            if is_in_reach(position, surface, engaged, shapes, shape, triangle, margin, box):
                entry[shape, triangle] = own
                own += 1
        before, total = _places(counts, own)
        for triangle in range(begin, end):
            if entry[shape, triangle] >= 0:
                place = before + entry[shape, triangle]
                candidates[shape, place] = triangle
                listed[base + place, 0] = shape
                listed[base + place, 1] = triangle
                entry[shape, triangle] = base + place
        if cuda.threadIdx.x == 0 and total < surface.shape[0]:
            candidates[shape, total] = -1
        base += total
    cuda.syncthreads()
    begin, end = _share(model.surface_nodes.shape[0])
    own = 0
    for item in range(begin, end):
        if _is_touched(model, entry, item):
            own += 1
    place, total = _places(counts, own)
    for item in range(begin, end):
        if _is_touched(model, entry, item):
            touched[place] = item
            place += 1
    if cuda.threadIdx.x == 0:
        flags[ENTRY_COUNT] = base
        flags[NODE_COUNT] = total
    cuda.syncthreads()


def _is_touched(model, entry, item):
    """True if a node of the surface belongs to a candidate."""
    for place in range(model.facet_count[item]):
        for shape in range(entry.shape[0]):
            if entry[shape, model.facets[item, place] // 3] >= 0:
                return True
    return False


def _press(model, work, engaged, stretch, shapes, law, dt, block, scratch):
    """Pressure and friction of each point of the candidates, see `contact_kernels.add_contact_forces`."""
    listed, rows, places = scratch.listed[block], scratch.rows[block], scratch.places[block]
    surface = model.surface_triangles
    for slot in range(cuda.threadIdx.x, QUADRATURE_COUNT * scratch.flags[block, ENTRY_COUNT], cuda.blockDim.x):
        shape, triangle = listed[slot // QUADRATURE_COUNT, 0], listed[slot // QUADRATURE_COUNT, 1]
        places[slot, 0] = -1
        if not may_meet(work.position, surface, engaged, shapes, shape, triangle):
            continue
        facet = facet_of(work.position, surface, triangle)
        if press_point(
            work.position, work.velocity, model.surface_rest_area, engaged, stretch, rows, places, shapes, law, dt,
            shape, triangle, facet, slot % QUADRATURE_COUNT, slot,
        ):  # fmt: skip
            begin_hold(work.position, shapes, rows, places, slot)


def _push_nodes(model, work, law, dt, sweep, block, scratch):
    """Add the forces of its points to each node: at first (sweep -1) in full, with the hold, then a sweep's change."""
    entry, rows, places = scratch.entry[block], scratch.rows[block], scratch.places[block]
    hold, touched = scratch.hold[block], scratch.touched[block]
    along, across = hold_rates(law, dt)
    for number in range(cuda.threadIdx.x, scratch.flags[block, NODE_COUNT], cuda.blockDim.x):
        item = touched[number]
        node = model.surface_nodes[item]
        force, held = (REAL(0.0), REAL(0.0), REAL(0.0)), REAL(0.0)
        for place in range(model.facet_count[item]):
            triangle, corner = model.facets[item, place] // 3, model.facets[item, place] % 3
            for shape in range(entry.shape[0]):
                if entry[shape, triangle] < 0:
                    continue
                for point in range(QUADRATURE_COUNT):
                    slot = QUADRATURE_COUNT * entry[shape, triangle] + point
                    if places[slot, 0] < 0:
                        continue
                    weight = QUADRATURE_BARYCENTRIC[point, corner]
                    if sweep < 0:
                        push, drag = first_push(rows, slot, law)
                        held += hold_share(rows, slot, corner, weight, along, across, dt)
                    else:
                        push, drag = more_push(rows, slot, law)
                    force = plus(force, corner_force(rows, slot, corner, push, weight, drag))
        add_to_row(work.force, node, force)
        if sweep < 0:
            hold[node] = held
    cuda.syncthreads()


def _guard(model, lane, work, state, shapes, response, law, dt, reference, wrench, block, scratch):
    """Guard of the axes: all candidates in order, if any is near."""
    listed, flags, surface = scratch.listed[block], scratch.flags[block], model.surface_triangles
    for number in range(cuda.threadIdx.x, flags[ENTRY_COUNT], cuda.blockDim.x):
        shape, triangle = listed[number, 0], listed[number, 1]
        watched = watched_distance(shapes, dt, shape)
        nearness, _ = near_axis(work.position, work.velocity, surface, shapes, law, dt, shape, triangle, watched)
        if nearness != FAR:
            flags[GUARDED] = 1
    cuda.syncthreads()
    if flags[GUARDED] != 0:
        if cuda.threadIdx.x == 0:
            face = SurfaceView(surface, model.surface_rest_area, model.node_inverse_mass[lane])
            touched = TouchedView(
                work.position, work.velocity, work.force, state.contact_engaged[lane], state.contact_stretch[lane],
                scratch.candidates[block], scratch.rows[block], scratch.places[block], scratch.hold[block],
                state.contact_passed[lane],
            )  # fmt: skip
            if not guard_axes(face, touched, shapes, law, response, dt, scratch.candidates.shape[2], reference, wrench):
                flags[PASSED] = 1
        cuda.syncthreads()


def _hold(model, lane, work, stretch, shapes, law, numbers, block, scratch):
    """Pressure and friction at the end of the substep, see `contact_kernels.hold_contact`."""
    rows, places = scratch.rows[block], scratch.places[block]
    slots = QUADRATURE_COUNT * scratch.flags[block, ENTRY_COUNT]
    inverse_mass = model.node_inverse_mass[lane]
    for slot in range(cuda.threadIdx.x, slots, cuda.blockDim.x):
        if places[slot, 0] >= 0:
            set_give(rows, places, scratch.hold[block], inverse_mass, slot)
    for sweep in range(len(SWEEPS)):
        for slot in range(cuda.threadIdx.x, slots, cuda.blockDim.x):
            if places[slot, 0] >= 0:
                sweep_point(
                    work.velocity, work.force, inverse_mass, stretch, shapes, law, numbers.dt, numbers.decay, rows,
                    places, slot, sweep,
                )  # fmt: skip
        cuda.syncthreads()
        _push_nodes(model, work, law, numbers.dt, sweep, block, scratch)


def _add_wrench(work, shapes, law, reference, wrench, block, scratch, sums):
    """Add the reaction of all points to the wrench on their tools."""
    thread, threads = cuda.threadIdx.x, cuda.blockDim.x
    rows, places = scratch.rows[block], scratch.places[block]
    for tool in range(wrench.shape[0]):
        for part in range(6):
            sums[part, thread] = 0.0
        for slot in range(thread, QUADRATURE_COUNT * scratch.flags[block, ENTRY_COUNT], threads):
            if places[slot, 0] < 0 or shapes.shape_tool[places[slot, 0]] != tool:
                continue
            push = rows[slot, ROW_AREA] * (rows[slot, ROW_PRESSURE] + rows[slot, ROW_MORE])
            stretch = plus(part_of_row(rows, slot, ROW_STRETCH), part_of_row(rows, slot, ROW_MORE + 1))
            drag = times(rows[slot, ROW_AREA] * law.tangential_stiffness, stretch)
            for corner in range(3):
                node = places[slot, 2 + corner]
                weight = QUADRATURE_BARYCENTRIC[places[slot, 1] % QUADRATURE_COUNT, corner]
                force = corner_force(rows, slot, corner, push, weight, drag)
                arm = minus(row_of(work.position, node), row_of(reference, tool))
                take_from_row(sums.T, thread, 0, force)
                take_from_row(sums.T, thread, 3, vector_product(arm, force))
        _add_up(sums)
        if thread == 0:
            for part in range(6):
                wrench[tool, part] += sums[part, 0]
        cuda.syncthreads()


def _hold_squeezed(model, lane, work, dt, block, scratch):
    """Squeezed tets in order, see `squeeze_kernels.hold_squeezed`."""
    squeezed, flags = scratch.squeezed[block], scratch.flags[block]
    begin, end = _share(model.tet_nodes.shape[0])
    own = 0
    for tet in range(begin, end):
        if _is_squeezed(model, work, tet):
            own += 1
    place, total = _places(scratch.counts[block], own)
    for tet in range(begin, end):
        if _is_squeezed(model, work, tet):
            squeezed[place] = tet
            place += 1
    cuda.syncthreads()
    if cuda.threadIdx.x == 0:
        flags[SQUEEZED_COUNT] = total
        hold_squeezed(
            work.position, work.velocity, work.force, model.node_inverse_mass[lane], model.tet_nodes,
            model.tet_inverse_volume, model.tet_averaged_bulk[lane], squeezed, total, 1, dt,
        )  # fmt: skip
    cuda.syncthreads()


def _is_squeezed(model, work, tet):
    return volume_ratio(_six_volumes(model, work, tet), model.tet_inverse_volume[tet]) < SQUEEZED_RATIO


def _touch(model, lane, work, state, shapes, response, law, numbers, reference, wrench, block, scratch, sums):
    """Contact, guard and squeezed tets of a substep."""
    flags, dt = scratch.flags[block], numbers.dt
    if flags[ENTRY_COUNT] > 0:
        engaged, stretch = state.contact_engaged[lane], state.contact_stretch[lane]
        _press(model, work, engaged, stretch, shapes, law, dt, block, scratch)
        cuda.syncthreads()
        _push_nodes(model, work, law, dt, -1, block, scratch)
        _guard(model, lane, work, state, shapes, response, law, dt, reference, wrench, block, scratch)
        _hold(model, lane, work, stretch, shapes, law, numbers, block, scratch)
        _add_wrench(work, shapes, law, reference, wrench, block, scratch, sums)
    if flags[SQUEEZED] != 0:
        _hold_squeezed(model, lane, work, dt, block, scratch)


# ---- haptic steps -------------------------------------------------------------------------------------------------


def _haptic_step(
    grid, leads, first, stride, model, lane, work, state, shapes, response, law, numbers, reference, wrench, block,
    scratch, sums, lowest,
):  # fmt: skip
    """Substeps of one haptic step; returns the thread's smallest volume ratio."""
    flags, dt = scratch.flags[block], numbers.dt
    if leads:
        if first == 0:
            for tool in range(wrench.shape[0]):
                for part in range(6):
                    wrench[tool, part] = 0.0
                    response.tool_wrench[tool, part] = 0.0
                    response.tool_lag[tool, part] = 0.0
        duration = dt * REAL(numbers.substep_count)
        _find_candidates(model, state.contact_engaged[lane], shapes, work.position, duration, block, scratch)
    moves = True
    for substep in range(numbers.substep_count):
        _set_volumes(first, stride, model, work)
        _wait(grid)
        if first == 0:
            # No thread reads them between these two barriers.
            for flag in range(PASSED + 1):
                flags[flag] = 0
        _set_tensions(first, stride, model, lane, work)
        _wait(grid)
        lowest = _set_scales(first, stride, model, lane, work, flags, lowest)
        _wait(grid)
        if flags[INVERTED] != 0:
            if first == 0:
                state.fault[lane] = FAULT_INVERTED_TET
            moves = False
            break
        _set_forces(first, stride, model, lane, work)
        _wait(grid)
        if leads:
            _touch(model, lane, work, state, shapes, response, law, numbers, reference, wrench, block, scratch, sums)
        _wait(grid)
        _integrate(first, stride, model, lane, work, numbers, flags)
        if first == 0:
            push_tools(shapes, response, dt, REAL(substep), wrench)
            move_shapes(shapes, dt)
        _wait(grid)
        if flags[NOT_FINITE] != 0 or flags[PASSED] != 0:
            if first == 0:
                state.fault[lane] = FAULT_NOT_FINITE if flags[NOT_FINITE] != 0 else FAULT_CONTACT_LOST
            moves = False
            break
    if leads and moves:
        _end_step(model, lane, work, state, shapes, response, law, numbers, wrench, block, scratch)
    _wait(grid)
    return lowest


def _end_step(model, lane, work, state, shapes, response, law, numbers, wrench, block, scratch):
    """Lag of friction, and mean wrench."""
    listed, stretch = scratch.listed[block], state.contact_stretch[lane]
    if law.friction > 0.0:
        for slot in range(cuda.threadIdx.x, QUADRATURE_COUNT * scratch.flags[block, ENTRY_COUNT], cuda.blockDim.x):
            shape, triangle = listed[slot // QUADRATURE_COUNT, 0], listed[slot // QUADRATURE_COUNT, 1]
            point = slot % QUADRATURE_COUNT
            if state.contact_engaged[lane, shape, triangle * QUADRATURE_COUNT + point] != 0:
                lag_point(work.position, model.surface_triangles, stretch, shapes, response, shape, triangle, point)
    if cuda.threadIdx.x == 0:
        for tool in range(wrench.shape[0]):
            for part in range(6):
                wrench[tool, part] /= REAL(numbers.substep_count)


def _advance(
    grid, leads, first, stride, model, lane, pool, state, tools, law, numbers, block, scratch, shared
):  # fmt: skip
    """Haptic steps of one organ, with its numbers in `pool` and sums of threads in `shared`."""
    nodes, tets, springs = state.node_position.shape[1], model.tet_nodes.shape[0], model.spring_nodes.shape[0]
    # A device function cannot return a view of an array.
    work = Working(
        pool[: 3 * nodes].reshape((nodes, 3)),
        pool[3 * nodes : 6 * nodes].reshape((nodes, 3)),
        pool[6 * nodes : 9 * nodes].reshape((nodes, 3)),
        pool[9 * nodes : 10 * nodes],
        pool[10 * nodes : 10 * nodes + tets],
        pool[10 * nodes + tets : 10 * nodes + tets + springs],
    )
    sums = shared.reshape((6, shared.shape[0] // 6))
    for item in range(first, nodes, stride):
        for axis in range(3):
            work.position[item, axis] = state.node_position[lane, item, axis]
            work.velocity[item, axis] = state.node_velocity[lane, item, axis]
    shapes = ContactShapes(
        tools.ends[lane], tools.radius, tools.tool, tools.centre[lane], tools.twist[lane], tools.span[lane],
        tools.friction,
    )  # fmt: skip
    response = ToolResponse(tools.acceleration[lane], tools.mobility[lane], tools.pushed[lane], tools.lag[lane])
    reference, wrench = tools.reference[lane], tools.mean[lane]
    lowest = state.volume_ratio_smallest[lane]
    for _ in range(numbers.step_count):
        if first == 0:
            for tool in range(reference.shape[0]):
                for axis in range(3):
                    reference[tool, axis] = shapes.tool_centre[tool, axis]
        _wait(grid)
        lowest = _haptic_step(
            grid, leads, first, stride, model, lane, work, state, shapes, response, law, numbers, reference, wrench,
            block, scratch, sums, lowest,
        )  # fmt: skip
        if state.fault[lane] != FAULT_NONE:
            break
    for item in range(first, nodes, stride):
        for axis in range(3):
            state.node_position[lane, item, axis] = work.position[item, axis]
            state.node_velocity[lane, item, axis] = work.velocity[item, axis]
    _keep_lowest(state, lane, lowest)


def _keep_lowest(state, lane, lowest):
    """Smallest volume ratio of all threads: a minimum does not depend on the order."""
    if not lowest >= state.volume_ratio_smallest[lane]:
        cuda.atomic.min(state.volume_ratio_smallest, lane, lowest)


def advance_lanes(model, state, scratch, tools, law, numbers):
    """Advance each organ without fault; a block takes its organs in turn."""
    block, thread, threads = cuda.blockIdx.x, cuda.threadIdx.x, cuda.blockDim.x
    shared = cuda.shared.array(0, REAL_TYPE)
    pool = shared[6 * threads :] if SHARED else scratch.pool[block]
    for lane in range(block, state.fault.shape[0], cuda.gridDim.x):
        if state.fault[lane] == FAULT_NONE:
            _advance(
                None, True, thread, threads, model, lane, pool, state, tools, law, numbers, block, scratch,
                shared[: 6 * threads],
            )  # fmt: skip
        cuda.syncthreads()


def advance_organ(model, state, scratch, tools, law, numbers):
    """Advance one organ by all blocks together; the first does contact."""
    shared = cuda.shared.array(0, REAL_TYPE)
    if state.fault[0] == FAULT_NONE:
        _advance(
            cuda.cg.this_grid(), cuda.blockIdx.x == 0, cuda.grid(1), cuda.gridsize(1), model, 0, scratch.pool[0],
            state, tools, law, numbers, 0, scratch, shared[: 6 * cuda.blockDim.x],
        )  # fmt: skip
