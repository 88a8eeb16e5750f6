"""Guard of the shapes' axes: a force that keeps the surface of an organ off them, and detection of passage."""

import math
from typing import NamedTuple

from numba import njit

from msdm_core.kernels.contact_kernels import closest_on_axis, react, tool_velocity
from msdm_core.kernels.element_kernels import corner_gradient, edge
from msdm_core.kernels.option_kernels import INLINED, INLINED_KERNEL, INNER

# Reach of the guard around a shape's axis, as a share of its radius; ordinary presses stay far from it.
GUARD_SHARE = 0.6
# Width of an edge, as a share of its triangle, so that nothing slips between two triangles.
EDGE_WIDTH = 5e-4
# Positions of a triangle relative to the axis of a shape.
FAR, NEAR, PASSED = 0, 1, 2
PI = math.pi


class _NearPoint(NamedTuple):
    """Point of a triangle nearest to the axis of a shape, SI units.

    Fields:
        corners: the triangle's nodes                                            3
        weights: of the corners at the point                                     3
        place: of the point [m]                                                  3
        direction: unit vector from the axis to it                               3
        distance: between them [m]
        reach: of the guard [m]
        stiffness: of the guard [N/m]
    """

    corners: tuple[int, int, int]
    weights: tuple[float, float, float]
    place: tuple[float, float, float]
    direction: tuple[float, float, float]
    distance: float
    reach: float
    stiffness: float


@njit(**INNER)
def guard_axes(model, state, shapes, law, response, dt, candidate_count, reference, wrench):
    """Force that keeps the surface off the axes of the shapes.

    A ball that is small against a triangle slips between its quadrature points. Therefore the point of each triangle
    nearest to the axis, at the distance d, is pushed away from it by k h (h / d - 1) below h = 0.6 r, with
    k = pi r^2 k_p: 0 at h, unbounded at the axis. The force is implicit, with the nodes' masses and the tool's
    mobility, so that it does not shorten the step; it must therefore come after all other forces.

    Model: model: surface_triangles (n_surface, 3), node_inverse_mass [1/kg] (n_node,); law, response
    In:    state: node_position [m], node_velocity [m/s] (n_node, 3), contact_candidates; shapes, dt [s],
           candidate_count, reference: point of each tool's torque [m] (n_tool, 3)
    Out:   state: node_force, added to [N] (n_node, 3), contact_passed (2,); wrench, added to [N, N m] (n_tool, 6)
    Returns True if no axis has passed through the surface.
    """
    position, velocity = state.node_position, state.node_velocity
    candidates, surface = state.contact_candidates, model.surface_triangles
    kept = True
    for shape in range(shapes.shape_radius.shape[0]):
        watched = watched_distance(shapes, dt, shape)
        for entry in range(candidate_count):
            triangle = candidates[shape, entry]
            if triangle < 0:
                break
            place, near = near_axis(position, velocity, surface, shapes, law, dt, shape, triangle, watched)
            if place == PASSED:
                state.contact_passed[0] = shape
                state.contact_passed[1] = triangle
                kept = False
            elif place == NEAR:
                _hold_off(model, state, shapes, response, dt, reference, wrench, shapes.shape_tool[shape], near)
    return kept


@njit(**INLINED)
def watched_distance(shapes, dt, shape):
    """Largest watched distance from an axis [m]: the guard's reach, and the axis' path in a substep."""
    tool = shapes.shape_tool[shape]
    watched = GUARD_SHARE * shapes.shape_radius[shape]
    for part in range(6):
        # As the broad phase bounds its speed.
        watched += dt * abs(shapes.tool_twist[tool, part])
    return watched


