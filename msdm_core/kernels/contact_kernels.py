"""Contact of the surface of an organ with the shapes of tools: broad phase, pressure and friction."""

import math

import numpy as np
from numba import njit

from msdm_core.kernels.element_kernels import corner_gradient, edge
from msdm_core.kernels.option_kernels import INLINED, INLINED_KERNEL, INNER

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

# A row of `contact_rows`, one engaged quadrature point: slope of its penetration g with its three corners, norms of
# those slopes, weighted area, pressure, unit vector e, stretch.
ROW_SLOPE, ROW_NORM, ROW_AREA, ROW_PRESSURE, ROW_OUT, ROW_STRETCH = 0, 9, 12, 13, 14, 17
# Then for `hold_contact`: speed of the tool along the slopes and at the point, 1 / (1 + h) along and across, the
# change of pressure and stretch so far, and the change in one sweep.
ROW_TOOL, ROW_GIVE, ROW_MORE, ROW_STEP = 20, 24, 26, 30
ROW_WIDTH = 34
# A row of `contact_places`: shape, number of the point, nodes of its corners.
PLACE_WIDTH = 5
# Factors of the sweeps of `hold_contact`, see there.
SWEEPS = (1.0, 2.0, 2.0)


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
def core_box(ends, spans, shape, around):
    """Lowest and highest x, y and z of the core of a shape, widened by `around` [m]: six numbers."""
    low_x, high_x = _extent(ends, spans, shape, 0, around)
    low_y, high_y = _extent(ends, spans, shape, 1, around)
    low_z, high_z = _extent(ends, spans, shape, 2, around)
    return low_x, high_x, low_y, high_y, low_z, high_z


