"""Every compiled function that steps the organ, the structures it reads and the constants it uses, in one file.

numba's disk cache does not see edits in other files, so nothing here may come from one (only math, typing,
numpy and numba are imported). Arrays of `OrganModel` are read-only, which numba holds at compile time; the
kernels work in place, allocate nothing, and use no fastmath beyond `contract`, so that a run repeats to the bit.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

FAULT_NONE = 0
FAULT_INVERTED_TET = 1
FAULT_NOT_FINITE = 2
FAULT_CONTACT_LOST = 3

# Room for tissue that moves towards a shape between two broad phases [m]: 1 mm in a 1 ms haptic step is 1 m/s.
CANDIDATE_MARGIN = 1e-3

# Below this volume ratio a tet also bears the share of its volume term that is averaged at nodes: an average lets
# single tets collapse between swollen neighbours (without it, a deep press turned some inside out).
SQUEEZED_RATIO = 0.6
# The surface is kept this share of a shape's radius away from its axis; ordinary presses stay far from it.
GUARD_SHARE = 0.6
# Half a thousandth of a triangle is taken for its edge, so that nothing slips through between two.
EDGE_WIDTH = 5e-4

# Four quadrature points a surface triangle: centroids of its four congruent parts, equal weights.
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


class OrganModel(NamedTuple):
    """What an organ is: read-only arrays, SI units.

    Fields:
        node_rest_position: undeformed position [m]                              (n_node, 3)
        node_mass: lumped mass [kg]                                              (n_node,)
        node_inverse_mass: 1 / mass [1/kg], 0 where the node is anchored         (n_node,)
        spring_nodes: the two nodes of each spring                               (n_spring, 2)
        spring_stiffness: [N/m]                                                  (n_spring,)
        spring_rest_length: [m]                                                  (n_spring,)
        tet_nodes: corners of each tet                                           (n_tet, 4)
        tet_rest_volume: [m^3]                                                   (n_tet,)
        tet_bulk: modulus of the volume term of each tet [Pa]                    (n_tet,)
        tet_averaged_bulk: what a tet gives to the averaged volume term [Pa]     (n_tet,)
        node_rest_volume: volume averaged at a node, a quarter of its tets [m^3] (n_node,)
        node_bulk: modulus of the volume term averaged at nodes [Pa]             (n_node,)
        averages_volume: whether any node_bulk is above 0                        scalar
        surface_triangles: outer triangles an instrument may touch, outward      (n_surface, 3)
        surface_rest_area: [m^2]                                                 (n_surface,)
        gravity: [m/s^2]                                                         (3,)
        alpha: mass-proportional damping rate [1/s]                              scalar
        beta: stiffness-proportional damping time [s]                            scalar
        stable_step: largest stable step without contact [s]                     scalar
    """

    node_rest_position: FloatArray
    node_mass: FloatArray
    node_inverse_mass: FloatArray
    spring_nodes: NDArray[np.int32]
    spring_stiffness: FloatArray
    spring_rest_length: FloatArray
    tet_nodes: NDArray[np.int32]
    tet_rest_volume: FloatArray
    tet_bulk: FloatArray
    tet_averaged_bulk: FloatArray
    node_rest_volume: FloatArray
    node_bulk: FloatArray
    averages_volume: bool
    surface_triangles: NDArray[np.int32]
    surface_rest_area: FloatArray
    gravity: FloatArray
    alpha: float
    beta: float
    stable_step: float


class OrganState(NamedTuple):
    """What changes while an organ moves, SI units; all of it is saved and restored.

    Fields:
        node_position: [m]                                                       (n_node, 3)
        node_velocity: [m/s]                                                     (n_node, 3)
        node_force: force of the last substep, without anchors' reactions [N]    (n_node, 3)
        node_pressure: scratch: tension of the averaged volume term [Pa]         (n_node,)
        contact_engaged: 1 where a quadrature point is held off by a shape       (n_shape, n_surface * 4)
        contact_stretch: tangential stretch of sticking friction [m]             (n_shape, n_surface * 4, 3)
        contact_candidates: scratch: triangles in reach, shape by shape          (n_shape, n_surface)
        contact_passed: the shape and the triangle it passed through, after such a fault  (2,)
        volume_ratio_smallest: smallest V / V0 seen since it was last set to 1   (1,)
        volume_ratio_tet: the tet that had it                                    (1,)
    """

    node_position: FloatArray
    node_velocity: FloatArray
    node_force: FloatArray
    node_pressure: FloatArray
    contact_engaged: NDArray[np.uint8]
    contact_stretch: FloatArray
    contact_candidates: NDArray[np.int32]
    contact_passed: NDArray[np.int32]
    volume_ratio_smallest: FloatArray
    volume_ratio_tet: NDArray[np.int32]


class ContactShapes(NamedTuple):
    """Capsules (spheres when both ends coincide) rigidly carried by tools, SI units, world frame.

    Fields:
        shape_ends: the two end points of the axis [m]                           (n_shape, 2, 3)
        shape_radius: [m]                                                        (n_shape,)
        shape_tool: the tool that carries the shape                              (n_shape,)
        tool_centre: centre of mass, moved along the twist by each substep [m]   (n_tool, 3)
        tool_twist: linear [m/s] at the centre of mass, angular [rad/s]          (n_tool, 6)
    """

    shape_ends: FloatArray
    shape_radius: FloatArray
    shape_tool: NDArray[np.int32]
    tool_centre: FloatArray
    tool_twist: FloatArray


class ToolResponse(NamedTuple):
    """How tools yield to the tissue within one haptic step, SI units; zeros for tools that move as told.

    Fields:
        tool_acceleration: rate of the twist without the tissue [m/s^2, rad/s^2]  (n_tool, 6)
        tool_mobility: rate of the twist per wrench [1/kg, ...]                  (n_tool, 6, 6)
        tool_wrench: scratch: sum of the wrenches before the substep [N, N m]    (n_tool, 6)
        tool_lag: scratch: how far the tool ends behind twist times step [m, rad] (n_tool, 6)
    """

    tool_acceleration: FloatArray
    tool_mobility: FloatArray
    tool_wrench: FloatArray
    tool_lag: FloatArray


class ContactLaw(NamedTuple):
    """How tissue and instrument push on each other, per unit of surface area.

    Fields:
        stiffness: pressure per penetration, k_p [N/m^3]
        damping: pressure per closing speed [N s/m^3]
        friction: Coulomb coefficient mu
        tangential_stiffness: traction per stretch while sticking [N/m^3]
    """

    stiffness: float
    damping: float
    friction: float
    tangential_stiffness: float


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _begin_forces(model, state):
    """Gravity: f = m g."""
    force, mass, gravity = state.node_force, model.node_mass, model.gravity
    for node in range(mass.shape[0]):
        for axis in range(3):
            force[node, axis] = mass[node] * gravity[axis]


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _add_spring_forces(model, state):
    """Springs and Rayleigh's beta along them: f = k ((l - l0) + beta dl/dt) along the spring (Sala 2011, eq. 1)."""
    position, velocity, force = state.node_position, state.node_velocity, state.node_force
    nodes, stiffness, rest_length, beta = (
        model.spring_nodes,
        model.spring_stiffness,
        model.spring_rest_length,
        model.beta,
    )
    for spring in range(nodes.shape[0]):
        # Unsigned indices: numba then leaves out its test for negative ones.
        i = np.uint32(nodes[spring, 0])
        j = np.uint32(nodes[spring, 1])
        dx = position[j, 0] - position[i, 0]
        dy = position[j, 1] - position[i, 1]
        dz = position[j, 2] - position[i, 2]
        length_squared = dx * dx + dy * dy + dz * dz
        scale = stiffness[spring] * (1.0 - rest_length[spring] / math.sqrt(length_squared))
        if beta > 0.0:
            rate = (
                dx * (velocity[j, 0] - velocity[i, 0])
                + dy * (velocity[j, 1] - velocity[i, 1])
                + dz * (velocity[j, 2] - velocity[i, 2])
            )
            scale += stiffness[spring] * beta * rate / length_squared
        fx = scale * dx
        fy = scale * dy
        fz = scale * dz
        force[i, 0] += fx
        force[i, 1] += fy
        force[i, 2] += fz
        force[j, 0] -= fx
        force[j, 1] -= fy
        force[j, 2] -= fz


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _add_volume_forces(model, state):
    """Volume term W = (K_t / 2) V0 (J - 1)^2 per tet: f_a = -K_t (J - 1) dV/dx_a; watches the smallest J.

    It adds K_t to Lame's lambda and nothing to mu (after the volume-only energy of Golec et al. 2020). Where volumes
    are averaged at nodes, the mean of the corners' tension is added to K_t (J - 1): `_average_volumes`; and, below
    SQUEEZED_RATIO, the term (K / 2) V0 (J - SQUEEZED_RATIO)^2 of the averaged share K.
    """
    if model.averages_volume:
        _average_volumes(model, state)
    averaged, pressure, averaged_bulk = model.averages_volume, state.node_pressure, model.tet_averaged_bulk
    position, velocity, force = state.node_position, state.node_velocity, state.node_force
    tets, rest_volume, bulk, beta = model.tet_nodes, model.tet_rest_volume, model.tet_bulk, model.beta
    smallest = state.volume_ratio_smallest[0]
    smallest_tet = state.volume_ratio_tet[0]
    for tet in range(tets.shape[0]):
        a = np.uint32(tets[tet, 0])
        b = np.uint32(tets[tet, 1])
        c = np.uint32(tets[tet, 2])
        d = np.uint32(tets[tet, 3])
        bx = position[b, 0] - position[a, 0]
        by = position[b, 1] - position[a, 1]
        bz = position[b, 2] - position[a, 2]
        cx = position[c, 0] - position[a, 0]
        cy = position[c, 1] - position[a, 1]
        cz = position[c, 2] - position[a, 2]
        dx = position[d, 0] - position[a, 0]
        dy = position[d, 1] - position[a, 1]
        dz = position[d, 2] - position[a, 2]
        # Six times dV/dx of the corners b, c and d: the cross products of the other two edges.
        gbx = cy * dz - cz * dy
        gby = cz * dx - cx * dz
        gbz = cx * dy - cy * dx
        gcx = dy * bz - dz * by
        gcy = dz * bx - dx * bz
        gcz = dx * by - dy * bx
        gdx = by * cz - bz * cy
        gdy = bz * cx - bx * cz
        gdz = bx * cy - by * cx
        ratio = (bx * gbx + by * gby + bz * gbz) / (6.0 * rest_volume[tet])
        if not ratio >= smallest:
            smallest = ratio
            smallest_tet = tet
        strain = ratio - 1.0
        if beta > 0.0:
            rate = (
                gbx * (velocity[b, 0] - velocity[a, 0])
                + gby * (velocity[b, 1] - velocity[a, 1])
                + gbz * (velocity[b, 2] - velocity[a, 2])
                + gcx * (velocity[c, 0] - velocity[a, 0])
                + gcy * (velocity[c, 1] - velocity[a, 1])
                + gcz * (velocity[c, 2] - velocity[a, 2])
                + gdx * (velocity[d, 0] - velocity[a, 0])
                + gdy * (velocity[d, 1] - velocity[a, 1])
                + gdz * (velocity[d, 2] - velocity[a, 2])
            )
            strain += beta * rate / (6.0 * rest_volume[tet])
        scale = -bulk[tet] * strain / 6.0
        if averaged:
            scale -= (pressure[a] + pressure[b] + pressure[c] + pressure[d]) / 24.0
            if ratio < SQUEEZED_RATIO:
                scale -= averaged_bulk[tet] * (ratio - SQUEEZED_RATIO) / 6.0
        force[a, 0] -= scale * (gbx + gcx + gdx)
        force[a, 1] -= scale * (gby + gcy + gdy)
        force[a, 2] -= scale * (gbz + gcz + gdz)
        force[b, 0] += scale * gbx
        force[b, 1] += scale * gby
        force[b, 2] += scale * gbz
        force[c, 0] += scale * gcx
        force[c, 1] += scale * gcy
        force[c, 2] += scale * gcz
        force[d, 0] += scale * gdx
        force[d, 1] += scale * gdy
        force[d, 2] += scale * gdz
    state.volume_ratio_smallest[0] = smallest
    state.volume_ratio_tet[0] = smallest_tet


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _average_volumes(model, state):
    """Tension of the volumes averaged at nodes: p_a = K_a (J_a - 1), J_a = sum_t V_t / 4 over what it is at rest.

    It is the derivative of W = sum_a (K_a / 2) V_a (J_a - 1)^2 by J_a V_a, so that a tet pulls its corners with the
    mean of their p_a: fewer constraints than tets, which near incompressibility would lock (Bonet and Burton 1998).
    """
    position, velocity, pressure = state.node_position, state.node_velocity, state.node_pressure
    tets, rest_volume, bulk, beta = model.tet_nodes, model.node_rest_volume, model.node_bulk, model.beta
    pressure[:] = 0.0
    for tet in range(tets.shape[0]):
        a = np.uint32(tets[tet, 0])
        b = np.uint32(tets[tet, 1])
        c = np.uint32(tets[tet, 2])
        d = np.uint32(tets[tet, 3])
        bx = position[b, 0] - position[a, 0]
        by = position[b, 1] - position[a, 1]
        bz = position[b, 2] - position[a, 2]
        cx = position[c, 0] - position[a, 0]
        cy = position[c, 1] - position[a, 1]
        cz = position[c, 2] - position[a, 2]
        dx = position[d, 0] - position[a, 0]
        dy = position[d, 1] - position[a, 1]
        dz = position[d, 2] - position[a, 2]
        gx = cy * dz - cz * dy
        gy = cz * dx - cx * dz
        gz = cx * dy - cy * dx
        volume = bx * gx + by * gy + bz * gz
        if beta > 0.0:
            volume += beta * (
                gx * (velocity[b, 0] - velocity[a, 0])
                + gy * (velocity[b, 1] - velocity[a, 1])
                + gz * (velocity[b, 2] - velocity[a, 2])
                + (dy * bz - dz * by) * (velocity[c, 0] - velocity[a, 0])
                + (dz * bx - dx * bz) * (velocity[c, 1] - velocity[a, 1])
                + (dx * by - dy * bx) * (velocity[c, 2] - velocity[a, 2])
                + (by * cz - bz * cy) * (velocity[d, 0] - velocity[a, 0])
                + (bz * cx - bx * cz) * (velocity[d, 1] - velocity[a, 1])
                + (bx * cy - by * cx) * (velocity[d, 2] - velocity[a, 2])
            )
        pressure[a] += volume
        pressure[b] += volume
        pressure[c] += volume
        pressure[d] += volume
    for node in range(pressure.shape[0]):
        # The sum holds 24 times the averaged volume: six for the box product, four for the quarter.
        pressure[node] = bulk[node] * (pressure[node] / (24.0 * rest_volume[node]) - 1.0)


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _find_candidates(model, state, shapes, duration):
    """Broad phase of one call: the triangles that a shape may touch within `duration` [s], by bounding spheres.

    What moves faster than the margin is met one haptic step later; what is engaged always stays a candidate.
    Returns how many candidates the busiest shape has; the list of a shape ends with -1.
    """
    # Arrays are taken out of the structures before the loops: inside, each access would cost a reference count.
    position, ends, surface = state.node_position, shapes.shape_ends, model.surface_triangles
    engaged, candidates, twist = state.contact_engaged, state.contact_candidates, shapes.tool_twist
    most = 0
    for shape in range(shapes.shape_radius.shape[0]):
        tool = shapes.shape_tool[shape]
        radius = shapes.shape_radius[shape]
        speed = 0.0
        for part in range(6):
            # An angular part moves a point by at most its lever, taken as one metre: generous for a hand-held tool.
            speed += abs(twist[tool, part])
        margin = CANDIDATE_MARGIN + 2.0 * speed * duration
        count = 0
        for triangle in range(surface.shape[0]):
            a = surface[triangle, 0]
            b = surface[triangle, 1]
            c = surface[triangle, 2]
            reach = 0.0
            for axis in range(3):
                reach += (position[b, axis] - position[a, axis]) ** 2
            other = 0.0
            for axis in range(3):
                other += (position[c, axis] - position[a, axis]) ** 2
            limit = math.sqrt(max(reach, other)) + radius + margin
            px, py, pz = _closest_on_axis(ends, shape, position[a, 0], position[a, 1], position[a, 2])
            gap = (position[a, 0] - px) ** 2 + (position[a, 1] - py) ** 2 + (position[a, 2] - pz) ** 2
            near = gap <= limit * limit
            if not near:
                first = triangle * QUADRATURE_COUNT
                for point in range(first, first + QUADRATURE_COUNT):
                    if engaged[shape, point]:
                        near = True
            if near:
                candidates[shape, count] = triangle
                count += 1
        if count < candidates.shape[1]:
            candidates[shape, count] = -1
        most = max(most, count)
    return most


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _add_contact_forces(model, state, shapes, law, dt, candidate_count, reference, wrench):
    """Contact of every shape with its candidate triangles; adds the reaction to the tools' wrench."""
    position, velocity, force = state.node_position, state.node_velocity, state.node_force
    engaged, stretch_memory, candidates = state.contact_engaged, state.contact_stretch, state.contact_candidates
    surface, rest_area = model.surface_triangles, model.surface_rest_area
    ends, centre, twist = shapes.shape_ends, shapes.tool_centre, shapes.tool_twist
    for shape in range(shapes.shape_radius.shape[0]):
        tool = shapes.shape_tool[shape]
        radius = shapes.shape_radius[shape]
        for entry in range(candidate_count):
            triangle = candidates[shape, entry]
            if triangle < 0:
                break
            a = surface[triangle, 0]
            b = surface[triangle, 1]
            c = surface[triangle, 2]
            bx = position[b, 0] - position[a, 0]
            by = position[b, 1] - position[a, 1]
            bz = position[b, 2] - position[a, 2]
            cx = position[c, 0] - position[a, 0]
            cy = position[c, 1] - position[a, 1]
            cz = position[c, 2] - position[a, 2]
            nx = by * cz - bz * cy
            ny = bz * cx - bx * cz
            nz = bx * cy - by * cx
            twice_area = math.sqrt(nx * nx + ny * ny + nz * nz)
            nx /= twice_area
            ny /= twice_area
            nz /= twice_area
            for point in range(QUADRATURE_COUNT):
                _add_point_contact(
                    surface, rest_area, position, velocity, force, engaged, stretch_memory, ends, radius, centre, twist,
                    law, dt, reference, wrench, shape, tool, triangle, point, nx, ny, nz, twice_area,
                )  # fmt: skip


