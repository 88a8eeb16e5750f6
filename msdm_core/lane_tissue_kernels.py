"""Springs and volume term of several organs of one mesh side by side: the organ's number is the last index of an array.

One register holds the same number of every organ (8 of float64, 16 or 8 of float32), so that nothing is gathered or
scattered. The equations are those of `element_kernels`, the sums in the order of `tissue_kernels`: an organ moves to
the bit as it would alone.
"""

import numpy as np
from numba import njit

from msdm_core.element_kernels import (
    SQUEEZED_RATIO,
    node_tension,
    six_rates,
    spring_drag,
    spring_scale,
    tet_scale,
    tet_shape,
    volume_ratio,
)
from msdm_core.vector import any_below, keep_lower, load_lanes, load_or_spread, store_lanes


@njit(forceinline=True, error_model="numpy")
def _difference(lanes, values, items, item, corner):
    """From corner 0 of an item to another of its corners, as three vectors."""
    i, j = 3 * np.intp(items[item, 0]), 3 * np.intp(items[item, corner])
    return (
        load_lanes(lanes, values, j) - load_lanes(lanes, values, i),
        load_lanes(lanes, values, j + 1) - load_lanes(lanes, values, i + 1),
        load_lanes(lanes, values, j + 2) - load_lanes(lanes, values, i + 2),
    )


@njit(forceinline=True, error_model="numpy")
def _add(lanes, force, node, x, y, z):
    """Add to a node's force."""
    place = 3 * np.intp(node)
    store_lanes(force, place, load_lanes(lanes, force, place) + x)
    store_lanes(force, place + 1, load_lanes(lanes, force, place + 1) + y)
    store_lanes(force, place + 2, load_lanes(lanes, force, place + 2) + z)


@njit(forceinline=True, error_model="numpy")
def _subtract(lanes, force, node, x, y, z):
    """Take from a node's force."""
    place = 3 * np.intp(node)
    store_lanes(force, place, load_lanes(lanes, force, place) - x)
    store_lanes(force, place + 1, load_lanes(lanes, force, place + 1) - y)
    store_lanes(force, place + 2, load_lanes(lanes, force, place + 2) - z)


@njit(forceinline=True, error_model="numpy")
def _share(lanes, total, items, item, value):
    """Add to each corner of a tet."""
    for corner in range(4):
        node = items[item, corner]
        store_lanes(total, node, load_lanes(lanes, total, node) + value)


@njit(forceinline=True, error_model="numpy")
def _where_moving(moving, after, before):
    """Organ by organ the one value where it moves (1), the other where it stands still (0)."""
    return keep_lower(moving, moving * 0.0 + 1.0, before, after)


@njit(cache=True, nogil=True, error_model="numpy")
def set_gravity(lanes, force, mass, gravity):
    """F = m g."""
    for node in range(force.shape[0]):
        for axis in range(3):
            store_lanes(force, 3 * node + axis, load_lanes(lanes, mass, node) * gravity[axis])


@njit(cache=True, nogil=True, error_model="numpy")
def integrate(lanes, position, velocity, force, inverse_mass, dt, decay, moving, total):
    """Symplectic Euler of the organs that move, as in `tissue_kernels`; `total` (1, organ) is finite where all is."""
    moves = load_lanes(lanes, moving, 0)
    check = moves * 0.0
    for node in range(position.shape[0]):
        rate = load_lanes(lanes, inverse_mass, node) * dt
        for axis in range(3):
            part = 3 * node + axis
            speed_before, place_before = load_lanes(lanes, velocity, part), load_lanes(lanes, position, part)
            speed = speed_before * decay + load_lanes(lanes, force, part) * rate
            place = place_before + speed * dt
            store_lanes(velocity, part, _where_moving(moves, speed, speed_before))
            store_lanes(position, part, _where_moving(moves, place, place_before))
            check = check + (place + speed)
    store_lanes(total, 0, check)


@njit(cache=True, nogil=True, error_model="numpy")
def put_back(lanes, values, kept, moving):
    """Give the organs that stand still the values that were kept of them."""
    moves = load_lanes(lanes, moving, 0)
    for node in range(values.shape[0]):
        for axis in range(3):
            part = 3 * node + axis
            store_lanes(
                values, part, _where_moving(moves, load_lanes(lanes, values, part), load_lanes(lanes, kept, part))
            )


@njit(cache=True, nogil=True, error_model="numpy")
def add_spring_forces(lanes, position, force, nodes, stiffness, rest_length, begin):
    """Springs from one on to the last: f = k (l - l0) along the spring (Sala 2011, eq. 1)."""
    for spring in range(begin, nodes.shape[0]):
        x, y, z = _difference(lanes, position, nodes, spring, 1)
        scale = spring_scale(
            x, y, z, load_lanes(lanes, stiffness, spring), load_or_spread(lanes, position, rest_length, spring)
        )
        x, y, z = x * scale, y * scale, z * scale
        _add(lanes, force, nodes[spring, 0], x, y, z)
        _subtract(lanes, force, nodes[spring, 1], x, y, z)


