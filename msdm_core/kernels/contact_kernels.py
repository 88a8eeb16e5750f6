"""Contact of the surface of an organ with the shapes of tools: broad phase, pressure and friction."""

import math

import numpy as np
from numba import njit

from msdm_core.kernels.option_kernels import INLINED, INNER
from msdm_core.kernels.space_kernels import (
    add_to_row,
    divided,
    edge,
    length_of,
    minus,
    opposite,
    part_of_row,
    plus,
    row_of,
    scalar_product,
    set_row,
    shifted,
    take_from_row,
    times,
    vector_product,
)

# Margin for the motion of tissue towards a shape between two broad phases [m]: 1 mm in a haptic step of 1 ms is 1 m/s.
CANDIDATE_MARGIN = 1e-3

# Width of a core's border, as a share of the core's size (rounding).
BORDER = 1e-12

# Four quadrature points per surface triangle: centroids of its four congruent parts, equal weights.
QUADRATURE_COUNT = 4
QUADRATURE_WEIGHT = 0.25
QUADRATURE_BARYCENTRIC = np.array(
    [
        [1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0],
        [2.0 / 3.0, 1.0 / 6.0, 1.0 / 6.0],
        [1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0],
        [1.0 / 6.0, 1.0 / 6.0, 2.0 / 3.0],
    ]
)

# Share of the rise of the edges opposite to corners a, b and c at each point: 4 lambda_b lambda_c and so on.
QUADRATURE_RISE = 4.0 * QUADRATURE_BARYCENTRIC[:, [1, 2, 0]] * QUADRATURE_BARYCENTRIC[:, [2, 0, 1]]
_NONE = (0.0, 0.0, 0.0)

# A row of `contact_rows`, one engaged quadrature point: slope of its penetration g with its three corners, norms of
# those slopes, weighted area, pressure, unit vector e, stretch.
ROW_SLOPE, ROW_NORM, ROW_AREA, ROW_PRESSURE, ROW_OUT, ROW_STRETCH = 0, 9, 12, 13, 14, 17
# Then for `hold_contact`: speed of the tool along the slopes and at the point, 1 / (1 + h) along and across, the
# change of pressure and stretch so far, and the change in one sweep.
ROW_TOOL, ROW_GIVE, ROW_MORE, ROW_STEP = 20, 24, 26, 30
ROW_WIDTH = 34
# A row of `contact_places`: shape, number of the point, nodes of its corners.
PLACE_WIDTH = 5
# Factors of the sweeps of `hold_contact`, see there; small ones first, for the stiffest motions. A hold of 40 takes a
# sixth of the step's limit (`stability.contact_excess`), and one above 55 is refused. The product
# R(x) = prod (1 - w x) is at most 0.002 above x = 1 / 5.4: the rise of edges, which the sweeps leave out, makes motions
# from node to node up to twice as stiff, and these must be held in full.
SWEEPS = (1.0, 1.05, 1.7, 1.9, 5.4)


@njit(**INLINED)
def reach_margin(shapes, shape, duration):
    """Largest approach of tissue and a shape within a duration [m]."""
    tool = shapes.shape_tool[shape]
    speed = shapes.shape_radius[shape] * 0.0
    for part in range(6):
        # An angular part moves a point by at most its lever, taken as one metre: generous for a hand-held tool.
        speed += abs(shapes.tool_twist[tool, part])
    return CANDIDATE_MARGIN + 2.0 * speed * duration


@njit(**INLINED)
def core_box(shapes, shape, margin):
    """Lowest and highest x, y and z of a shape, widened by a margin [m]."""
    around = shapes.shape_radius[shape] + margin
    return _extent(shapes, shape, 0, around), _extent(shapes, shape, 1, around), _extent(shapes, shape, 2, around)


@njit(**INLINED)
def is_in_reach(position, surface, engaged, shapes, shape, triangle, margin, box):
    """True if a shape may touch a triangle, by `core_box` and spheres, or is in contact with it."""
    corners = row_of(surface, triangle)
    # Cheap first: box against box; then the sphere around the triangle against the axis.
    near = (
        _overlap(position, 0, corners, box[0])
        and _overlap(position, 1, corners, box[1])
        and _overlap(position, 2, corners, box[2])
    )
    if near:
        middle, size_squared = _middle(position, corners)
        away = minus(middle, closest_on_core(shapes, shape, middle))
        limit = math.sqrt(size_squared) + shapes.shape_radius[shape] + margin
        near = scalar_product(away, away) <= limit * limit
    return near or _is_held(engaged, shape, triangle)