@njit(**INLINED)
def near_axis(position, velocity, surface, shapes, law, dt, shape, triangle, watched):
    """Position of a triangle relative to a shape's axis, FAR, NEAR or PASSED; if near, its point next to the axis.

    In: position [m], velocity [m/s] (n_node, 3), surface (n_surface, 3), shapes, law, dt [s], watched [m]
    """
    ends = shapes.shape_ends
    radius = shapes.shape_radius[shape]
    reach = GUARD_SHARE * radius
    a = surface[triangle, 0]
    b = surface[triangle, 1]
    c = surface[triangle, 2]
    none = radius * 0.0
    far = _NearPoint((a, b, c), (none, none, none), (none, none, none), (none, none, none), none, none, none)
    b_edge, c_edge = edge(position, a, b), edge(position, a, c)
    bx, by, bz = b_edge
    cx, cy, cz = c_edge
    nx, ny, nz = corner_gradient(b_edge, c_edge)
    twice_area = math.sqrt(nx * nx + ny * ny + nz * nz)
    first = 0.0
    second = 0.0
    for axis, part in ((0, nx), (1, ny), (2, nz)):
        first += (ends[shape, 0, axis] - position[a, axis]) * part
        second += (ends[shape, 1, axis] - position[a, axis]) * part
    low = 0 if first < second else 1
    if min(first, second) > watched * twice_area or max(first, second) < -watched * twice_area:
        return FAR, far
    if min(first, second) <= 0.0 and _passed(shapes, shape, position, velocity, dt, a, b, c):
        return PASSED, far
    # The triangle's point nearest to the axis' lower end, against the axis: exact for a ball, approximate for a shaft.
    wb, wc = closest_in_triangle(
        bx, by, bz, cx, cy, cz,
        ends[shape, low, 0] - position[a, 0], ends[shape, low, 1] - position[a, 1],
        ends[shape, low, 2] - position[a, 2],
    )  # fmt: skip
    x = position[a, 0] + wb * bx + wc * cx
    y = position[a, 1] + wb * by + wc * cy
    z = position[a, 2] + wb * bz + wc * cz
    px, py, pz = closest_on_axis(ends, shape, x, y, z)
    ex = x - px
    ey = y - py
    ez = z - pz
    distance = math.sqrt(ex * ex + ey * ey + ez * ez)
    # Behind the triangle, beyond an edge: another triangle lies between.
    if distance >= reach or ex * nx + ey * ny + ez * nz >= 0.0:
        return FAR, far
    direction = (ex / distance, ey / distance, ez / distance)
    stiffness = PI * radius * radius * law.stiffness
    weights = (1.0 - wb - wc, wb, wc)
    return NEAR, _NearPoint((a, b, c), weights, (x, y, z), direction, distance, reach, stiffness)


@njit(**INLINED)
def _hold_off(model, state, shapes, response, dt, reference, wrench, tool, near):
    """Guard's force on a point of a triangle, with its speed and mobility in this substep.

    Model: model, response
    In:    shapes: twist and centre of the tool [m, rad, s], dt [s], reference [m] (n_tool, 3), tool, near
    Out:   state: node_force [N] (n_node, 3), wrench, added to [N, N m] (n_tool, 6)
    """
    velocity, force, inverse_mass = state.node_velocity, state.node_force, model.node_inverse_mass
    twist, centre, mobility = shapes.tool_twist, shapes.tool_centre, response.tool_mobility
    ex, ey, ez = near.direction
    x, y, z = near.place
    ox = x - centre[tool, 0]
    oy = y - centre[tool, 1]
    oz = z - centre[tool, 2]
    vx, vy, vz = tool_velocity(twist, centre, tool, x, y, z)
    speed = -(ex * vx + ey * vy + ez * vz)
    lever = (ex, ey, ez, oy * ez - oz * ey, oz * ex - ox * ez, ox * ey - oy * ex)
    give = 0.0
    for row in range(6):
        for column in range(6):
            give += dt * lever[row] * mobility[tool, tool, row, column] * lever[column]
    for corner in range(3):
        node, weight = near.corners[corner], near.weights[corner]
        rate = dt * inverse_mass[node]
        speed += weight * (
            ex * (velocity[node, 0] + rate * force[node, 0])
            + ey * (velocity[node, 1] + rate * force[node, 1])
            + ez * (velocity[node, 2] + rate * force[node, 2])
        )
        give += weight * weight * rate
    closeness = near.reach / near.distance
    slope = near.stiffness * closeness**2
    push = near.stiffness * near.reach * (closeness - 1.0) - slope * dt * speed
    push = max(0.0, push / (1.0 + slope * dt * give))
    fx = push * ex
    fy = push * ey
    fz = push * ez
    for corner in range(3):
        node, weight = near.corners[corner], near.weights[corner]
        force[node, 0] += weight * fx
        force[node, 1] += weight * fy
        force[node, 2] += weight * fz
    react(wrench, reference, tool, x, y, z, fx, fy, fz)