@njit(cache=True, inline="always", nogil=True, fastmath={"contract"}, error_model="numpy")
def _closest_on_axis(ends, shape, x, y, z):
    """The point of a capsule's axis nearest to (x, y, z) [m]."""
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


@njit(cache=True, inline="always", nogil=True, fastmath={"contract"}, error_model="numpy")
def _release(engaged, stretch_memory, shape, item):
    """Forget the contact of one quadrature point with one shape."""
    engaged[shape, item] = 0
    for axis in range(3):
        stretch_memory[shape, item, axis] = 0.0


@njit(cache=True, inline="always", nogil=True, fastmath={"contract"}, error_model="numpy")
def _add_point_contact(
    surface, rest_area, position, velocity, force, engaged, stretch_memory, ends, radius, centre, twist, law, dt,
    reference, wrench, shape, tool, triangle, point, nx, ny, nz, twice_area,
):  # fmt: skip
    """Contact of one quadrature point with one shape, by a penetration that keeps rising with depth.

    With d from the shape's axis to the point, n the surface normal, t = d . n, rho = d - t n and s = sqrt(r^2 - rho^2)
    the half chord, the line through the point along n leaves the ball t + s below the point. The energy per area is
    (k_p / 2) g^2 with g = s (s + t) / r: to first order the radial penetration r - |d|, yet growing without bound as
    the ball sinks below the surface, where a radial one falls again and lets the ball tunnel. Forces are its exact
    gradient, the turning of n with the corners included, so that action and reaction balance, torque too.
    A point engages where the shape first meets it from outside (s + t > 0 with t < 0 inside the ball) and stays
    engaged until it parts, so that the far side of a thin organ is never taken for the near one.
    """
    item = triangle * QUADRATURE_COUNT + point
    a = surface[triangle, 0]
    b = surface[triangle, 1]
    c = surface[triangle, 2]
    wa = QUADRATURE_BARYCENTRIC[point, 0]
    wb = QUADRATURE_BARYCENTRIC[point, 1]
    wc = QUADRATURE_BARYCENTRIC[point, 2]
    x = wa * position[a, 0] + wb * position[b, 0] + wc * position[c, 0]
    y = wa * position[a, 1] + wb * position[b, 1] + wc * position[c, 1]
    z = wa * position[a, 2] + wb * position[b, 2] + wc * position[c, 2]
    px, py, pz = _closest_on_axis(ends, shape, x, y, z)
    dx = x - px
    dy = y - py
    dz = z - pz
    t = dx * nx + dy * ny + dz * nz
    rx = dx - t * nx
    ry = dy - t * ny
    rz = dz - t * nz
    chord_squared = radius * radius - (rx * rx + ry * ry + rz * rz)
    if chord_squared <= 0.0:
        _release(engaged, stretch_memory, shape, item)
        return
    s = math.sqrt(chord_squared)
    depth = s + t
    if depth <= 0.0 or (not engaged[shape, item] and t > 0.0):
        _release(engaged, stretch_memory, shape, item)
        return
    engaged[shape, item] = 1

    ox = x - centre[tool, 0]
    oy = y - centre[tool, 1]
    oz = z - centre[tool, 2]
    vx = wa * velocity[a, 0] + wb * velocity[b, 0] + wc * velocity[c, 0]
    vy = wa * velocity[a, 1] + wb * velocity[b, 1] + wc * velocity[c, 1]
    vz = wa * velocity[a, 2] + wb * velocity[b, 2] + wc * velocity[c, 2]
    vx -= twist[tool, 0] + twist[tool, 4] * oz - twist[tool, 5] * oy
    vy -= twist[tool, 1] + twist[tool, 5] * ox - twist[tool, 3] * oz
    vz -= twist[tool, 2] + twist[tool, 3] * oy - twist[tool, 4] * ox
    # e: unit vector against the ball's own normal where the line along n leaves the ball.
    ex = (s * nx - rx) / radius
    ey = (s * ny - ry) / radius
    ez = (s * nz - rz) / radius
    closing = ex * vx + ey * vy + ez * vz
    load = law.stiffness * depth + law.damping * closing
    if load < 0.0:
        load = 0.0
    weighted_area = rest_area[triangle] * QUADRATURE_WEIGHT
    scale = -weighted_area * load / (radius * radius)

    # Gradient of g at the point (times r^2 / s): s^2 n - (2 s + t) rho, without the axis' direction inside a capsule.
    gx = scale * (chord_squared * nx - (2.0 * s + t) * rx)
    gy = scale * (chord_squared * ny - (2.0 * s + t) * ry)
    gz = scale * (chord_squared * nz - (2.0 * s + t) * rz)
    gx, gy, gz = _without_axis(ends, shape, px, py, pz, gx, gy, gz)

    # Friction: a tangential spring that sticks until mu times the pressure, then slips.
    ux = stretch_memory[shape, item, 0] + dt * vx
    uy = stretch_memory[shape, item, 1] + dt * vy
    uz = stretch_memory[shape, item, 2] + dt * vz
    out_of_plane = ux * ex + uy * ey + uz * ez
    ux -= out_of_plane * ex
    uy -= out_of_plane * ey
    uz -= out_of_plane * ez
    stretch = math.sqrt(ux * ux + uy * uy + uz * uz)
    longest = law.friction * load * s / radius / law.tangential_stiffness
    if stretch > longest:
        ux *= longest / stretch
        uy *= longest / stretch
        uz *= longest / stretch
    stretch_memory[shape, item, 0] = ux
    stretch_memory[shape, item, 1] = uy
    stretch_memory[shape, item, 2] = uz
    drag = law.tangential_stiffness * weighted_area
    gx -= drag * ux
    gy -= drag * uy
    gz -= drag * uz

    # The normal turns when the corners move: dn = -sum grad(lambda_a) (n . dx_a); its share of the gradient is along n.
    bx = position[b, 0] - position[a, 0]
    by = position[b, 1] - position[a, 1]
    bz = position[b, 2] - position[a, 2]
    cx = position[c, 0] - position[a, 0]
    cy = position[c, 1] - position[a, 1]
    cz = position[c, 2] - position[a, 2]
    # rho . grad(lambda_b) = rho . (c x n) / (2 A) for the corner b, rho . (n x b) / (2 A) for the corner c.
    turn_b = (rx * (cy * nz - cz * ny) + ry * (cz * nx - cx * nz) + rz * (cx * ny - cy * nx)) / twice_area
    turn_c = (rx * (ny * bz - nz * by) + ry * (nz * bx - nx * bz) + rz * (nx * by - ny * bx)) / twice_area
    turn = -scale * depth * depth
    tb = turn * turn_b
    tc = turn * turn_c
    ta = -tb - tc
    for corner in range(3):
        if corner == 0:
            node, weight, along_n = a, wa, ta
        elif corner == 1:
            node, weight, along_n = b, wb, tb
        else:
            node, weight, along_n = c, wc, tc
        fx = weight * gx + along_n * nx
        fy = weight * gy + along_n * ny
        fz = weight * gz + along_n * nz
        force[node, 0] += fx
        force[node, 1] += fy
        force[node, 2] += fz
        ax = position[node, 0] - reference[tool, 0]
        ay = position[node, 1] - reference[tool, 1]
        az = position[node, 2] - reference[tool, 2]
        wrench[tool, 0] -= fx
        wrench[tool, 1] -= fy
        wrench[tool, 2] -= fz
        wrench[tool, 3] -= ay * fz - az * fy
        wrench[tool, 4] -= az * fx - ax * fz
        wrench[tool, 5] -= ax * fy - ay * fx