@njit(**INNER)
def find_candidates(model, state, shapes, duration):
    """Broad phase: candidate triangles of each shape within a duration, by bounding boxes and spheres.

    Contact with a triangle faster than the margin begins one haptic step later; an engaged triangle always stays a
    candidate.

    Model: model: surface_triangles (n_surface, 3)
    In:    state: node_position [m] (n_node, 3), contact_engaged (n_shape, n_surface * 4), shapes, duration [s]
    Out:   state: contact_candidates, a row for each shape, ended by -1 (n_shape, n_surface)
    Returns the largest number of candidates of a shape.
    """
    position, surface = state.node_position, model.surface_triangles
    engaged, candidates = state.contact_engaged, state.contact_candidates
    most = 0
    for shape in range(shapes.shape_radius.shape[0]):
        margin = reach_margin(shapes, shape, duration)
        box = core_box(shapes, shape, margin)
        count = 0
        for triangle in range(surface.shape[0]):
            if is_in_reach(position, surface, engaged, shapes, shape, triangle, margin, box):
                candidates[shape, count] = triangle
                count += 1
        if count < candidates.shape[1]:
            candidates[shape, count] = -1
        most = max(most, count)
    return most


@njit(**INLINED)
def stretched(stretch, velocity, dt, normal):
    """Stretch of a tangential spring in static friction: u + dt v, without its part along the normal n [m].

    In: stretch: before [m], velocity: relative [m/s], dt [s], normal: of length 1
    """
    stretch = shifted(stretch, dt, velocity)
    return minus(stretch, times(scalar_product(stretch, normal), normal))


@njit(**INLINED)
def slipped(stretch, longest):
    """Factor on a stretch [m] for slip at a length above `longest` = mu p / k_t [m] (Coulomb); at most 1."""
    length = length_of(stretch)
    return longest / length if length > longest else 1.0


@njit(**INLINED)
def stick_or_slip(stretch, velocity, dt, normal, longest):
    """`stretched`, then shortened to `longest` [m] by slip."""
    stretch = stretched(stretch, velocity, dt, normal)
    return times(slipped(stretch, longest), stretch)


@njit(**INLINED)
def may_meet(position, surface, engaged, shapes, shape, triangle):
    """True if a shape is in contact with a triangle, or may contain one of its points now."""
    if _is_held(engaged, shape, triangle):
        return True
    # Quadrature points of the flat triangle lie within half of that radius around the middle; the rise adds less.
    middle, size_squared = _middle(position, row_of(surface, triangle))
    away = minus(middle, closest_on_core(shapes, shape, middle))
    limit = math.sqrt(size_squared) + shapes.shape_radius[shape]
    return not scalar_product(away, away) > limit * limit


@njit(**INLINED)
def facet_of(position, surface, triangle):
    """Nodes of a triangle, edges from its first corner to the others [m], unit normal, twice its area [m^2]."""
    corners = row_of(surface, triangle)
    b, c = edge(position, corners[0], corners[1]), edge(position, corners[0], corners[2])
    normal = vector_product(b, c)
    twice_area = length_of(normal)
    return corners, b, c, divided(normal, twice_area), twice_area


@njit(**INLINED)
def rise_of(position, model, triangle):
    """Rise of the middle of each edge of a triangle over the edge [m], of those opposite to corners a, b and c."""
    around, weight = model.surface_around, model.surface_rise
    at_a, at_b, at_c = _NONE, _NONE, _NONE
    for entry in range(around.shape[1]):
        place = row_of(position, around[triangle, entry])
        at_a = shifted(at_a, weight[triangle, entry, 0], place)
        at_b = shifted(at_b, weight[triangle, entry, 1], place)
        at_c = shifted(at_c, weight[triangle, entry, 2], place)
    return at_a, at_b, at_c


