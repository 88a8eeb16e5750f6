"""Springs, volume term and integration of an organ alone, or of organs of the same tets side by side.

The equations are those of `element_kernels`, the places in memory those of `layout_kernels`. For an organ alone
`group_kernels` does the bulk of springs and tets, eight at a time; the plain loops here do what is left over, and all
of it for organs side by side. The sums have the same order in every case: an organ moves to the bit as it would alone.
"""

from numba import njit

from msdm_core.kernels.element_kernels import (
    SQUEEZED_RATIO,
    node_tension,
    six_rates,
    spring_drag,
    spring_scale,
    tet_scale,
    tet_shape,
    volume_ratio,
)
from msdm_core.kernels.group_kernels import GROUP, add_spring_groups, add_tet_groups, sum_volume_groups
from msdm_core.kernels.layout_kernels import (
    add_to_corners,
    add_to_node,
    corner_mean,
    difference,
    load_item,
    load_part,
    load_shared,
    parts_of,
    store_item,
    store_part,
    store_sum,
    take_from_node,
    three_edges,
    where_moving,
)
from msdm_core.kernels.vector_kernels import any_below, keep_lower


@njit(forceinline=True, error_model="numpy")
def group_width(lanes):
    """How many tets in a row an entry of `squeezed_tets` stands for."""
    if len(lanes) == 0:
        return GROUP
    return 1


@njit(cache=True, nogil=True, error_model="numpy")
def set_gravity(lanes, force, mass, gravity):
    """F = m g.

    In:  mass [kg] (n_node,), gravity [m/s^2] (3,)
    Out: force [N] (n_node, 4)
    """
    for node in range(force.shape[0]):
        if len(lanes) == 0:
            for axis in range(3):
                force[node, axis] = mass[node] * gravity[axis]
            force[node, 3] = 0.0
        else:
            for axis in range(3):
                store_item(lanes, force, 3 * node + axis, load_item(lanes, mass, node) * gravity[axis])


@njit(cache=True, nogil=True, error_model="numpy")
def integrate(lanes, position, velocity, force, inverse_mass, dt, decay, moving, finite_sum):
    """Symplectic Euler of the organs that move: v = decay v + dt f / m, x = x + dt v, decay = e^(-alpha dt).

    In:  force [N] (n_node, 4), inverse_mass [1/kg] (n_node,), dt [s], decay, moving: 1 where an organ moves (1,)
    Out: position [m], velocity [m/s] (n_node, 4), finite_sum: finite where all of an organ's numbers are (1,)
    """
    parts = parts_of(lanes)
    check = load_part(lanes, position, 0) * 0.0
    for node in range(position.shape[0]):
        rate = load_item(lanes, inverse_mass, node) * dt
        for part in range(parts * node, parts * node + parts):
            speed_before, place_before = load_part(lanes, velocity, part), load_part(lanes, position, part)
            speed = speed_before * decay + load_part(lanes, force, part) * rate
            place = place_before + speed * dt
            store_part(lanes, velocity, part, where_moving(lanes, moving, speed, speed_before))
            store_part(lanes, position, part, where_moving(lanes, moving, place, place_before))
            check = check + (place + speed)
    store_sum(lanes, finite_sum, check)


@njit(cache=True, nogil=True, error_model="numpy")
def put_back(lanes, values, kept, moving):
    """Restore the kept values of organs that do not move.

    In:  kept (n_node, 3, n_lane), moving: 1 where an organ moves (1, n_lane)
    Out: values (n_node, 3, n_lane)
    """
    for part in range(3 * values.shape[0]):
        value = where_moving(lanes, moving, load_part(lanes, values, part), load_part(lanes, kept, part))
        store_part(lanes, values, part, value)


@njit(forceinline=True, error_model="numpy")
def _pull_ends(lanes, force, nodes, spring, x, y, z, scale):
    """Pull the ends of a spring together with `scale` times the way from the one to the other."""
    x, y, z = x * scale, y * scale, z * scale
    add_to_node(lanes, force, nodes[spring, 0], x, y, z)
    take_from_node(lanes, force, nodes[spring, 1], x, y, z)


@njit(forceinline=True, error_model="numpy")
def _add_groups_of_springs(lanes, position, force, nodes, stiffness, rest_length, begin):
    """`add_spring_groups` for an organ alone; returns the first spring that is left over."""
    if len(lanes) == 0:
        return add_spring_groups(position, force, nodes, stiffness, rest_length, begin)
    return begin