@njit(**INLINED)
def is_in_reach(position, surface, engaged, ends, spans, shape, triangle, radius, margin, box):
    """True if a shape may touch a triangle, by `core_box` and spheres, or is in contact with it."""
    a = surface[triangle, 0]
    b = surface[triangle, 1]
    c = surface[triangle, 2]
    # Cheap first: box against box; then the sphere around the triangle against the axis.
    near = (
        _overlap(position, 0, a, b, c, box[0], box[1])
        and _overlap(position, 1, a, b, c, box[2], box[3])
        and _overlap(position, 2, a, b, c, box[4], box[5])
    )
    if near:
        x, y, z, size_squared = _middle(position, a, b, c)
        px, py, pz = closest_on_core(ends, spans, shape, x, y, z)
        limit = math.sqrt(size_squared) + radius + margin
        near = (x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2 <= limit * limit
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
    # Arrays are read from the structures before the loops: inside, each access would cost a reference count.
    position, ends, spans, surface = state.node_position, shapes.shape_ends, shapes.shape_span, model.surface_triangles
    engaged, candidates = state.contact_engaged, state.contact_candidates
    most = 0
    for shape in range(shapes.shape_radius.shape[0]):
        radius, margin = shapes.shape_radius[shape], reach_margin(shapes, shape, duration)
        box = core_box(ends, spans, shape, radius + margin)
        count = 0
        for triangle in range(surface.shape[0]):
            if is_in_reach(position, surface, engaged, ends, spans, shape, triangle, radius, margin, box):
                candidates[shape, count] = triangle
                count += 1
        if count < candidates.shape[1]:
            candidates[shape, count] = -1
        most = max(most, count)
    return most


@njit(**INLINED)
def stretched(ux, uy, uz, vx, vy, vz, dt, nx, ny, nz):
    """Stretch of a tangential spring in static friction: u + dt v, without its part along the normal n.

    In: u: stretch before [m], v: relative velocity [m/s], dt [s], n: unit normal
    Returns u [m], three numbers.
    """
    ux += dt * vx
    uy += dt * vy
    uz += dt * vz
    along = ux * nx + uy * ny + uz * nz
    return ux - along * nx, uy - along * ny, uz - along * nz


@njit(**INLINED)
def slipped(ux, uy, uz, longest):
    """Factor on a stretch u [m] for slip at a length above `longest` = mu p / k_t [m] (Coulomb); at most 1."""
    length = math.sqrt(ux * ux + uy * uy + uz * uz)
    return longest / length if length > longest else 1.0


@njit(**INLINED)
def stick_or_slip(ux, uy, uz, vx, vy, vz, dt, nx, ny, nz, longest):
    """`stretched`, then shortened to `longest` [m] by slip."""
    ux, uy, uz = stretched(ux, uy, uz, vx, vy, vz, dt, nx, ny, nz)
    kept = slipped(ux, uy, uz, longest)
    return kept * ux, kept * uy, kept * uz


@njit(**INLINED)
def may_meet(position, surface, engaged, ends, spans, shape, triangle, radius):
    """True if a shape is in contact with a triangle, or may contain one of its points now."""
    if _is_held(engaged, shape, triangle):
        return True
    # Quadrature points lie within half of that radius around the middle.
    a, b, c = surface[triangle, 0], surface[triangle, 1], surface[triangle, 2]
    x, y, z, size_squared = _middle(position, a, b, c)
    px, py, pz = closest_on_core(ends, spans, shape, x, y, z)
    limit = 0.5 * math.sqrt(size_squared) + radius
    return not (x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2 > limit * limit


@njit(**INLINED)
def facet_of(position, surface, triangle):
    """Nodes of a triangle, edges from its first corner [m], unit normal, twice its area [m^2]: 13 numbers."""
    a = surface[triangle, 0]
    b = surface[triangle, 1]
    c = surface[triangle, 2]
    b_edge, c_edge = edge(position, a, b), edge(position, a, c)
    bx, by, bz = b_edge
    cx, cy, cz = c_edge
    nx, ny, nz = corner_gradient(b_edge, c_edge)
    twice_area = math.sqrt(nx * nx + ny * ny + nz * nz)
    nx /= twice_area
    ny /= twice_area
    nz /= twice_area
    return a, b, c, bx, by, bz, cx, cy, cz, nx, ny, nz, twice_area


@njit(**INLINED)
def press_point(
    position, velocity, rest_area, engaged, stretch_memory, rows, places, shapes, law, dt, shape, triangle, facet,
    point, row,
):  # fmt: skip
    """Contact of one quadrature point with one shape, see `add_contact_forces`.

    Out: engaged, stretch_memory: of the point; `row` of rows and places, if it is engaged
    Returns True if it is engaged.
    """
    a, b, c, bx, by, bz, cx, cy, cz, nx, ny, nz, twice_area = facet
    ends, spans, centre, twist = shapes.shape_ends, shapes.shape_span, shapes.tool_centre, shapes.tool_twist
    tool, radius = shapes.shape_tool[shape], shapes.shape_radius[shape]
    friction = law.friction * shapes.shape_friction[shape]
    weighted_area = rest_area[triangle] * QUADRATURE_WEIGHT
    item = triangle * QUADRATURE_COUNT + point
    wa = QUADRATURE_BARYCENTRIC[point, 0]
    wb = QUADRATURE_BARYCENTRIC[point, 1]
    wc = QUADRATURE_BARYCENTRIC[point, 2]
    x, y, z = _mean(position, a, b, c, wa, wb, wc)
    px, py, pz = closest_on_core(ends, spans, shape, x, y, z)
    t = (x - px) * nx + (y - py) * ny + (z - pz) * nz
    rx = x - px - t * nx
    ry = y - py - t * ny
    rz = z - pz - t * nz
    chord_squared = radius * radius - (rx * rx + ry * ry + rz * rz)
    if chord_squared <= 0.0:
        _release(engaged, stretch_memory, shape, item)
        return False
    s = math.sqrt(chord_squared)
    depth = s + t
    if depth <= 0.0 or (not engaged[shape, item] and t > 0.0):
        _release(engaged, stretch_memory, shape, item)
        return False
    engaged[shape, item] = 1
    # e: unit vector against the ball's own normal at the exit of the line along n.
    ex = (s * nx - rx) / radius
    ey = (s * ny - ry) / radius
    ez = (s * nz - rz) / radius
    pressure = law.stiffness * s * depth / radius

    # Slope of g at the point: (s^2 n - (2 s + t) rho) / (s r), without the directions along the core.
    scale = 1.0 / (s * radius)
    gx = scale * (chord_squared * nx - (2.0 * s + t) * rx)
    gy = scale * (chord_squared * ny - (2.0 * s + t) * ry)
    gz = scale * (chord_squared * nz - (2.0 * s + t) * rz)
    gx, gy, gz = _without_core(ends, spans, shape, px, py, pz, gx, gy, gz)

    # Rotation of the normal with the corners: dn = -sum grad(lambda_a) (n . dx_a); its share of the slope
    # is along n. rho . grad(lambda_b) = rho . (c x n) / (2 A), for the corner c rho . (n x b) / (2 A).
    turn_b = (rx * (cy * nz - cz * ny) + ry * (cz * nx - cx * nz) + rz * (cx * ny - cy * nx)) / twice_area
    turn_c = (rx * (ny * bz - nz * by) + ry * (nz * bx - nx * bz) + rz * (nx * by - ny * bx)) / twice_area
    turn = -scale * depth * depth
    tb = turn * turn_b
    tc = turn * turn_c

    # Friction: a tangential spring moving with the surface and turning with the tool.
    ux = stretch_memory[shape, item, 0]
    uy = stretch_memory[shape, item, 1]
    uz = stretch_memory[shape, item, 2]
    vx, vy, vz = _mean(velocity, a, b, c, wa, wb, wc)
    ox, oy, oz = tool_velocity(twist, centre, tool, x, y, z)
    vx += twist[tool, 4] * uz - twist[tool, 5] * uy - ox
    vy += twist[tool, 5] * ux - twist[tool, 3] * uz - oy
    vz += twist[tool, 3] * uy - twist[tool, 4] * ux - oz
    longest = friction * pressure / law.tangential_stiffness
    ux, uy, uz = stick_or_slip(ux, uy, uz, vx, vy, vz, dt, ex, ey, ez, longest)
    stretch_memory[shape, item, 0] = ux
    stretch_memory[shape, item, 1] = uy
    stretch_memory[shape, item, 2] = uz

    places[row, 0] = shape
    places[row, 1] = item
    places[row, 2] = a
    places[row, 3] = b
    places[row, 4] = c
    _put_slope(rows, row, 0, wa, -tb - tc, gx, gy, gz, nx, ny, nz)
    _put_slope(rows, row, 1, wb, tb, gx, gy, gz, nx, ny, nz)
    _put_slope(rows, row, 2, wc, tc, gx, gy, gz, nx, ny, nz)
    steepness = math.sqrt(gx * gx + gy * gy + gz * gz)
    rows[row, ROW_NORM] = wa * steepness + abs(tb + tc)
    rows[row, ROW_NORM + 1] = wb * steepness + abs(tb)
    rows[row, ROW_NORM + 2] = wc * steepness + abs(tc)
    rows[row, ROW_AREA] = weighted_area
    rows[row, ROW_PRESSURE] = pressure
    rows[row, ROW_OUT] = ex
    rows[row, ROW_OUT + 1] = ey
    rows[row, ROW_OUT + 2] = ez
    rows[row, ROW_STRETCH] = ux
    rows[row, ROW_STRETCH + 1] = uy
    rows[row, ROW_STRETCH + 2] = uz
    return True


@njit(**INLINED)
def first_push(rows, row, law):
    """Pressure times area of a point [N] and its friction force [N], from `press_point`."""
    drag = rows[row, ROW_AREA] * law.tangential_stiffness
    ux, uy, uz = rows[row, ROW_STRETCH] * drag, rows[row, ROW_STRETCH + 1] * drag, rows[row, ROW_STRETCH + 2] * drag
    return rows[row, ROW_AREA] * rows[row, ROW_PRESSURE], ux, uy, uz


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
    ends, spans = shapes.shape_ends, shapes.shape_span
    count = 0
    for shape in range(shapes.shape_radius.shape[0]):
        tool = shapes.shape_tool[shape]
        for entry in range(candidate_count):
            triangle = candidates[shape, entry]
            if triangle < 0:
                break
            if not may_meet(position, surface, engaged, ends, spans, shape, triangle, shapes.shape_radius[shape]):
                continue
            facet = facet_of(position, surface, triangle)
            for point in range(QUADRATURE_COUNT):
                if not press_point(
                    position, velocity, rest_area, engaged, stretch_memory, rows, places, shapes, law, dt, shape,
                    triangle, facet, point, count,
                ):  # fmt: skip
                    continue
                push, ux, uy, uz = first_push(rows, count, law)
                # A loop: unrolled by hand, the call would be compiled for each constant corner.
                for corner in range(3):
                    node, weight = places[count, 2 + corner], QUADRATURE_BARYCENTRIC[point, corner]
                    _push_corner(
                        position, force, reference, wrench, tool, node, rows, count, corner, push, weight, ux, uy, uz
                    )
                count += 1
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
    centre, twist = shapes.tool_centre, shapes.tool_twist
    point = places[number, 1] % QUADRATURE_COUNT
    tool = shapes.shape_tool[places[number, 0]]
    ux = rows[number, ROW_STRETCH]
    uy = rows[number, ROW_STRETCH + 1]
    uz = rows[number, ROW_STRETCH + 2]
    # The stretch turns with the tool.
    vx = twist[tool, 5] * uy - twist[tool, 4] * uz
    vy = twist[tool, 3] * uz - twist[tool, 5] * ux
    vz = twist[tool, 4] * ux - twist[tool, 3] * uy
    rate = ux * 0.0
    for corner in range(3):
        node = places[number, 2 + corner]
        weight = QUADRATURE_BARYCENTRIC[point, corner]
        ox, oy, oz = tool_velocity(twist, centre, tool, position[node, 0], position[node, 1], position[node, 2])
        slope = ROW_SLOPE + 3 * corner
        rate += rows[number, slope] * ox + rows[number, slope + 1] * oy + rows[number, slope + 2] * oz
        vx += weight * ox
        vy += weight * oy
        vz += weight * oz
    rows[number, ROW_TOOL] = rate
    rows[number, ROW_TOOL + 1] = vx
    rows[number, ROW_TOOL + 2] = vy
    rows[number, ROW_TOOL + 3] = vz
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
    vx = -rows[number, ROW_TOOL + 1]
    vy = -rows[number, ROW_TOOL + 2]
    vz = -rows[number, ROW_TOOL + 3]
    for corner in range(3):
        node = places[number, 2 + corner]
        weight = QUADRATURE_BARYCENTRIC[point, corner]
        gain = dt * inverse_mass[node]
        ox = decay * velocity[node, 0] + gain * force[node, 0]
        oy = decay * velocity[node, 1] + gain * force[node, 1]
        oz = decay * velocity[node, 2] + gain * force[node, 2]
        slope = ROW_SLOPE + 3 * corner
        rate += rows[number, slope] * ox + rows[number, slope + 1] * oy + rows[number, slope + 2] * oz
        vx += weight * ox
        vy += weight * oy
        vz += weight * oz
    pressure = rows[number, ROW_PRESSURE]
    before = rows[number, ROW_MORE]
    more = before + SWEEPS[sweep] * rows[number, ROW_GIVE] * (along * rate - before)
    more = max(more, -pressure)
    rows[number, ROW_MORE] = more
    rows[number, ROW_STEP] = more - before
    # From the stretch of the last sweep towards that of the velocities.
    ux = rows[number, ROW_STRETCH] + rows[number, ROW_MORE + 1]
    uy = rows[number, ROW_STRETCH + 1] + rows[number, ROW_MORE + 2]
    uz = rows[number, ROW_STRETCH + 2] + rows[number, ROW_MORE + 3]
    give = SWEEPS[sweep] * rows[number, ROW_GIVE + 1]
    qx, qy, qz = stretched(
        ux, uy, uz, dt * vx - rows[number, ROW_MORE + 1], dt * vy - rows[number, ROW_MORE + 2],
        dt * vz - rows[number, ROW_MORE + 3], give,
        rows[number, ROW_OUT], rows[number, ROW_OUT + 1], rows[number, ROW_OUT + 2],
    )  # fmt: skip
    longest = law.friction * shapes.shape_friction[shape] * (pressure + more) / law.tangential_stiffness
    kept = slipped(qx, qy, qz, longest)
    qx *= kept
    qy *= kept
    qz *= kept
    rows[number, ROW_STEP + 1] = qx - ux
    rows[number, ROW_STEP + 2] = qy - uy
    rows[number, ROW_STEP + 3] = qz - uz
    for part in range(1, 4):
        rows[number, ROW_MORE + part] += rows[number, ROW_STEP + part]
    if kept < 1.0 and sweep == len(SWEEPS) - 1:
        stretch_memory[shape, item, 0] = qx
        stretch_memory[shape, item, 1] = qy
        stretch_memory[shape, item, 2] = qz


@njit(**INLINED)
def more_push(rows, number, law):
    """Change in the last sweep: pressure times area [N] and friction force [N]."""
    push = rows[number, ROW_AREA] * rows[number, ROW_STEP]
    drag = rows[number, ROW_AREA] * law.tangential_stiffness
    return push, drag * rows[number, ROW_STEP + 1], drag * rows[number, ROW_STEP + 2], drag * rows[number, ROW_STEP + 3]


@njit(**INNER)
def hold_contact(model, state, shapes, law, dt, decay, row_count, reference, wrench):
    """Implicit contact: pressure and friction of each quadrature point at the END of the substep.

    `add_contact_forces` has applied k_p g and k_t u. The pressure at the end is larger by q = (k_p dt + c_p) g', the
    friction by k_t dt u', with the rates g', u' of the velocities after all forces. Sweeps over the points approach it:
    each adds w (q - the sum so far) / (1 + h), w = 1, 2, 2 (`SWEEPS`), and all points read the forces after the
    previous sweep, so that their order does not matter. h is the mean over the corners of H_a / m_a, with
    H_a = dt sum (k_p dt + c_p) A |dg/dx_a| sum_b |dg/dx_b| over the points around a node (or, if larger, k_t dt A times
    its weight): a point's share of a node's mass is its share of the node's hold (mass splitting, Tonge, Benevolenski
    and Voroshilov 2012). The velocities are then those of larger masses, which are symmetric: contact gives no energy,
    and `stability.contact_excess` bounds its part of the step's limit.
    At rest under balanced forces nothing is added: an equilibrium does not depend on dt.
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
            push, ux, uy, uz = more_push(rows, number, law)
            for corner in range(3):
                node = places[number, 2 + corner]
                weight = QUADRATURE_BARYCENTRIC[point, corner]
                _push_corner(
                    position, force, reference, wrench, tool, node, rows, number, corner, push, weight, ux, uy, uz
                )
                hold[node] = 0.0


@njit(**INLINED)
def _extent(ends, spans, shape, axis, around):
    """Lowest and highest coordinate of the core of a shape, widened by `around` [m]."""
    first, second = ends[shape, 0, axis], ends[shape, 1, axis]
    around += abs(spans[shape, axis])
    return min(first, second) - around, max(first, second) + around


@njit(**INLINED)
def _overlap(position, axis, a, b, c, low, high):
    """True if a triangle reaches into an interval of one coordinate."""
    first, second, third = position[a, axis], position[b, axis], position[c, axis]
    return max(first, second, third) >= low and min(first, second, third) <= high


@njit(**INLINED)
def _mean(values, a, b, c, wa, wb, wc):
    """Weighted mean of three nodes' values."""
    x = wa * values[a, 0] + wb * values[b, 0] + wc * values[c, 0]
    y = wa * values[a, 1] + wb * values[b, 1] + wc * values[c, 1]
    z = wa * values[a, 2] + wb * values[b, 2] + wc * values[c, 2]
    return x, y, z


@njit(**INLINED)
def tool_velocity(twist, centre, tool, x, y, z):
    """Velocity of a tool at a point [m/s]."""
    ox = x - centre[tool, 0]
    oy = y - centre[tool, 1]
    oz = z - centre[tool, 2]
    vx = twist[tool, 0] + twist[tool, 4] * oz - twist[tool, 5] * oy
    vy = twist[tool, 1] + twist[tool, 5] * ox - twist[tool, 3] * oz
    vz = twist[tool, 2] + twist[tool, 3] * oy - twist[tool, 4] * ox
    return vx, vy, vz


@njit(**INLINED)
def _middle(position, a, b, c):
    """Centroid of a triangle [m], and the squared radius of the sphere around it through the farthest corner [m^2]."""
    x = (position[a, 0] + position[b, 0] + position[c, 0]) / 3.0
    y = (position[a, 1] + position[b, 1] + position[c, 1]) / 3.0
    z = (position[a, 2] + position[b, 2] + position[c, 2]) / 3.0
    to_a = (position[a, 0] - x) ** 2 + (position[a, 1] - y) ** 2 + (position[a, 2] - z) ** 2
    to_b = (position[b, 0] - x) ** 2 + (position[b, 1] - y) ** 2 + (position[b, 2] - z) ** 2
    to_c = (position[c, 0] - x) ** 2 + (position[c, 1] - y) ** 2 + (position[c, 2] - z) ** 2
    return x, y, z, max(to_a, to_b, to_c)


@njit(**INLINED)
def _is_held(engaged, shape, triangle):
    """True if any point of a triangle is in contact with a shape."""
    first = triangle * QUADRATURE_COUNT
    for point in range(first, first + QUADRATURE_COUNT):
        if engaged[shape, point]:
            return True
    return False


@njit(**INLINED_KERNEL)
def closest_on_axis(ends, shape, x, y, z):
    """Point of a shape's axis nearest to a point.

    In: ends of axes [m] (n_shape, 2, 3), shape: its number, x, y, z: the point [m]
    Returns three coordinates [m].
    """
    ux = ends[shape, 1, 0] - ends[shape, 0, 0]
    uy = ends[shape, 1, 1] - ends[shape, 0, 1]
    uz = ends[shape, 1, 2] - ends[shape, 0, 2]
    length_squared = ux * ux + uy * uy + uz * uz
    along = 0.0
    if length_squared > 0.0:
        along = (
            (x - ends[shape, 0, 0]) * ux + (y - ends[shape, 0, 1]) * uy + (z - ends[shape, 0, 2]) * uz
        ) / length_squared
        along = min(1.0, max(0.0, along))
    return ends[shape, 0, 0] + along * ux, ends[shape, 0, 1] + along * uy, ends[shape, 0, 2] + along * uz


@njit(**INLINED)
def closest_on_core(ends, spans, shape, x, y, z):
    """Point of a shape's core nearest to a point: on its axis, or across it in a rounded box.

    In: ends of axes [m] (n_shape, 2, 3), spans across them [m] (n_shape, 3), shape: its number, x, y, z: the point [m]
    Returns three coordinates [m].
    """
    px, py, pz = closest_on_axis(ends, shape, x, y, z)
    sx = spans[shape, 0]
    sy = spans[shape, 1]
    sz = spans[shape, 2]
    squared = sx * sx + sy * sy + sz * sz
    if squared > 0.0:
        across = min(1.0, max(-1.0, ((x - px) * sx + (y - py) * sy + (z - pz) * sz) / squared))
        px += across * sx
        py += across * sy
        pz += across * sz
    return px, py, pz


@njit(**INLINED)
def _release(engaged, stretch_memory, shape, item):
    """End the contact of one quadrature point with one shape."""
    engaged[shape, item] = 0
    stretch_memory[shape, item, 0] = 0.0
    stretch_memory[shape, item, 1] = 0.0
    stretch_memory[shape, item, 2] = 0.0


@njit(**INLINED)
def _put_slope(rows, number, corner, weight, along_n, gx, gy, gz, nx, ny, nz):
    """Write the slope of a point's penetration with one corner into its row, weight g + along_n n."""
    rows[number, ROW_SLOPE + 3 * corner] = weight * gx + along_n * nx
    rows[number, ROW_SLOPE + 3 * corner + 1] = weight * gy + along_n * ny
    rows[number, ROW_SLOPE + 3 * corner + 2] = weight * gz + along_n * nz


@njit(**INLINED)
def corner_force(rows, number, corner, push, weight, ux, uy, uz):
    """Corner's share of a point's force, -push dg/dx - weight u [N]."""
    return (
        -push * rows[number, ROW_SLOPE + 3 * corner] - weight * ux,
        -push * rows[number, ROW_SLOPE + 3 * corner + 1] - weight * uy,
        -push * rows[number, ROW_SLOPE + 3 * corner + 2] - weight * uz,
    )


@njit(**INLINED)
def _push_corner(position, force, reference, wrench, tool, node, rows, number, corner, push, weight, ux, uy, uz):
    """Add a corner's share of a point's force, and its reaction."""
    fx, fy, fz = corner_force(rows, number, corner, push, weight, ux, uy, uz)
    force[node, 0] += fx
    force[node, 1] += fy
    force[node, 2] += fz
    react(wrench, reference, tool, position[node, 0], position[node, 1], position[node, 2], fx, fy, fz)


@njit(**INLINED)
def react(wrench, reference, tool, x, y, z, fx, fy, fz):
    """Subtract a force on the tissue at a point, and its torque about the reference, from the wrench on a tool."""
    x -= reference[tool, 0]
    y -= reference[tool, 1]
    z -= reference[tool, 2]
    wrench[tool, 0] -= fx
    wrench[tool, 1] -= fy
    wrench[tool, 2] -= fz
    wrench[tool, 3] -= y * fz - z * fy
    wrench[tool, 4] -= z * fx - x * fz
    wrench[tool, 5] -= x * fy - y * fx


@njit(**INLINED)
def _without_core(ends, spans, shape, px, py, pz, gx, gy, gz):
    """Remove the part of g along a shape's core, if the nearest point (px, py, pz) lies strictly inside its borders."""
    ux = ends[shape, 1, 0] - ends[shape, 0, 0]
    uy = ends[shape, 1, 1] - ends[shape, 0, 1]
    uz = ends[shape, 1, 2] - ends[shape, 0, 2]
    px -= ends[shape, 0, 0]
    py -= ends[shape, 0, 1]
    pz -= ends[shape, 0, 2]
    length_squared = ux * ux + uy * uy + uz * uz
    if length_squared > 0.0:
        along = px * ux + py * uy + pz * uz
        if BORDER * length_squared < along < (1.0 - BORDER) * length_squared:
            share = (gx * ux + gy * uy + gz * uz) / length_squared
            gx -= share * ux
            gy -= share * uy
            gz -= share * uz
    ux = spans[shape, 0]
    uy = spans[shape, 1]
    uz = spans[shape, 2]
    length_squared = ux * ux + uy * uy + uz * uz
    if length_squared > 0.0 and abs(px * ux + py * uy + pz * uz) < (1.0 - BORDER) * length_squared:
        share = (gx * ux + gy * uy + gz * uz) / length_squared
        gx -= share * ux
        gy -= share * uy
        gz -= share * uz
    return gx, gy, gz


@njit(**INLINED)
def lag_point(position, surface, stretch, shapes, response, shape, triangle, point):
    """Shift the stretch of a point by its tool's lag."""
    tool, item = shapes.shape_tool[shape], triangle * QUADRATURE_COUNT + point
    centre, lag = shapes.tool_centre, response.tool_lag
    ox = -centre[tool, 0]
    oy = -centre[tool, 1]
    oz = -centre[tool, 2]
    for corner in range(3):
        weight = QUADRATURE_BARYCENTRIC[point, corner]
        ox += weight * position[surface[triangle, corner], 0]
        oy += weight * position[surface[triangle, corner], 1]
        oz += weight * position[surface[triangle, corner], 2]
    stretch[shape, item, 0] -= lag[tool, 0] + lag[tool, 4] * oz - lag[tool, 5] * oy
    stretch[shape, item, 1] -= lag[tool, 1] + lag[tool, 5] * ox - lag[tool, 3] * oz
    stretch[shape, item, 2] -= lag[tool, 2] + lag[tool, 3] * oy - lag[tool, 4] * ox


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
