"""Supports of an organ: contact with solids (pressure, stick-slip friction), elastic foundations, and their motion."""

import math

from numba import njit

from msdm_core.kernels.contact_kernels import stick_or_slip
from msdm_core.kernels.layout_kernels import load_item, load_part, parts_of, store_part, where_moving
from msdm_core.kernels.option_kernels import INLINED, INNER, KERNEL
from msdm_core.kernels.space_kernels import (
    add_to_row,
    divided,
    length_of,
    minus,
    row_of,
    scalar_product,
    set_row,
    shifted,
    times,
)
from msdm_core.kernels.vector_kernels import load_row

PLANE, SPHERE, CAPSULE, BOX = 0, 1, 2, 3


@njit(**KERNEL)
def add_support_forces(model, ground, position, velocity, force, stretch, load, dt):
    """Contact of surface nodes with supports; forces of several supports add up.

    On a node of area A at the depth d acts A max(0, k_p d - c n . v) along the solid's outward normal n, and across it
    a spring of k_t A with a stretch that follows the node, at most mu times the normal force (Coulomb). The stretch
    belongs to node and support, is zero while the node is outside, and turns with the normal. Velocities are relative
    to the solid's.

    Model: model
    In:    ground: position [m], velocity [m/s] of the solids (n_support, 2, 3), position, velocity (n_node, 3), dt [s]
    Out:   force, added to [N] (n_node, 3), stretch [m] (n_support_node, n_support, 3), load: of each solid on the organ
           [N] (n_support, 3)
    """
    nodes, areas, kinds = model.support_nodes, model.support_area, model.support_kind
    rotation, size, frictions = model.support_rotation, model.support_size, model.support_friction
    stiffness, damping, across = model.support_stiffness, model.support_damping, model.support_tangential_stiffness
    for support in range(kinds.shape[0]):
        kind, friction = kinds[support], frictions[support]
        place, speed, lengths = row_of(ground[support], 0), row_of(ground[support], 1), row_of(size, support)
        load[support] = 0.0
        a, b, c = _column(rotation[support], 0), _column(rotation[support], 1), _column(rotation[support], 2)
        for item in range(nodes.shape[0]):
            node = nodes[item]
            offset = minus(row_of(position, node), place)
            inside = (scalar_product(a, offset), scalar_product(b, offset), scalar_product(c, offset))
            depth, out = depth_inside(kind, lengths, inside)
            if depth <= 0.0:
                for axis in range(3):
                    stretch[item, support, axis] = 0.0
                continue
            normal = shifted(shifted(times(out[0], a), out[1], b), out[2], c)
            relative = minus(row_of(velocity, node), speed)
            pressure = stiffness * depth - damping * scalar_product(normal, relative)
            if pressure < 0.0:
                pressure = 0.0
            longest = friction * pressure / across
            moved = stick_or_slip(row_of(stretch[item], support), relative, dt, normal, longest)
            set_row(stretch[item], support, 0, moved)
            push = times(areas[item], minus(times(pressure, normal), times(across, moved)))
            add_to_row(force, node, push)
            add_to_row(load, support, push)


@njit(**INLINED)
def _column(matrix, column):
    """A column of a matrix (3, 3)."""
    return matrix[0, column], matrix[1, column], matrix[2, column]


@njit(**KERNEL)
def add_foundation_forces(nodes, ground, stiffness, position, force):
    """Elastic force on nodes towards their places of rest: f = -K (x - x0).

    In:  nodes (n_held,), ground: x0 [m] (n_held, 3), stiffness: K [N/m] (n_held, 3, 3), position [m] (n_node, 3)
    Out: force, added to [N] (n_node, 3)
    """
    for item in range(nodes.shape[0]):
        node = nodes[item]
        stretch = minus(row_of(position, node), row_of(ground, item))
        for axis in range(3):
            force[node, axis] -= scalar_product(row_of(stiffness[item], axis), stretch)


@njit(**KERNEL)
def place_ground(model, motion, foundation, support):
    """Present place of the ground, x0 + sum of s_m d_m, and its speed, sum of ds_m/dt d_m, over the motions m.

    Model: model: shifts d_m
    In:    motion: signals s_m and their rates [1/s] (n_motion, 4)
    Out:   foundation [m] (n_held, 3), support: position [m] and velocity [m/s] (n_support, 2, 3)
    """
    for item in range(foundation.shape[0]):
        for axis in range(3):
            place = model.foundation_position[item, axis]
            for number in range(motion.shape[0]):
                place += motion[number, 0] * model.motion_foundation_shift[number, item, axis]
            foundation[item, axis] = place
    for item in range(support.shape[0]):
        for axis in range(3):
            place, speed = model.support_position[item, axis], 0.0
            for number in range(motion.shape[0]):
                place += motion[number, 0] * model.motion_support_shift[number, item, axis]
                speed += motion[number, 1] * model.motion_support_shift[number, item, axis]
            support[item, 0, axis] = place
            support[item, 1, axis] = speed