@njit(cache=True, inline="always", nogil=True, fastmath={"contract"}, error_model="numpy")
def _without_axis(ends, shape, px, py, pz, gx, gy, gz):
    """Drop the part along a capsule's axis where the nearest axis point lies strictly between the ends."""
    ux = ends[shape, 1, 0] - ends[shape, 0, 0]
    uy = ends[shape, 1, 1] - ends[shape, 0, 1]
    uz = ends[shape, 1, 2] - ends[shape, 0, 2]
    length_squared = ux * ux + uy * uy + uz * uz
    if length_squared > 0.0:
        along = (px - ends[shape, 0, 0]) * ux + (py - ends[shape, 0, 1]) * uy + (pz - ends[shape, 0, 2]) * uz
        if 0.0 < along < length_squared:
            share = (gx * ux + gy * uy + gz * uz) / length_squared
            return gx - share * ux, gy - share * uy, gz - share * uz
    return gx, gy, gz


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _guard_axes(model, state, shapes, law, dt, candidate_count, reference, wrench):
    """Keep the surface off the shapes' axes, whatever the quadrature points do; False where an axis passed through.

    Where a ball is small against a triangle, the surface opens between its quadrature points. So the point of each
    triangle nearest to the axis, at the distance d, is pushed away from it by k h (h / d - 1) below h = 0.6 r, with
    k = pi r^2 k_p: nothing at h, without bound at the axis. It is taken implicitly, with the nodes' masses, so that it
    asks for no shorter step; it must therefore come after all other forces.
    """
    position, velocity, force = state.node_position, state.node_velocity, state.node_force
    candidates, surface, inverse_mass = state.contact_candidates, model.surface_triangles, model.node_inverse_mass
    ends, twist, centre = shapes.shape_ends, shapes.tool_twist, shapes.tool_centre
    kept = True
    for shape in range(shapes.shape_radius.shape[0]):
        tool = shapes.shape_tool[shape]
        radius = shapes.shape_radius[shape]
        reach = GUARD_SHARE * radius
        # What an axis may pass in one substep, with the broad phase's bound on its speed.
        watched = reach
        for part in range(6):
            watched += dt * abs(twist[tool, part])
        for entry in range(candidate_count):
            triangle = candidates[shape, entry]
            if triangle < 0:
                break
            a = surface[triangle, 0]
            b = surface[triangle, 1]
            c = surface[triangle, 2]
            bx = position[b, 0] - position[a, 0]
            by = position[b, 1] - position[a, 1]
            bz = position[b, 2] - position[a, 2]
            cx = position[c, 0] - position[a, 0]
            cy = position[c, 1] - position[a, 1]
            cz = position[c, 2] - position[a, 2]
            nx = by * cz - bz * cy
            ny = bz * cx - bx * cz
            nz = bx * cy - by * cx
            twice_area = math.sqrt(nx * nx + ny * ny + nz * nz)
            first = 0.0
            second = 0.0
            for axis, part in ((0, nx), (1, ny), (2, nz)):
                first += (ends[shape, 0, axis] - position[a, axis]) * part
                second += (ends[shape, 1, axis] - position[a, axis]) * part
            low = 0 if first < second else 1
            if min(first, second) > watched * twice_area or max(first, second) < -watched * twice_area:
                continue
            if min(first, second) <= 0.0 and _passed(shapes, shape, position, velocity, dt, a, b, c):
                state.contact_passed[0] = shape
                state.contact_passed[1] = triangle
                kept = False
                continue
            # The triangle's point nearest to the axis' lower end, against the axis: exact for a ball, near for a shaft.
            wb, wc = _closest_in_triangle(
                bx, by, bz, cx, cy, cz,
                ends[shape, low, 0] - position[a, 0], ends[shape, low, 1] - position[a, 1],
                ends[shape, low, 2] - position[a, 2],
            )  # fmt: skip
            x = position[a, 0] + wb * bx + wc * cx
            y = position[a, 1] + wb * by + wc * cy
            z = position[a, 2] + wb * bz + wc * cz
            px, py, pz = _closest_on_axis(ends, shape, x, y, z)
            ex = x - px
            ey = y - py
            ez = z - pz
            distance = math.sqrt(ex * ex + ey * ey + ez * ez)
            # Behind the triangle, beyond one of its edges: another one stands between.
            if distance >= reach or ex * nx + ey * ny + ez * nz >= 0.0:
                continue
            _hold_off(
                position, velocity, force, inverse_mass, twist, centre, dt, reference, wrench, tool, reach,
                math.pi * radius * radius * law.stiffness, distance, ex, ey, ez, x, y, z, a, b, c, wb, wc,
            )  # fmt: skip
    return kept