@njit(**INLINED)
def risen(place, rise, point):
    """Place of a quadrature point on the quadratic triangle, from that on the flat one."""
    place = shifted(place, QUADRATURE_RISE[point, 0], rise[0])
    place = shifted(place, QUADRATURE_RISE[point, 1], rise[1])
    return shifted(place, QUADRATURE_RISE[point, 2], rise[2])


@njit(**INLINED)
def slope_of(rows, row):
    """Slope of a point's penetration with its place: the sum of those with its corners."""
    return plus(
        plus(part_of_row(rows, row, ROW_SLOPE), part_of_row(rows, row, ROW_SLOPE + 3)),
        part_of_row(rows, row, ROW_SLOPE + 6),
    )


@njit(**INLINED)
def push_around(position, force, reference, wrench, tool, model, triangle, pushes):
    """Add the forces on the rise of a triangle's edges to the nodes around it, and their reaction."""
    around, weight = model.surface_around, model.surface_rise
    for entry in range(around.shape[1]):
        share = times(weight[triangle, entry, 0], pushes[0])
        share = shifted(share, weight[triangle, entry, 1], pushes[1])
        share = shifted(share, weight[triangle, entry, 2], pushes[2])
        node = around[triangle, entry]
        add_to_row(force, node, share)
        react(wrench, reference, tool, row_of(position, node), share)


@njit(**INLINED)
def press_point(
    position, velocity, rest_area, engaged, stretch_memory, rows, places, shapes, law, dt, shape, triangle, facet,
    rise, point, row,
):  # fmt: skip
    """Contact of one quadrature point with one shape, see `add_contact_forces`.

    Out: engaged, stretch_memory: of the point; `row` of rows and places, if it is engaged
    Returns True if it is engaged.
    """
    corners, b, c, normal, twice_area = facet
    tool, radius = shapes.shape_tool[shape], shapes.shape_radius[shape]
    friction = law.friction * shapes.shape_friction[shape]
    weighted_area = rest_area[triangle] * QUADRATURE_WEIGHT
    item = triangle * QUADRATURE_COUNT + point
    weights = row_of(QUADRATURE_BARYCENTRIC, point)
    flat = _mean(position, corners, weights)
    place = risen(flat, rise, point)
    near = closest_on_core(shapes, shape, place)
    away = minus(place, near)
    t = scalar_product(away, normal)
    across = minus(away, times(t, normal))
    chord_squared = radius * radius - scalar_product(across, across)
    if chord_squared <= 0.0:
        _release(engaged, stretch_memory, shape, item)
        return False
    s = math.sqrt(chord_squared)
    depth = s + t
    if depth <= 0.0 or (not engaged[shape, item] and t > 0.0):
        _release(engaged, stretch_memory, shape, item)
        return False
    engaged[shape, item] = 1
    # Unit vector against the ball's own normal at the exit of the line along n.
    out = divided(minus(times(s, normal), across), radius)
    pressure = law.stiffness * s * depth / radius

    # Slope of g at the point: (s^2 n - (2 s + t) rho) / (s r), without the directions along the core.
    scale = 1.0 / (s * radius)
    slope = times(scale, minus(times(chord_squared, normal), times(2.0 * s + t, across)))
    slope = _without_core(shapes, shape, near, slope)

    # Rotation of the normal with the corners: dn = -sum grad(lambda_a) (n . dx_a); its share of the slope
    # is along n. rho . grad(lambda_b) = rho . (c x n) / (2 A), for the corner c rho . (n x b) / (2 A).
    turn_b = scalar_product(across, vector_product(c, normal)) / twice_area
    turn_c = scalar_product(across, vector_product(normal, b)) / twice_area
    turn = -scale * depth * depth
    tb = turn * turn_b
    tc = turn * turn_c

    # Friction: a tangential spring moving with the surface and turning with the tool; it pulls at the corners, so
    # that both velocities are those on the flat triangle.
    stretch = row_of(stretch_memory[shape], item)
    turning = vector_product(part_of_row(shapes.tool_twist, tool, 3), stretch)
    relative = plus(_mean(velocity, corners, weights), minus(turning, tool_velocity(shapes, tool, flat)))
    longest = friction * pressure / law.tangential_stiffness
    stretch = stick_or_slip(stretch, relative, dt, out, longest)
    set_row(stretch_memory[shape], item, 0, stretch)

    places[row, 0] = shape
    places[row, 1] = item
    set_row(places, row, 2, corners)
    wa, wb, wc = weights
    set_row(rows, row, ROW_SLOPE, shifted(times(wa, slope), -tb - tc, normal))
    set_row(rows, row, ROW_SLOPE + 3, shifted(times(wb, slope), tb, normal))
    set_row(rows, row, ROW_SLOPE + 6, shifted(times(wc, slope), tc, normal))
    steepness = length_of(slope)
    norms = (wa * steepness + abs(tb + tc), wb * steepness + abs(tb), wc * steepness + abs(tc))
    set_row(rows, row, ROW_NORM, norms)
    rows[row, ROW_AREA] = weighted_area
    rows[row, ROW_PRESSURE] = pressure
    set_row(rows, row, ROW_OUT, out)
    set_row(rows, row, ROW_STRETCH, stretch)
    return True