@njit(cache=True, nogil=True, error_model="numpy")
def add_spring_forces(lanes, position, force, nodes, stiffness, rest_length, begin):
    """Springs from number `begin` on to the last: f = k (l - l0) along the spring (Sala 2011, eq. 1).

    In:  position [m] (n_node, 4), nodes (n_spring, 2), stiffness [N/m], rest_length [m] (n_spring,), begin
    Out: force, added to [N] (n_node, 4)
    """
    first = _add_groups_of_springs(lanes, position, force, nodes, stiffness, rest_length, begin)
    for spring in range(first, nodes.shape[0]):
        x, y, z = difference(lanes, position, nodes, spring, 1)
        length = load_shared(lanes, position, rest_length, spring)
        scale = spring_scale(x, y, z, load_item(lanes, stiffness, spring), length)
        _pull_ends(lanes, force, nodes, spring, x, y, z, scale)


@njit(cache=True, nogil=True, error_model="numpy")
def add_spring_damping(lanes, position, velocity, force, nodes, stiffness, beta):
    """Rayleigh's beta along all springs: f = k beta dl/dt.

    In:  position [m], velocity [m/s] (n_node, 4), nodes (n_spring, 2), stiffness [N/m] (n_spring,), beta [s]
    Out: force, added to [N] (n_node, 4)
    """
    for spring in range(nodes.shape[0]):
        x, y, z = difference(lanes, position, nodes, spring, 1)
        vx, vy, vz = difference(lanes, velocity, nodes, spring, 1)
        scale = spring_drag(x, y, z, vx, vy, vz, load_item(lanes, stiffness, spring), beta)
        _pull_ends(lanes, force, nodes, spring, x, y, z, scale)


@njit(forceinline=True, error_model="numpy")
def _sum_groups_of_volumes(lanes, position, total, tets):
    """`sum_volume_groups` for an organ alone; returns the first tet that is left over."""
    if len(lanes) == 0:
        return sum_volume_groups(position, total, tets)
    return 0


@njit(cache=True, nogil=True, error_model="numpy")
def set_node_tension(lanes, tension, node_inverse_volume, node_bulk):
    """From the sums of six times the volumes around nodes to the tension of the averaged volumes.

    In:  node_inverse_volume [1/m^3], node_bulk [Pa] (n_node,)
    Out: tension: the sums before [m^3], [Pa] after (n_node,)
    """
    for node in range(tension.shape[0]):
        inverse = load_shared(lanes, tension, node_inverse_volume, node)
        bulk = load_item(lanes, node_bulk, node)
        store_item(lanes, tension, node, node_tension(load_item(lanes, tension, node), inverse, bulk))


@njit(cache=True, nogil=True, error_model="numpy")
def average_volumes(lanes, position, velocity, tension, tets, node_inverse_volume, node_bulk, beta):
    """Tension of the volumes averaged at nodes, K_a (J_a - 1), with beta's share of their rates.

    In:  position [m], velocity [m/s] (n_node, 4), tets (n_tet, 4), node_inverse_volume [1/m^3], node_bulk [Pa]
         (n_node,), beta [s]
    Out: tension, zero before [Pa] (n_node,)
    """
    for tet in range(_sum_groups_of_volumes(lanes, position, tension, tets), tets.shape[0]):
        _, six = tet_shape(*three_edges(lanes, position, tets, tet))
        add_to_corners(lanes, tension, tets, tet, six)
    if beta > 0.0:
        for tet in range(tets.shape[0]):
            gradients, _ = tet_shape(*three_edges(lanes, position, tets, tet))
            six_rate = six_rates(*three_edges(lanes, velocity, tets, tet), gradients)
            add_to_corners(lanes, tension, tets, tet, beta * six_rate)
    set_node_tension(lanes, tension, node_inverse_volume, node_bulk)


@njit(forceinline=True, error_model="numpy")
def _push_corners(lanes, force, tets, tet, scale, g, pull, edge):
    """Forces of a tet on its corners, and of the spring along its first edge."""
    bx, by, bz = scale * g[0] - pull * edge[0], scale * g[1] - pull * edge[1], scale * g[2] - pull * edge[2]
    cx, cy, cz = scale * g[3], scale * g[4], scale * g[5]
    dx, dy, dz = scale * g[6], scale * g[7], scale * g[8]
    take_from_node(lanes, force, tets[tet, 0], bx + cx + dx, by + cy + dy, bz + cz + dz)
    add_to_node(lanes, force, tets[tet, 1], bx, by, bz)
    add_to_node(lanes, force, tets[tet, 2], cx, cy, cz)
    add_to_node(lanes, force, tets[tet, 3], dx, dy, dz)