@njit(cache=True, inline="always", nogil=True, fastmath={"contract"}, error_model="numpy")
def _hold_off(
    position, velocity, force, inverse_mass, twist, centre, dt, reference, wrench, tool, reach, stiffness, distance,
    ex, ey, ez, x, y, z, a, b, c, wb, wc,
):  # fmt: skip
    """The guard's push on a triangle's point (x, y, z) along e, with the speed and mobility it has in this substep."""
    ex /= distance
    ey /= distance
    ez /= distance
    ox = x - centre[tool, 0]
    oy = y - centre[tool, 1]
    oz = z - centre[tool, 2]
    speed = -(
        ex * (twist[tool, 0] + twist[tool, 4] * oz - twist[tool, 5] * oy)
        + ey * (twist[tool, 1] + twist[tool, 5] * ox - twist[tool, 3] * oz)
        + ez * (twist[tool, 2] + twist[tool, 3] * oy - twist[tool, 4] * ox)
    )
    give = 0.0
    for node, weight in ((a, 1.0 - wb - wc), (b, wb), (c, wc)):
        rate = dt * inverse_mass[node]
        speed += weight * (
            ex * (velocity[node, 0] + rate * force[node, 0])
            + ey * (velocity[node, 1] + rate * force[node, 1])
            + ez * (velocity[node, 2] + rate * force[node, 2])
        )
        give += weight * weight * rate
    slope = stiffness * (reach / distance) ** 2
    push = stiffness * reach * (reach / distance - 1.0) - slope * dt * speed
    push = max(0.0, push / (1.0 + slope * dt * give))
    fx = push * ex
    fy = push * ey
    fz = push * ez
    for node, weight in ((a, 1.0 - wb - wc), (b, wb), (c, wc)):
        force[node, 0] += weight * fx
        force[node, 1] += weight * fy
        force[node, 2] += weight * fz
    x -= reference[tool, 0]
    y -= reference[tool, 1]
    z -= reference[tool, 2]
    wrench[tool, 0] -= fx
    wrench[tool, 1] -= fy
    wrench[tool, 2] -= fz
    wrench[tool, 3] -= y * fz - z * fy
    wrench[tool, 4] -= z * fx - x * fz
    wrench[tool, 5] -= x * fy - y * fx


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _passed(shapes, shape, position, velocity, dt, a, b, c):
    """Whether an end of a shape's axis went through a triangle in the last substep, or the axis now sticks in it."""
    ends, twist, centre, tool = shapes.shape_ends, shapes.tool_twist, shapes.tool_centre, shapes.shape_tool[shape]
    ux, uy, uz, wx, wy, wz = twist[tool]
    highest, highest_b, highest_c = 0.0, 0.0, 0.0
    lowest, lowest_b, lowest_c = 0.0, 0.0, 0.0
    for end in range(2):
        x = ends[shape, end, 0]
        y = ends[shape, end, 1]
        z = ends[shape, end, 2]
        now, now_b, now_c = _foot(x, y, z, position, velocity, 0.0, a, b, c)
        ox = x - centre[tool, 0]
        oy = y - centre[tool, 1]
        oz = z - centre[tool, 2]
        x -= dt * (ux + wy * oz - wz * oy)
        y -= dt * (uy + wz * ox - wx * oz)
        z -= dt * (uz + wx * oy - wy * ox)
        then, then_b, then_c = _foot(x, y, z, position, velocity, dt, a, b, c)
        if then > 0.0 >= now and _is_inside(then, then_b, then_c, now, now_b, now_c):
            return True
        if now > highest:
            highest, highest_b, highest_c = now, now_b, now_c
        if now < lowest:
            lowest, lowest_b, lowest_c = now, now_b, now_c
    return highest > 0.0 > lowest and _is_inside(highest, highest_b, highest_c, lowest, lowest_b, lowest_c)