@njit(**INNER)
def carry_anchors(model, motion, velocity):
    """Give anchored nodes the speed of the ground, v = sum of ds_m/dt d_m.

    Model: model: shifts d_m
    In:    motion: signals s_m and their rates [1/s] (n_motion, 4)
    Out:   velocity [m/s] (n_node, 3)
    """
    for item in range(model.motion_anchored_nodes.shape[0]):
        node = model.motion_anchored_nodes[item]
        for axis in range(3):
            speed = 0.0
            for number in range(motion.shape[0]):
                speed += motion[number, 1] * model.motion_node_shift[number, node, axis]
            velocity[node, axis] = speed


@njit(**INLINED)
def _ground_shift(lanes, shift, number, node, part):
    """Part of a motion's shift of a node, see `layout_kernels.load_part`."""
    if len(lanes) == 0:
        return load_row(shift, number * shift.shape[1] + node)
    return _lanes_shift(lanes, shift, number, node, part)


@njit(**INLINED)
def _lanes_shift(lanes, shift, number, node, part):
    """Number common to all lanes, or vector of each lane's own."""
    if shift.ndim == 4:
        return load_item(lanes, shift, (number * shift.shape[1] + node) * shift.shape[2] + part)
    return shift[number, node, part]


@njit(**INNER)
def drag_along(lanes, shift, rate, moving, decay, velocity):
    """Prepare velocities for damping relative to the ground's by the integration v' = decay v + ...

    With its speed w = sum of ds_m/dt d_m: v' = decay (v - w) + w + ..., so that anchored nodes keep the speed w.

    In:  shift: d_m [m] (n_motion, n_node, 4), or with a last index n_lane each lane's own, rate: ds_m/dt [1/s]
         (n_motion,), moving: 1 for a moving organ (1,), decay
    Out: velocity [m/s] (n_node, 4)
    """
    more, parts = (1.0 - decay) / decay, parts_of(lanes)
    if more == 0.0:
        return
    for node in range(shift.shape[1]):
        for part in range(parts):
            before = load_part(lanes, velocity, parts * node + part)
            after = before
            for number in range(shift.shape[0]):
                after = after + _ground_shift(lanes, shift, number, node, part) * (
                    load_item(lanes, rate, number) * more
                )
            store_part(lanes, velocity, parts * node + part, where_moving(lanes, moving, after, before))


@njit(**INNER)
def move_ground(model, position, force, foundation, load, motion, dt):
    """Add the work of the ground on the organ, and advance the signals by a step.

    The force F of the ground does the work F . d_m ds_m: F = -f at an anchored node, K (x0 - x) below a foundation, and
    a support's load. By the trapezoidal rule, with the rates before and after, dW_m = F . d_m (r_m + r'_m) dt / 2.

    Model: model: shifts d_m
    In:    position [m] (n_node, 3), force [N] (n_node, 3), foundation [m] (n_held, 3), load [N] (n_support, 3), dt [s]
    Out:   motion (n_motion, 4)
    """
    for number in range(motion.shape[0]):
        shift = model.motion_node_shift[number]
        # Three independent sums overlap.
        x, y, z = 0.0, 0.0, 0.0
        for item in range(model.motion_anchored_nodes.shape[0]):
            node = model.motion_anchored_nodes[item]
            x -= force[node, 0] * shift[node, 0]
            y -= force[node, 1] * shift[node, 1]
            z -= force[node, 2] * shift[node, 2]
        power = x + y + z
        shift = model.motion_foundation_shift[number]
        for item in range(foundation.shape[0]):
            node = model.foundation_nodes[item]
            for axis in range(3):
                push = 0.0
                for other in range(3):
                    stretch = foundation[item, other] - position[node, other]
                    push += model.foundation_stiffness[item, axis, other] * stretch
                power += push * shift[item, axis]
        shift = model.motion_support_shift[number]
        for item in range(load.shape[0]):
            for axis in range(3):
                power += load[item, axis] * shift[item, axis]
        motion[number, 3] += 0.5 * power * (motion[number, 1] + motion[number, 2]) * dt
        motion[number, 2] = motion[number, 1]
        motion[number, 0] += motion[number, 1] * dt


@njit(**INNER)
def depth_inside(kind, size, point):
    """Depth of a point in a solid, and the outward normal, in the frame of the solid.

    In a box the normal is that of the nearest face; at the centre of a sphere or on the axis of a capsule it is x.

    In: kind: PLANE, SPHERE, CAPSULE or BOX; size: radius, half length, half sizes [m]; point [m]
    Returns the depth [m], at most 0 outside, and the unit normal.
    """
    x, y, z = point
    if kind == PLANE:
        return -z, (0.0, 0.0, 1.0)
    if kind == BOX:
        # Distances to the nearer of two faces.
        dx = size[0] - abs(x)
        dy = size[1] - abs(y)
        dz = size[2] - abs(z)
        if dz <= dx and dz <= dy:
            return dz, (0.0, 0.0, math.copysign(1.0, z))
        if dy <= dx:
            return dy, (0.0, math.copysign(1.0, y), 0.0)
        return dx, (math.copysign(1.0, x), 0.0, 0.0)
    if kind == CAPSULE:
        z -= min(size[1], max(-size[1], z))
    distance = length_of((x, y, z))
    if distance == 0.0:
        return size[0], (1.0, 0.0, 0.0)
    return size[0] - distance, divided((x, y, z), distance)