@njit(**INLINED)
def first_push(rows, row, law):
    """Pressure times area of a point [N] and its friction force [N], from `press_point`."""
    drag = times(rows[row, ROW_AREA] * law.tangential_stiffness, part_of_row(rows, row, ROW_STRETCH))
    return rows[row, ROW_AREA] * rows[row, ROW_PRESSURE], drag


@njit(**INNER)
def add_contact_forces(model, state, shapes, law, dt, candidate_count, reference, wrench):
    """Contact forces of every shape on its candidate triangles at present, and the reaction on the tools.

    The penetration of a quadrature point keeps rising with depth. With d from the shape's core to the point, n the
    surface normal, t = d . n, rho = d - t n and s = sqrt(r^2 - rho^2) the half chord, the line through the point along
    n leaves the ball t + s below the point. The energy per area is (k_p / 2) g^2 with g = s (s + t) / r: to first order
    the radial penetration r - |d|, yet growing without bound as the ball sinks below the surface; a radial penetration
    would fall again there, and the ball would tunnel. Forces are its exact gradient, the rotation of n with the corners
    included, so that action and reaction balance, torque too. Friction pulls with k_t times the stretch.
    A point engages when the shape first meets it from outside (s + t > 0 with t < 0 inside the ball) and stays engaged
    until separation, so that the far side of a thin organ is never taken for the near side.
    `hold_contact` must follow, for the change of pressure and friction until the end of the substep.

    Model: model: surface_triangles (n_surface, 3), surface_rest_area [m^2] (n_surface,); law
    In:    state: node_position [m], node_velocity [m/s] (n_node, 3), contact_candidates; shapes, dt [s],
           candidate_count, reference: point of each tool's torque [m] (n_tool, 3)
    Out:   state: node_force, added to [N] (n_node, 3), contact_engaged (n_shape, n_surface * 4), contact_stretch [m]
           (n_shape, n_surface * 4, 3), contact_rows, contact_places; wrench, added to [N, N m] (n_tool, 6)
    Returns the number of engaged points: rows of contact_rows and contact_places.
    """
    position, velocity, force = state.node_position, state.node_velocity, state.node_force
    engaged, stretch_memory, candidates = state.contact_engaged, state.contact_stretch, state.contact_candidates
    rows, places = state.contact_rows, state.contact_places
    surface, rest_area = model.surface_triangles, model.surface_rest_area
    count = 0
    for shape in range(shapes.shape_radius.shape[0]):
        tool = shapes.shape_tool[shape]
        for entry in range(candidate_count):
            triangle = candidates[shape, entry]
            if triangle < 0:
                break
            if not may_meet(position, surface, engaged, shapes, shape, triangle):
                continue
            facet, rise = facet_of(position, surface, triangle), rise_of(position, model, triangle)
            push_a, push_b, push_c = _NONE, _NONE, _NONE
            before = count
            for point in range(QUADRATURE_COUNT):
                if not press_point(
                    position, velocity, rest_area, engaged, stretch_memory, rows, places, shapes, law, dt, shape,
                    triangle, facet, rise, point, count,
                ):  # fmt: skip
                    continue
                push, drag = first_push(rows, count, law)
                # A loop: unrolled by hand, the call would be compiled for each constant corner.
                for corner in range(3):
                    node, weight = places[count, 2 + corner], QUADRATURE_BARYCENTRIC[point, corner]
                    _push_corner(
                        position, force, reference, wrench, tool, node, rows, count, corner, push, weight, drag
                    )
                along = opposite(times(push, slope_of(rows, count)))
                push_a = shifted(push_a, QUADRATURE_RISE[point, 0], along)
                push_b = shifted(push_b, QUADRATURE_RISE[point, 1], along)
                push_c = shifted(push_c, QUADRATURE_RISE[point, 2], along)
                count += 1
            if count > before:
                push_around(position, force, reference, wrench, tool, model, triangle, (push_a, push_b, push_c))
    return count