@njit(cache=True, inline="always", nogil=True, fastmath={"contract"}, error_model="numpy")
def _foot(x, y, z, position, velocity, dt, a, b, c):
    """Of a point over a triangle as it was dt ago: height [m], and its foot's weights of the corners b and c."""
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
    nx = by * cz - bz * cy
    ny = bz * cx - bx * cz
    nz = bx * cy - by * cx
    squared = nx * nx + ny * ny + nz * nz
    wb = ((py * cz - pz * cy) * nx + (pz * cx - px * cz) * ny + (px * cy - py * cx) * nz) / squared
    wc = ((by * pz - bz * py) * nx + (bz * px - bx * pz) * ny + (bx * py - by * px) * nz) / squared
    return (px * nx + py * ny + pz * nz) / math.sqrt(squared), wb, wc


@njit(cache=True, inline="always", nogil=True, fastmath={"contract"}, error_model="numpy")
def _is_inside(high, high_b, high_c, low, low_b, low_c):
    """Whether the way from a height above a triangle to one below it leads through it, its edges included."""
    share = high / (high - low)
    wb = high_b + share * (low_b - high_b)
    wc = high_c + share * (low_c - high_c)
    return wb >= -EDGE_WIDTH and wc >= -EDGE_WIDTH and wb + wc <= 1.0 + EDGE_WIDTH