@njit(forceinline=True, error_model="numpy")
def _add_groups_of_tets(
    lanes, position, force, tension, tets, inverse_volume, bulk, averaged_bulk, stiffness, rest_length, low, squeezed
):  # fmt: skip
    """`add_tet_groups` for an organ alone; returns the first tet that is left over and the entries of `squeezed`."""
    if len(lanes) == 0:
        return add_tet_groups(
            position, force, tension, tets, inverse_volume, bulk, averaged_bulk, stiffness, rest_length, low, squeezed
        )
    return 0, 0


@njit(cache=True, nogil=True, error_model="numpy")
def add_tet_forces(
    lanes, position, force, tension, tets, inverse_volume, bulk, averaged_bulk, stiffness, rest_length, low, moving,
    squeezed,
):  # fmt: skip
    """Volume terms: a tet pulls its corners with its tension times dV/dx; spring t comes with tet t, its first edge.

    K (J - 1) per tet adds K to Lame's lambda and nothing to mu (after the volume-only energy of Golec et al. 2020); the
    mean tension of the volumes averaged at its corners comes on top.

    In:  position [m] (n_node, 4), tension [Pa] (n_node,), tets (n_tet, 4), inverse_volume [1/m^3], bulk, averaged_bulk
         [Pa] (n_tet,), stiffness [N/m], rest_length [m] (n_spring,), moving: 1 where an organ moves (1,)
    Out: force, added to [N] (n_node, 4), low: the smallest V / V0 seen, its value before included (1,),
         squeezed: the first of each `group_width` tets among which one is below SQUEEZED_RATIO (n_tet,)
    Returns how many entries `squeezed` has.
    """
    first, count = _add_groups_of_tets(
        lanes, position, force, tension, tets, inverse_volume, bulk, averaged_bulk, stiffness, rest_length, low,
        squeezed,
    )  # fmt: skip
    width = group_width(lanes)
    lowest = load_item(lanes, low, 0)
    for tet in range(first, tets.shape[0]):
        edge, third, fourth = three_edges(lanes, position, tets, tet)
        gradients, six = tet_shape(edge, third, fourth)
        ratio = volume_ratio(six, load_shared(lanes, position, inverse_volume, tet))
        lowest = keep_lower(ratio, lowest, ratio, lowest)
        if any_below(ratio, SQUEEZED_RATIO):
            entry = tet // width * width
            if count == 0 or squeezed[count - 1] != entry:
                squeezed[count] = entry
                count += 1
        averaged = corner_mean(lanes, tension, tets, tet)
        scale = tet_scale(ratio, load_item(lanes, bulk, tet), load_item(lanes, averaged_bulk, tet), averaged)
        length = load_shared(lanes, position, rest_length, tet)
        pull = spring_scale(edge[0], edge[1], edge[2], load_item(lanes, stiffness, tet), length)
        _push_corners(lanes, force, tets, tet, scale, gradients, pull, edge)
    store_item(lanes, low, 0, where_moving(lanes, moving, lowest, load_item(lanes, low, 0)))
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def add_volume_damping(lanes, position, velocity, force, tets, inverse_volume, bulk, beta):
    """Beta's share of each tet's own volume term: tension K beta dJ/dt.

    In:  position [m], velocity [m/s] (n_node, 4), tets (n_tet, 4), inverse_volume [1/m^3], bulk [Pa] (n_tet,), beta [s]
    Out: force, added to [N] (n_node, 4)
    """
    for tet in range(tets.shape[0]):
        gradients, _ = tet_shape(*three_edges(lanes, position, tets, tet))
        six_rate = six_rates(*three_edges(lanes, velocity, tets, tet), gradients)
        rate = beta * volume_ratio(six_rate, load_shared(lanes, position, inverse_volume, tet))
        scale = load_item(lanes, bulk, tet) * rate * (-1.0 / 6.0)
        _push_corners(lanes, force, tets, tet, scale, gradients, rate * 0.0, gradients)