@njit(**INLINED)
def hold_rates(law, dt):
    """Pressure per rate of the penetration, and traction per rate of the stretch, within a substep [N s/m^3]."""
    along = law.stiffness * dt + law.damping
    across = law.tangential_stiffness * dt
    if not law.friction > 0.0:
        across = along * 0.0
    return along, across


@njit(**INLINED)
def hold_share(rows, number, corner, weight, along, across, dt):
    """Hold of a point on one of its corners, times dt^2 [kg]."""
    total = rows[number, ROW_NORM] + rows[number, ROW_NORM + 1] + rows[number, ROW_NORM + 2]
    share = max(along * total * rows[number, ROW_NORM + corner], across * weight)
    return dt * rows[number, ROW_AREA] * share


@njit(**INLINED)
def begin_hold(position, shapes, rows, places, number):
    """Start of a point's hold: tool speed along its slopes and at the point, no change of pressure and stretch yet."""
    point = places[number, 1] % QUADRATURE_COUNT
    tool = shapes.shape_tool[places[number, 0]]
    stretch = part_of_row(rows, number, ROW_STRETCH)
    # The stretch turns with the tool.
    across = vector_product(stretch, part_of_row(shapes.tool_twist, tool, 3))
    rate = stretch[0] * 0.0
    for corner in range(3):
        velocity = tool_velocity(shapes, tool, row_of(position, places[number, 2 + corner]))
        rate += scalar_product(part_of_row(rows, number, ROW_SLOPE + 3 * corner), velocity)
        across = shifted(across, QUADRATURE_BARYCENTRIC[point, corner], velocity)
    rows[number, ROW_TOOL] = rate
    set_row(rows, number, ROW_TOOL + 1, across)
    for part in range(4):
        rows[number, ROW_MORE + part] = 0.0


@njit(**INLINED)
def set_give(rows, places, hold, inverse_mass, number):
    """Set 1 / (1 + h) of a point, along its slopes and across them."""
    point = places[number, 1] % QUADRATURE_COUNT
    held = 0.0
    stuck = 0.0
    total = 0.0
    for corner in range(3):
        node = places[number, 2 + corner]
        share = hold[node] * inverse_mass[node]
        held += rows[number, ROW_NORM + corner] * share
        stuck += QUADRATURE_BARYCENTRIC[point, corner] * share
        total += rows[number, ROW_NORM + corner]
    # In the core of a shape a point's force has no direction, and the point no rate.
    rows[number, ROW_GIVE] = total / (total + held) if total > 0.0 else 0.0
    rows[number, ROW_GIVE + 1] = 1.0 / (1.0 + stuck)