@njit(cache=True, inline="always", nogil=True, fastmath={"contract"}, error_model="numpy")
def _closest_in_triangle(bx, by, bz, cx, cy, cz, px, py, pz):
    """Weights of the corners b and c, seen from the corner a, of the triangle's point nearest to p.

    After Ericson, Real-Time Collision Detection (2005), 5.1.5.
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


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _integrate(model, state, dt, decay):
    """Symplectic Euler: v = decay v + dt f / m, x = x + dt v, decay = e^(-alpha dt); returns a sum finite if all is."""
    position, velocity, force = state.node_position, state.node_velocity, state.node_force
    inverse_mass = model.node_inverse_mass
    total = 0.0
    for node in range(position.shape[0]):
        scale = dt * inverse_mass[node]
        for axis in range(3):
            speed = decay * velocity[node, axis] + scale * force[node, axis]
            velocity[node, axis] = speed
            position[node, axis] += dt * speed
            total += position[node, axis] + speed
    return total


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _move_shapes(shapes, dt):
    """Carry the shapes along their tool's twist."""
    twist = shapes.tool_twist
    for shape in range(shapes.shape_radius.shape[0]):
        tool = shapes.shape_tool[shape]
        for end in range(2):
            ox = shapes.shape_ends[shape, end, 0] - shapes.tool_centre[tool, 0]
            oy = shapes.shape_ends[shape, end, 1] - shapes.tool_centre[tool, 1]
            oz = shapes.shape_ends[shape, end, 2] - shapes.tool_centre[tool, 2]
            shapes.shape_ends[shape, end, 0] += dt * (twist[tool, 0] + twist[tool, 4] * oz - twist[tool, 5] * oy)
            shapes.shape_ends[shape, end, 1] += dt * (twist[tool, 1] + twist[tool, 5] * ox - twist[tool, 3] * oz)
            shapes.shape_ends[shape, end, 2] += dt * (twist[tool, 2] + twist[tool, 3] * oy - twist[tool, 4] * ox)
    for tool in range(shapes.tool_centre.shape[0]):
        for axis in range(3):
            shapes.tool_centre[tool, axis] += dt * twist[tool, axis]


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _push_tools(shapes, response, dt, substep, wrench):
    """Let the substep's wrench change the tools' twist: twist += dt (a + B w), before the shapes move along it."""
    twist, before, lag = shapes.tool_twist, response.tool_wrench, response.tool_lag
    acceleration, mobility = response.tool_acceleration, response.tool_mobility
    for tool in range(twist.shape[0]):
        for row in range(6):
            rate = acceleration[tool, row]
            for column in range(6):
                rate += mobility[tool, row, column] * (wrench[tool, column] - before[tool, column])
            twist[tool, row] += dt * rate
            lag[tool, row] += dt * dt * substep * rate
        for row in range(6):
            before[tool, row] = wrench[tool, row]


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _stretch_by_lag(model, state, shapes, response, candidate_count):
    """Sticking friction follows a tool to where MuJoCo puts it: the last twist times the step, ahead by the lag."""
    position, surface = state.node_position, model.surface_triangles
    engaged, stretch, candidates = state.contact_engaged, state.contact_stretch, state.contact_candidates
    centre, lag = shapes.tool_centre, response.tool_lag
    for shape in range(shapes.shape_radius.shape[0]):
        tool = shapes.shape_tool[shape]
        for entry in range(candidate_count):
            triangle = candidates[shape, entry]
            if triangle < 0:
                break
            for point in range(QUADRATURE_COUNT):
                item = triangle * QUADRATURE_COUNT + point
                if not engaged[shape, item]:
                    continue
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


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def advance_substeps(model, state, shapes, law, response, dt, decay, substep_count, reference, wrench):
    """Advance an organ by some substeps against moving shapes; the kernel behind `organ.advance`.

    Model: model, law, response
    In:    dt [s], decay = exp(-alpha dt), substep_count, reference: point of each tool's torque [m] (n_tool, 3)
    Out:   state, shapes (moved), wrench: MEAN force [N] and torque [N m] on each tool (n_tool, 6)
    Returns a FAULT_ code; a fault stops at the substep that showed it.
    """
    wrench[:, :] = 0.0
    response.tool_wrench[:, :] = 0.0
    response.tool_lag[:, :] = 0.0
    candidate_count = _find_candidates(model, state, shapes, dt * substep_count)
    for substep in range(substep_count):
        _begin_forces(model, state)
        _add_spring_forces(model, state)
        _add_volume_forces(model, state)
        _add_contact_forces(model, state, shapes, law, dt, candidate_count, reference, wrench)
        kept = _guard_axes(model, state, shapes, law, dt, candidate_count, reference, wrench)
        total = _integrate(model, state, dt, decay)
        _push_tools(shapes, response, dt, substep, wrench)
        _move_shapes(shapes, dt)
        if not math.isfinite(total):
            return FAULT_NOT_FINITE
        if not state.volume_ratio_smallest[0] > 0.0:
            return FAULT_INVERTED_TET
        if not kept:
            return FAULT_CONTACT_LOST
    if law.friction > 0.0:
        _stretch_by_lag(model, state, shapes, response, candidate_count)
    for tool in range(wrench.shape[0]):
        for part in range(6):
            wrench[tool, part] /= substep_count
    return FAULT_NONE


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def evaluate_forces(model, state):
    """Internal forces and gravity of a state into `state.node_force` [N], without contact."""
    _begin_forces(model, state)
    _add_spring_forces(model, state)
    _add_volume_forces(model, state)