@njit(cache=True, nogil=True, error_model="numpy")
def add_spring_damping(lanes, position, velocity, force, nodes, stiffness, beta):
    """Rayleigh's beta along the springs: f = k beta dl/dt."""
    for spring in range(nodes.shape[0]):
        x, y, z = _difference(lanes, position, nodes, spring, 1)
        vx, vy, vz = _difference(lanes, velocity, nodes, spring, 1)
        scale = spring_drag(x, y, z, vx, vy, vz, load_lanes(lanes, stiffness, spring), beta)
        x, y, z = x * scale, y * scale, z * scale
        _add(lanes, force, nodes[spring, 0], x, y, z)
        _subtract(lanes, force, nodes[spring, 1], x, y, z)


@njit(forceinline=True, error_model="numpy")
def _three_edges(lanes, values, tets, tet):
    """From corner 0 of a tet to its other three."""
    return (
        _difference(lanes, values, tets, tet, 1),
        _difference(lanes, values, tets, tet, 2),
        _difference(lanes, values, tets, tet, 3),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def average_volumes(lanes, position, velocity, tension, tets, node_inverse_volume, node_bulk, beta):
    """Tension of the volumes averaged at nodes [Pa], K_a (J_a - 1), with beta's share."""
    tension[:, :] = 0.0
    for tet in range(tets.shape[0]):
        _, six = tet_shape(*_three_edges(lanes, position, tets, tet))
        _share(lanes, tension, tets, tet, six)
    if beta > 0.0:
        for tet in range(tets.shape[0]):
            gradients, _ = tet_shape(*_three_edges(lanes, position, tets, tet))
            _share(lanes, tension, tets, tet, beta * six_rates(*_three_edges(lanes, velocity, tets, tet), gradients))
    for node in range(tension.shape[0]):
        inverse = load_or_spread(lanes, position, node_inverse_volume, node)
        store_lanes(
            tension, node, node_tension(load_lanes(lanes, tension, node), inverse, load_lanes(lanes, node_bulk, node))
        )


@njit(forceinline=True, error_model="numpy")
def _push(lanes, force, tets, tet, scale, g, pull, edge):
    """Forces of a tet on its corners, and of the spring along its first edge."""
    bx, by, bz = scale * g[0] - pull * edge[0], scale * g[1] - pull * edge[1], scale * g[2] - pull * edge[2]
    cx, cy, cz = scale * g[3], scale * g[4], scale * g[5]
    dx, dy, dz = scale * g[6], scale * g[7], scale * g[8]
    _subtract(lanes, force, tets[tet, 0], bx + cx + dx, by + cy + dy, bz + cz + dz)
    _add(lanes, force, tets[tet, 1], bx, by, bz)
    _add(lanes, force, tets[tet, 2], cx, cy, cz)
    _add(lanes, force, tets[tet, 3], dx, dy, dz)


@njit(cache=True, nogil=True, error_model="numpy")
def add_tet_forces(
    lanes, position, force, tension, tets, inverse_volume, bulk, averaged_bulk, stiffness, rest_length, low, moving,
    squeezed,
):  # fmt: skip
    """Volume terms, as in `tissue_kernels`; keeps the smallest V / V0 seen of every organ that moves, (1, organ)."""
    lowest = load_lanes(lanes, low, 0)
    count = 0
    for tet in range(tets.shape[0]):
        edge, third, fourth = _three_edges(lanes, position, tets, tet)
        gradients, six = tet_shape(edge, third, fourth)
        ratio = volume_ratio(six, load_or_spread(lanes, position, inverse_volume, tet))
        lowest = keep_lower(ratio, lowest, ratio, lowest)
        if any_below(ratio, SQUEEZED_RATIO):
            squeezed[count] = tet
            count += 1
        averaged = 0.25 * (
            load_lanes(lanes, tension, tets[tet, 0]) + load_lanes(lanes, tension, tets[tet, 1])
            + load_lanes(lanes, tension, tets[tet, 2]) + load_lanes(lanes, tension, tets[tet, 3])
        )  # fmt: skip
        own, shared = load_lanes(lanes, bulk, tet), load_lanes(lanes, averaged_bulk, tet)
        scale = tet_scale(ratio, own, shared, averaged)
        length = load_or_spread(lanes, position, rest_length, tet)
        pull = spring_scale(edge[0], edge[1], edge[2], load_lanes(lanes, stiffness, tet), length)
        _push(lanes, force, tets, tet, scale, gradients, pull, edge)
    store_lanes(low, 0, _where_moving(load_lanes(lanes, moving, 0), lowest, load_lanes(lanes, low, 0)))
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def add_volume_damping(lanes, position, velocity, force, tets, inverse_volume, bulk, beta):
    """Beta's share of each tet's own volume term: tension K beta dJ/dt."""
    for tet in range(tets.shape[0]):
        gradients, _ = tet_shape(*_three_edges(lanes, position, tets, tet))
        six_rate = six_rates(*_three_edges(lanes, velocity, tets, tet), gradients)
        rate = beta * volume_ratio(six_rate, load_or_spread(lanes, position, inverse_volume, tet))
        _push(
            lanes,
            force,
            tets,
            tet,
            load_lanes(lanes, bulk, tet) * rate * (-1.0 / 6.0),
            gradients,
            rate * 0.0,
            gradients,
        )