@njit(**INLINED)
def sweep_point(velocity, force, inverse_mass, stretch_memory, shapes, law, dt, decay, rows, places, number, sweep):
    """One sweep's change of a point's pressure and stretch; the last sweep stores the stretch of a slipping point."""
    along = law.stiffness * dt + law.damping
    shape = places[number, 0]
    item = places[number, 1]
    point = item % QUADRATURE_COUNT
    rate = -rows[number, ROW_TOOL]
    across = opposite(part_of_row(rows, number, ROW_TOOL + 1))
    for corner in range(3):
        node = places[number, 2 + corner]
        after = shifted(times(decay, row_of(velocity, node)), dt * inverse_mass[node], row_of(force, node))
        rate += scalar_product(part_of_row(rows, number, ROW_SLOPE + 3 * corner), after)
        across = shifted(across, QUADRATURE_BARYCENTRIC[point, corner], after)
    pressure = rows[number, ROW_PRESSURE]
    before = rows[number, ROW_MORE]
    more = before + SWEEPS[sweep] * rows[number, ROW_GIVE] * (along * rate - before)
    more = max(more, -pressure)
    rows[number, ROW_MORE] = more
    rows[number, ROW_STEP] = more - before
    # From the stretch of the last sweep towards that of the velocities.
    added = part_of_row(rows, number, ROW_MORE + 1)
    last = plus(part_of_row(rows, number, ROW_STRETCH), added)
    give = SWEEPS[sweep] * rows[number, ROW_GIVE + 1]
    stretch = stretched(last, minus(times(dt, across), added), give, part_of_row(rows, number, ROW_OUT))
    longest = law.friction * shapes.shape_friction[shape] * (pressure + more) / law.tangential_stiffness
    kept = slipped(stretch, longest)
    stretch = times(kept, stretch)
    set_row(rows, number, ROW_STEP + 1, minus(stretch, last))
    # The step as the row holds it, which may be in float32.
    set_row(rows, number, ROW_MORE + 1, plus(added, part_of_row(rows, number, ROW_STEP + 1)))
    if kept < 1.0 and sweep == len(SWEEPS) - 1:
        set_row(stretch_memory[shape], item, 0, stretch)


@njit(**INLINED)
def more_push(rows, number, law):
    """Change in the last sweep: pressure times area [N] and friction force [N]."""
    drag = times(rows[number, ROW_AREA] * law.tangential_stiffness, part_of_row(rows, number, ROW_STEP + 1))
    return rows[number, ROW_AREA] * rows[number, ROW_STEP], drag


@njit(**INNER)
def hold_contact(model, state, shapes, law, dt, decay, row_count, reference, wrench):
    """Implicit contact: pressure and friction of each quadrature point at the END of the substep.

    `add_contact_forces` has applied k_p g and k_t u. The pressure at the end is larger by q = (k_p dt + c_p) g', the
    friction by k_t dt u', with the rates g', u' of the velocities after all forces. Sweeps over the points approach it:
    each adds w (q - the sum so far) / (1 + h), with w of `SWEEPS`, and all points read the forces after the
    previous sweep, so that their order does not matter. h is the mean over the corners of H_a / m_a, with
    H_a = dt sum (k_p dt + c_p) A |dg/dx_a| sum_b |dg/dx_b| over the points around a node (or, if larger, k_t dt A times
    its weight): a point's share of a node's mass is its share of the node's hold (mass splitting, Tonge, Benevolenski
    and Voroshilov 2012). The velocities are then those of larger masses, which are symmetric: contact gives no energy,
    and `stability.contact_excess` bounds its part of the step's limit.
    At rest under balanced forces nothing is added: an equilibrium does not depend on dt.
    Rates and pushes are those at the corners, without the rise of the edges: a symmetric part of the exact slope.
    A pressure does not become negative; friction is at most mu times the final pressure (Coulomb). Tools keep their
    velocity at the start of the substep.

    Model: model: node_inverse_mass [1/kg] (n_node,); law
    In:    state: node_position [m], node_velocity [m/s] (n_node, 3), contact_rows and contact_places of
           `add_contact_forces`, row_count; shapes, dt [s], decay: factor of a substep on velocities, reference: point
           of each tool's torque [m] (n_tool, 3)
    Out:   state: node_force, added to [N] (n_node, 3), contact_stretch [m] (n_shape, n_surface * 4, 3), contact_hold:
           scratch, 0 before and after (n_node,); wrench, added to [N, N m] (n_tool, 6)
    """
    position, velocity, force = state.node_position, state.node_velocity, state.node_force
    inverse_mass, hold, stretch_memory = model.node_inverse_mass, state.contact_hold, state.contact_stretch
    rows, places = state.contact_rows, state.contact_places
    along, across = hold_rates(law, dt)
    for number in range(row_count):
        point = places[number, 1] % QUADRATURE_COUNT
        for corner in range(3):
            weight = QUADRATURE_BARYCENTRIC[point, corner]
            hold[places[number, 2 + corner]] += hold_share(rows, number, corner, weight, along, across, dt)
        begin_hold(position, shapes, rows, places, number)
    for number in range(row_count):
        set_give(rows, places, hold, inverse_mass, number)
    for sweep in range(len(SWEEPS)):
        for number in range(row_count):
            sweep_point(
                velocity, force, inverse_mass, stretch_memory, shapes, law, dt, decay, rows, places, number, sweep
            )
        for number in range(row_count):
            point = places[number, 1] % QUADRATURE_COUNT
            tool = shapes.shape_tool[places[number, 0]]
            push, drag = more_push(rows, number, law)
            for corner in range(3):
                node = places[number, 2 + corner]
                weight = QUADRATURE_BARYCENTRIC[point, corner]
                _push_corner(position, force, reference, wrench, tool, node, rows, number, corner, push, weight, drag)
                hold[node] = 0.0


