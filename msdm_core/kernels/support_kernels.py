"""What holds an organ: contact with fixed solids (pressure, stick-slip friction) and elastic foundations."""

import math

from numba import njit

from msdm_core.kernels.contact_kernels import stick_or_slip

PLANE, SPHERE, CAPSULE, BOX = 0, 1, 2, 3


@njit(cache=True, nogil=True, error_model="numpy")
def add_support_forces(model, position, velocity, force, stretch, dt):
    """Push every surface node out of the supports that it is in; two supports both push.

    A node of area A, d deep, is held off along the solid's outward normal n with A max(0, k_p d - c n . v), and across
    it by a spring of k_t A whose stretch follows the node and is cut where it would pull more than mu times that. The
    stretch belongs to node and support, is zero while the node is outside, and turns with the normal.

    Model: model
    In:    position, velocity (n_node, 3), dt [s]
    Out:   force, added to [N] (n_node, 3), stretch [m] (n_support_node, n_support, 3)
    """
    nodes, areas, kinds, centre = model.support_nodes, model.support_area, model.support_kind, model.support_position
    rotation, size, frictions = model.support_rotation, model.support_size, model.support_friction
    stiffness, damping, across = model.support_stiffness, model.support_damping, model.support_tangential_stiffness
    for support in range(kinds.shape[0]):
        kind, friction = kinds[support], frictions[support]
        cx, cy, cz = centre[support, 0], centre[support, 1], centre[support, 2]
        ax, ay, az = rotation[support, 0, 0], rotation[support, 1, 0], rotation[support, 2, 0]
        bx, by, bz = rotation[support, 0, 1], rotation[support, 1, 1], rotation[support, 2, 1]
        ex, ey, ez = rotation[support, 0, 2], rotation[support, 1, 2], rotation[support, 2, 2]
        first, second, third = size[support, 0], size[support, 1], size[support, 2]
        for item in range(nodes.shape[0]):
            node = nodes[item]
            ox = position[node, 0] - cx
            oy = position[node, 1] - cy
            oz = position[node, 2] - cz
            x = ax * ox + ay * oy + az * oz
            y = bx * ox + by * oy + bz * oz
            z = ex * ox + ey * oy + ez * oz
            depth, lx, ly, lz = depth_inside(kind, first, second, third, x, y, z)
            if depth <= 0.0:
                stretch[item, support, 0] = 0.0
                stretch[item, support, 1] = 0.0
                stretch[item, support, 2] = 0.0
                continue
            nx = ax * lx + bx * ly + ex * lz
            ny = ay * lx + by * ly + ey * lz
            nz = az * lx + bz * ly + ez * lz
            vx = velocity[node, 0]
            vy = velocity[node, 1]
            vz = velocity[node, 2]
            load = stiffness * depth - damping * (nx * vx + ny * vy + nz * vz)
            if load < 0.0:
                load = 0.0
            ux, uy, uz = stretch[item, support, 0], stretch[item, support, 1], stretch[item, support, 2]
            ux, uy, uz = stick_or_slip(ux, uy, uz, vx, vy, vz, dt, nx, ny, nz, friction * load / across)
            stretch[item, support, 0] = ux
            stretch[item, support, 1] = uy
            stretch[item, support, 2] = uz
            area = areas[item]
            force[node, 0] += area * (load * nx - across * ux)
            force[node, 1] += area * (load * ny - across * uy)
            force[node, 2] += area * (load * nz - across * uz)


@njit(cache=True, nogil=True, error_model="numpy")
def add_foundation_forces(nodes, rest, stiffness, position, force):
    """Hold nodes elastically where they are without force: f = -K (x - x0).

    In:  nodes (n_held,), rest: x0 [m] (n_held, 3), stiffness: K [N/m] (n_held, 3, 3), position [m] (n_node, 3)
    Out: force, added to [N] (n_node, 3)
    """
    for item in range(nodes.shape[0]):
        node = nodes[item]
        x = position[node, 0] - rest[item, 0]
        y = position[node, 1] - rest[item, 1]
        z = position[node, 2] - rest[item, 2]
        for axis in range(3):
            force[node, axis] -= (
                stiffness[item, axis, 0] * x + stiffness[item, axis, 1] * y + stiffness[item, axis, 2] * z
            )


@njit(cache=True, nogil=True, error_model="numpy")
def depth_inside(kind, first, second, third, x, y, z):
    """Depth of a point in a solid, and the outward normal there, in the frame of the solid.

    In a box the normal is that of the nearest face, at the centre of a sphere or on the axis of a capsule it is x.

    In: kind: PLANE, SPHERE, CAPSULE or BOX; first, second, third: radius, half length, half sizes [m]; x, y, z [m]
    Returns the depth [m], at most 0 outside, and the three components of the unit normal.
    """
    if kind == PLANE:
        return -z, 0.0, 0.0, 1.0
    if kind == BOX:
        # Distances to the nearer of two faces.
        dx = first - abs(x)
        dy = second - abs(y)
        dz = third - abs(z)
        if dz <= dx and dz <= dy:
            return dz, 0.0, 0.0, math.copysign(1.0, z)
        if dy <= dx:
            return dy, 0.0, math.copysign(1.0, y), 0.0
        return dx, math.copysign(1.0, x), 0.0, 0.0
    if kind == CAPSULE:
        z -= min(second, max(-second, z))
    distance = math.sqrt(x * x + y * y + z * z)
    if distance == 0.0:
        return first, 1.0, 0.0, 0.0
    return first - distance, x / distance, y / distance, z / distance
