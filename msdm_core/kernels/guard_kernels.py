"""Guard of the shapes' axes: a force that keeps the surface of an organ off them, and detection of passage."""

import math
from typing import NamedTuple

from numba import njit

from msdm_core.kernels.contact_kernels import closest_on_axis, end_of, react, tool_velocity
from msdm_core.kernels.option_kernels import INLINED, INNER
from msdm_core.kernels.space_kernels import (
    add_to_row,
    divided,
    edge,
    length_of,
    minus,
    opposite,
    row_of,
    scalar_product,
    shifted,
    times,
    vector_product,
)
from msdm_core.kernels.taxel_kernels import spread_force

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
                _hold_off(model, state, shapes, response, dt, reference, wrench, shape, near)
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
    radius = shapes.shape_radius[shape]
    reach = GUARD_SHARE * radius
    corners = row_of(surface, triangle)
    a, b, c = corners
    none = radius * 0.0
    nowhere = (none, none, none)
    far = _NearPoint(corners, nowhere, nowhere, nowhere, none, none, none)
    corner, b_edge, c_edge = row_of(position, a), edge(position, a, b), edge(position, a, c)
    normal = vector_product(b_edge, c_edge)
    twice_area = length_of(normal)
    first = scalar_product(minus(end_of(shapes, shape, 0), corner), normal)
    second = scalar_product(minus(end_of(shapes, shape, 1), corner), normal)
    low = 0 if first < second else 1
    if min(first, second) > watched * twice_area or max(first, second) < -watched * twice_area:
        return FAR, far
    if min(first, second) <= 0.0 and _passed(shapes, shape, position, velocity, dt, corners):
        return PASSED, far
    # The triangle's point nearest to the axis' lower end, against the axis: exact for a ball, approximate for a shaft.
    wb, wc = closest_in_triangle(b_edge, c_edge, minus(end_of(shapes, shape, low), corner))
    place = shifted(shifted(corner, wb, b_edge), wc, c_edge)
    out = minus(place, closest_on_axis(shapes, shape, place))
    distance = length_of(out)
    # Behind the triangle, beyond an edge: another triangle lies between.
    if distance >= reach or scalar_product(out, normal) >= 0.0:
        return FAR, far
    stiffness = PI * radius * radius * law.stiffness
    weights = (1.0 - wb - wc, wb, wc)
    return NEAR, _NearPoint(corners, weights, place, divided(out, distance), distance, reach, stiffness)


@njit(**INLINED)
def _hold_off(model, state, shapes, response, dt, reference, wrench, shape, near):
    """Guard's force on a point of a triangle, with its speed and mobility in this substep.

    Model: model, response
    In:    shapes: twist and centre of the tool [m, rad, s], dt [s], reference [m] (n_tool, 3), shape, near
    Out:   state: node_force [N] (n_node, 3), wrench, added to [N, N m] (n_tool, 6), shapes: taxel_force
    """
    tool = shapes.shape_tool[shape]
    velocity, force, inverse_mass = state.node_velocity, state.node_force, model.node_inverse_mass
    mobility, out = response.tool_mobility, near.direction
    speed = -scalar_product(out, tool_velocity(shapes, tool, near.place))
    turn = vector_product(minus(near.place, row_of(shapes.tool_centre, tool)), out)
    lever = (out[0], out[1], out[2], turn[0], turn[1], turn[2])
    give = 0.0
    for row in range(6):
        for column in range(6):
            give += dt * lever[row] * mobility[tool, tool, row, column] * lever[column]
    for corner in range(3):
        node, weight = near.corners[corner], near.weights[corner]
        rate = dt * inverse_mass[node]
        speed += weight * scalar_product(out, shifted(row_of(velocity, node), rate, row_of(force, node)))
        give += weight * weight * rate
    closeness = near.reach / near.distance
    slope = near.stiffness * closeness**2
    push = near.stiffness * near.reach * (closeness - 1.0) - slope * dt * speed
    push = max(0.0, push / (1.0 + slope * dt * give))
    push_out = times(push, out)
    for corner in range(3):
        add_to_row(force, near.corners[corner], times(near.weights[corner], push_out))
    react(wrench, reference, tool, near.place, push_out)
    spread_force(shapes, shape, near.place, opposite(push_out))


@njit(**INNER)
def _passed(shapes, shape, position, velocity, dt, corners):
    """True if an end of a shape's axis went through a triangle in the last substep, or the axis now sticks in it."""
    highest = lowest = (0.0, 0.0, 0.0)
    for end in range(2):
        place = end_of(shapes, shape, end)
        now = _foot(place, position, velocity, 0.0, corners)
        before = minus(place, times(dt, tool_velocity(shapes, shapes.shape_tool[shape], place)))
        then = _foot(before, position, velocity, dt, corners)
        if then[0] > 0.0 >= now[0] and _is_inside(then, now):
            return True
        if now[0] > highest[0]:
            highest = now
        if now[0] < lowest[0]:
            lowest = now
    return highest[0] > 0.0 > lowest[0] and _is_inside(highest, lowest)


@njit(**INLINED)
def _foot(point, position, velocity, dt, corners):
    """Height of a point over a triangle dt ago [m], and its foot's weights of the corners b and c."""
    a = minus(row_of(position, corners[0]), times(dt, row_of(velocity, corners[0])))
    b = minus(minus(row_of(position, corners[1]), times(dt, row_of(velocity, corners[1]))), a)
    c = minus(minus(row_of(position, corners[2]), times(dt, row_of(velocity, corners[2]))), a)
    p, normal = minus(point, a), vector_product(b, c)
    squared = scalar_product(normal, normal)
    wb = scalar_product(vector_product(p, c), normal) / squared
    wc = scalar_product(vector_product(b, p), normal) / squared
    return scalar_product(p, normal) / math.sqrt(squared), wb, wc


@njit(**INLINED)
def _is_inside(high, low):
    """True if the path from above a triangle to below it, by `_foot`, leads through it, its edges included."""
    share = high[0] / (high[0] - low[0])
    wb = high[1] + share * (low[1] - high[1])
    wc = high[2] + share * (low[2] - high[2])
    return wb >= -EDGE_WIDTH and wc >= -EDGE_WIDTH and wb + wc <= 1.0 + EDGE_WIDTH


@njit(**INLINED)
def closest_in_triangle(b, c, p):
    """Point of a triangle nearest to p (Ericson, Real-Time Collision Detection, 2005, 5.1.5).

    In: b, c: edges from the corner a [m], p: from the corner a to the point [m]
    Returns the weights of the corners b and c.
    """
    bb, cc, bc = scalar_product(b, b), scalar_product(c, c), scalar_product(b, c)
    pb, pc = scalar_product(p, b), scalar_product(p, c)
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