@njit(**INLINED)
def _extent(shapes, shape, axis, around):
    """Lowest and highest coordinate of the core of a shape, widened by `around` [m]."""
    first, second = shapes.shape_ends[shape, 0, axis], shapes.shape_ends[shape, 1, axis]
    around += abs(shapes.shape_span[shape, axis])
    return min(first, second) - around, max(first, second) + around


@njit(**INLINED)
def _overlap(position, axis, corners, interval):
    """True if a triangle reaches into an interval of one coordinate."""
    first, second, third = position[corners[0], axis], position[corners[1], axis], position[corners[2], axis]
    return max(first, second, third) >= interval[0] and min(first, second, third) <= interval[1]


@njit(**INLINED)
def _mean(values, nodes, weights):
    """Weighted mean of three nodes' values."""
    part = shifted(times(weights[0], row_of(values, nodes[0])), weights[1], row_of(values, nodes[1]))
    return shifted(part, weights[2], row_of(values, nodes[2]))


@njit(**INLINED)
def rigid_velocity(twist, tool, offset):
    """Velocity v + w x r [m/s] at an offset r [m] from a centre of mass, of twists (n_tool, 6) [m/s, rad/s]."""
    x, y, z = offset
    return (
        twist[tool, 0] + twist[tool, 4] * z - twist[tool, 5] * y,
        twist[tool, 1] + twist[tool, 5] * x - twist[tool, 3] * z,
        twist[tool, 2] + twist[tool, 3] * y - twist[tool, 4] * x,
    )


@njit(**INLINED)
def tool_velocity(shapes, tool, point):
    """Velocity of a tool at a point [m/s]."""
    return rigid_velocity(shapes.tool_twist, tool, minus(point, row_of(shapes.tool_centre, tool)))


@njit(**INLINED)
def _middle(position, corners):
    """Centroid of a triangle [m], and the squared radius of the sphere around it through the farthest corner [m^2]."""
    a, b, c = row_of(position, corners[0]), row_of(position, corners[1]), row_of(position, corners[2])
    middle = divided(plus(plus(a, b), c), 3.0)
    to_a, to_b, to_c = minus(a, middle), minus(b, middle), minus(c, middle)
    return middle, max(scalar_product(to_a, to_a), scalar_product(to_b, to_b), scalar_product(to_c, to_c))


@njit(**INLINED)
def _is_held(engaged, shape, triangle):
    """True if any point of a triangle is in contact with a shape."""
    first = triangle * QUADRATURE_COUNT
    for point in range(first, first + QUADRATURE_COUNT):
        if engaged[shape, point]:
            return True
    return False


@njit(**INLINED)
def end_of(shapes, shape, end):
    """First (0) or second (1) end of a shape's axis [m]."""
    return row_of(shapes.shape_ends[shape], end)


@njit(**INLINED)
def closest_on_axis(shapes, shape, point):
    """Point of a shape's axis nearest to a point [m]."""
    first = end_of(shapes, shape, 0)
    axis = minus(end_of(shapes, shape, 1), first)
    length_squared = scalar_product(axis, axis)
    along = 0.0
    if length_squared > 0.0:
        along = min(1.0, max(0.0, scalar_product(minus(point, first), axis) / length_squared))
    return shifted(first, along, axis)