@njit(**INNER)
def _passed(shapes, shape, position, velocity, dt, a, b, c):
    """True if an end of a shape's axis went through a triangle in the last substep, or the axis now sticks in it."""
    ends, twist, centre, tool = shapes.shape_ends, shapes.tool_twist, shapes.tool_centre, shapes.shape_tool[shape]
    highest, highest_b, highest_c = 0.0, 0.0, 0.0
    lowest, lowest_b, lowest_c = 0.0, 0.0, 0.0
    for end in range(2):
        x = ends[shape, end, 0]
        y = ends[shape, end, 1]
        z = ends[shape, end, 2]
        now, now_b, now_c = _foot(x, y, z, position, velocity, 0.0, a, b, c)
        vx, vy, vz = tool_velocity(twist, centre, tool, x, y, z)
        x -= dt * vx
        y -= dt * vy
        z -= dt * vz
        then, then_b, then_c = _foot(x, y, z, position, velocity, dt, a, b, c)
        if then > 0.0 >= now and _is_inside(then, then_b, then_c, now, now_b, now_c):
            return True
        if now > highest:
            highest, highest_b, highest_c = now, now_b, now_c
        if now < lowest:
            lowest, lowest_b, lowest_c = now, now_b, now_c
    return highest > 0.0 > lowest and _is_inside(highest, highest_b, highest_c, lowest, lowest_b, lowest_c)


@njit(**INLINED)
def _foot(x, y, z, position, velocity, dt, a, b, c):
    """Height of a point over a triangle dt ago [m], and its foot's weights of the corners b and c."""
    ax = position[a, 0] - dt * velocity[a, 0]
    ay = position[a, 1] - dt * velocity[a, 1]
    az = position[a, 2] - dt * velocity[a, 2]
    bx = position[b, 0] - dt * velocity[b, 0] - ax
    by = position[b, 1] - dt * velocity[b, 1] - ay
    bz = position[b, 2] - dt * velocity[b, 2] - az
    cx = position[c, 0] - dt * velocity[c, 0] - ax
    cy = position[c, 1] - dt * velocity[c, 1] - ay
    cz = position[c, 2] - dt * velocity[c, 2] - az
    px = x - ax
    py = y - ay
    pz = z - az
    nx, ny, nz = corner_gradient((bx, by, bz), (cx, cy, cz))
    squared = nx * nx + ny * ny + nz * nz
    wb = ((py * cz - pz * cy) * nx + (pz * cx - px * cz) * ny + (px * cy - py * cx) * nz) / squared
    wc = ((by * pz - bz * py) * nx + (bz * px - bx * pz) * ny + (bx * py - by * px) * nz) / squared
    return (px * nx + py * ny + pz * nz) / math.sqrt(squared), wb, wc


@njit(**INLINED)
def _is_inside(high, high_b, high_c, low, low_b, low_c):
    """True if the path from a height above a triangle to a height below leads through it, its edges included."""
    share = high / (high - low)
    wb = high_b + share * (low_b - high_b)
    wc = high_c + share * (low_c - high_c)
    return wb >= -EDGE_WIDTH and wc >= -EDGE_WIDTH and wb + wc <= 1.0 + EDGE_WIDTH


@njit(**INLINED_KERNEL)
def closest_in_triangle(bx, by, bz, cx, cy, cz, px, py, pz):
    """Point of a triangle nearest to p (Ericson, Real-Time Collision Detection, 2005, 5.1.5).

    In: b, c: edges from the corner a [m], p: from the corner a to the point [m]
    Returns the weights of the corners b and c.
    """
    bb = bx * bx + by * by + bz * bz
    cc = cx * cx + cy * cy + cz * cz
    bc = bx * cx + by * cy + bz * cz
    pb = px * bx + py * by + pz * bz
    pc = px * cx + py * cy + pz * cz
    determinant = bb * cc - bc * bc
    wb = cc * pb - bc * pc
    wc = bb * pc - bc * pb
    if wb > 0.0 and wc > 0.0 and wb + wc < determinant:
        return wb / determinant, wc / determinant
    # The nearest of the three edges' nearest points.
    on_b = min(1.0, max(0.0, pb / bb))
    best = on_b * (on_b * bb - 2.0 * pb)
    wb = on_b
    wc = 0.0
    on_c = min(1.0, max(0.0, pc / cc))
    distance = on_c * (on_c * cc - 2.0 * pc)
    if distance < best:
        best = distance
        wb = 0.0
        wc = on_c
    # Along b to c.
    along = min(1.0, max(0.0, (bb - bc - pb + pc) / (bb + cc - 2.0 * bc)))
    ub = 1.0 - along
    distance = ub * ub * bb + along * along * cc + 2.0 * ub * along * bc - 2.0 * (ub * pb + along * pc)
    if distance < best:
        wb = ub
        wc = along
    return wb, wc