@njit(**INLINED)
def closest_on_core(shapes, shape, point):
    """Point of a shape's core nearest to a point [m]: on its axis, or across it in a rounded box."""
    near, span = closest_on_axis(shapes, shape, point), row_of(shapes.shape_span, shape)
    squared = scalar_product(span, span)
    if squared > 0.0:
        across = min(1.0, max(-1.0, scalar_product(minus(point, near), span) / squared))
        near = shifted(near, across, span)
    return near


@njit(**INLINED)
def _release(engaged, stretch_memory, shape, item):
    """End the contact of one quadrature point with one shape."""
    engaged[shape, item] = 0
    for axis in range(3):
        stretch_memory[shape, item, axis] = 0.0


@njit(**INLINED)
def corner_force(rows, number, corner, push, weight, drag):
    """Corner's share of a point's force, -push dg/dx - weight drag [N]."""
    return minus(times(-push, part_of_row(rows, number, ROW_SLOPE + 3 * corner)), times(weight, drag))


@njit(**INLINED)
def _push_corner(position, force, reference, wrench, tool, node, rows, number, corner, push, weight, drag):
    """Add a corner's share of a point's force, and its reaction."""
    share = corner_force(rows, number, corner, push, weight, drag)
    add_to_row(force, node, share)
    react(wrench, reference, tool, row_of(position, node), share)


@njit(**INLINED)
def react(wrench, reference, tool, point, force):
    """Subtract a force on the tissue at a point, and its torque about the reference, from the wrench on a tool."""
    take_from_row(wrench, tool, 0, force)
    take_from_row(wrench, tool, 3, vector_product(minus(point, row_of(reference, tool)), force))


@njit(**INLINED)
def _without_core(shapes, shape, near, slope):
    """Remove the part of a slope along a shape's core, if its nearest point lies strictly inside its borders."""
    first = end_of(shapes, shape, 0)
    axis, place = minus(end_of(shapes, shape, 1), first), minus(near, first)
    length_squared = scalar_product(axis, axis)
    if length_squared > 0.0:
        along = scalar_product(place, axis)
        if BORDER * length_squared < along < (1.0 - BORDER) * length_squared:
            slope = minus(slope, times(scalar_product(slope, axis) / length_squared, axis))
    span = row_of(shapes.shape_span, shape)
    length_squared = scalar_product(span, span)
    if length_squared > 0.0 and abs(scalar_product(place, span)) < (1.0 - BORDER) * length_squared:
        slope = minus(slope, times(scalar_product(slope, span) / length_squared, span))
    return slope


@njit(**INLINED)
def lag_point(position, surface, stretch, shapes, response, shape, triangle, point):
    """Shift the stretch of a point by its tool's lag."""
    tool, item = shapes.shape_tool[shape], triangle * QUADRATURE_COUNT + point
    offset = opposite(row_of(shapes.tool_centre, tool))
    for corner in range(3):
        offset = shifted(offset, QUADRATURE_BARYCENTRIC[point, corner], row_of(position, surface[triangle, corner]))
    take_from_row(stretch[shape], item, 0, rigid_velocity(response.tool_lag, tool, offset))


@njit(**INNER)
def stretch_by_lag(model, state, shapes, response, candidate_count):
    """Shift the stretch of static friction by each tool's lag behind its place in MuJoCo at the end of the step.

    Model: model: surface_triangles (n_surface, 3)
    In:    state: node_position [m] (n_node, 3), contact_engaged, contact_candidates; shapes: tool_centre [m]
           (n_tool, 3); response: tool_lag [m, rad] (n_tool, 6); candidate_count
    Out:   state: contact_stretch [m] (n_shape, n_surface * 4, 3)
    """
    position, surface = state.node_position, model.surface_triangles
    engaged, stretch, candidates = state.contact_engaged, state.contact_stretch, state.contact_candidates
    for shape in range(shapes.shape_radius.shape[0]):
        for entry in range(candidate_count):
            triangle = candidates[shape, entry]
            if triangle < 0:
                break
            for point in range(QUADRATURE_COUNT):
                if engaged[shape, triangle * QUADRATURE_COUNT + point]:
                    lag_point(position, surface, stretch, shapes, response, shape, triangle, point)
