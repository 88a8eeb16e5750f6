"""Springs, volume term and integration of an organ alone, or of organs of the same tets side by side.

The equations are those of `element_kernels`, the places in memory those of `layout_kernels`. For an organ alone
`group_kernels` does the bulk of springs and tets, GROUP at a time; the plain loops here do the remaining ones, and all
of them for organs side by side. The sums have the same order in both cases: an organ in a lane moves to the bit as it
would alone.
"""

from numba import njit

from msdm_core.kernels.element_kernels import (
    SQUEEZED_RATIO,
    STEEP_EXCESS,
    corner_gradient,
    node_law,
    node_tension,
    six_rates,
    spring_drag,
    spring_energy,
    spring_length,
    spring_scale,
    strain_square,
    tet_scale,
    tet_shape,
    volume_ratio,
)
from msdm_core.kernels.group_kernels import (
    add_energy_groups,
    add_spring_groups,
    add_tet_groups,
    set_node_law_groups,
    sum_tet_groups,
)
from msdm_core.kernels.layout_kernels import (
    add_half,
    add_to_corners,
    add_to_node,
    add_volume_and_energy,
    corner_mean,
    corner_mean_of_pairs,
    difference,
    load_half,
    load_item,
    load_part,
    load_shared,
    parts_of,
    store_half,
    store_item,
    store_part,
    store_sum,
    take_from_node,
    three_edges,
    where_moving,
)
from msdm_core.kernels.option_kernels import INLINED, INNER, KERNEL
from msdm_core.kernels.vector_kernels import GROUP, any_below, keep_lower


@njit(**INLINED)
def group_width(lanes):
    """Number of successive tets per entry of `squeezed_tets`."""
    if len(lanes) == 0:
        return GROUP
    return 1


@njit(**INNER)
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


@njit(**INNER)
def integrate(lanes, position, velocity, force, inverse_mass, dt, decay, moving, finite_sum):
    """Symplectic Euler step of the moving organs: v = decay v + dt f / m, x = x + dt v, decay = e^(-alpha dt).

    In:  force [N] (n_node, 4), inverse_mass [1/kg] (n_node,), dt [s], decay, moving: 1 for a moving organ (1,)
    Out: position [m], velocity [m/s] (n_node, 4), finite_sum: finite if all of an organ's numbers are (1,)
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


@njit(**INNER)
def put_back(lanes, values, kept, moving):
    """Restore the kept values of stopped organs.

    In:  kept (n_node, 3, n_lane), moving: 1 for a moving organ (1, n_lane)
    Out: values (n_node, 3, n_lane)
    """
    for part in range(3 * values.shape[0]):
        value = where_moving(lanes, moving, load_part(lanes, values, part), load_part(lanes, kept, part))
        store_part(lanes, values, part, value)


@njit(**INLINED)
def _pull_ends(lanes, force, nodes, spring, x, y, z, scale):
    """Pull the ends of a spring together with `scale` times the vector between them."""
    x, y, z = x * scale, y * scale, z * scale
    add_to_node(lanes, force, nodes[spring, 0], x, y, z)
    take_from_node(lanes, force, nodes[spring, 1], x, y, z)


@njit(**INLINED)
def _end_sum(lanes, pairs, items, item):
    """Sum of the second numbers of the pairs of a spring's two ends."""
    return load_half(lanes, pairs, items[item, 0], 1) + load_half(lanes, pairs, items[item, 1], 1)


@njit(**INLINED)
def _add_groups_of_energies(lanes, position, pairs, lengths, nodes, stiffness, rest_length, begin):
    """`add_energy_groups` for an organ alone; returns the first remaining spring."""
    if len(lanes) == 0:
        return add_energy_groups(position, pairs, lengths, nodes, stiffness, rest_length, begin)
    return begin


@njit(**INLINED)
def _keep_length(lanes, lengths, spring, length):
    """Keep the length of a spring of an organ alone.

    Organs side by side compute it again: memory limits them, and loads of all lengths take longer than the roots.
    """
    if len(lanes) == 0:
        lengths[spring] = length


@njit(**INLINED)
def _kept_length(lanes, lengths, spring, x, y, z):
    """Length of a spring, kept or computed again."""
    if len(lanes) == 0:
        return lengths[spring]
    return spring_length(x, y, z)


@njit(**INLINED)
def _measure(lanes, position, lengths, item, stiffness, rest_length, edge):
    """Keep the length of a spring along an edge; returns its `spring_energy`."""
    length = spring_length(edge[0], edge[1], edge[2])
    _keep_length(lanes, lengths, item, length)
    return spring_energy(length, load_shared(lanes, position, rest_length, item), load_item(lanes, stiffness, item))


@njit(**INNER)
def add_energies(lanes, position, pairs, lengths, nodes, stiffness, rest_length, begin):
    """Twice the energy of linear springs from number `begin` on, k (l - l0)^2, at both ends of each.

    In:  position [m] (n_node, 4), nodes (n_spring, 2), stiffness [N/m], rest_length [m] (n_spring,), begin
    Out: pairs: the energies are added to the second numbers [J] (n_node, 2), lengths: of an organ alone [m]
         (n_spring,)
    """
    for spring in range(
        _add_groups_of_energies(lanes, position, pairs, lengths, nodes, stiffness, rest_length, begin), nodes.shape[0]
    ):
        edge = difference(lanes, position, nodes, spring, 1)
        twice = _measure(lanes, position, lengths, spring, stiffness, rest_length, edge)
        add_half(lanes, pairs, nodes[spring, 0], 1, twice)
        add_half(lanes, pairs, nodes[spring, 1], 1, twice)


@njit(**INLINED)
def _set_groups_of_node_laws(lanes, pairs, inverse_volume, bulk, softness, onset, growth, excess, steepness):
    """`set_node_law_groups` for an organ alone; returns the first remaining node and the results of `set_node_laws`."""
    if len(lanes) == 0:
        return set_node_law_groups(pairs, inverse_volume, bulk, softness, onset, growth, excess, steepness)
    return 0, False, False


@njit(**INNER)
def set_node_laws(lanes, pairs, inverse_volume, bulk, softness, onset, growth, excess, steepness):
    """Tension of the averaged volumes and `node_law`, from the sums of volumes and energies around nodes.

    One loop for both, as the root and the quotient of the law take longer than all else of a node.

    In:  inverse_volume [1/m^3], bulk [Pa], softness [1/J], onset, growth, excess (n_node,) as in `OrganModel`
    Out: pairs: sums of six times the volumes [m^3] and of k (l - l0)^2 [J] before, tension [Pa] and half the factor on
         springs after (n_node, 2), steepness (n_node,)
    Returns True if any factor differs from 1, and True if any steepness is above STEEP_EXCESS.
    """
    first, stiffens, steepens = _set_groups_of_node_laws(
        lanes, pairs, inverse_volume, bulk, softness, onset, growth, excess, steepness
    )
    for node in range(first, steepness.shape[0]):
        six, energy = load_half(lanes, pairs, node, 0), load_half(lanes, pairs, node, 1)
        tension = node_tension(six, load_shared(lanes, pairs, inverse_volume, node), load_item(lanes, bulk, node))
        square = strain_square(energy, load_item(lanes, softness, node))
        begin = load_shared(lanes, pairs, onset, node)
        steeper = square * 0.0
        half = steeper + 0.5
        if any_below(begin * begin - square, 0.0):
            half, steeper = node_law(
                square, begin, load_shared(lanes, pairs, growth, node), load_shared(lanes, pairs, excess, node)
            )
            stiffens = True
            if any_below(STEEP_EXCESS - steeper, 0.0):
                steepens = True
        store_half(lanes, pairs, node, 0, tension)
        store_half(lanes, pairs, node, 1, half)
        store_item(lanes, steepness, node, steeper)
    return stiffens, steepens


@njit(**INLINED)
def _add_groups_of_springs(lanes, position, force, nodes, stiffness, rest_length, begin, law, steep_count):
    """`add_spring_groups` for an organ alone; returns the first remaining spring and the entries of `steep`."""
    if len(lanes) == 0:
        return add_spring_groups(position, force, nodes, stiffness, rest_length, begin, law, steep_count)
    return begin, steep_count


@njit(**INLINED)
def _give_way(lanes, arm_tension, arm, elastic, fade, moving):
    """Relax one arm towards the elastic tension over l0 of its spring [N/m]; returns its relief."""
    before = load_item(lanes, arm_tension, arm)
    after = before + (elastic - before) * fade
    store_item(lanes, arm_tension, arm, where_moving(lanes, moving, after, before))
    return after


@njit(**INLINED)
def fade_arms(lanes, arm_modulus, arm_tension, relief, springs, spring, elastic, fade, moving):
    """Relax the Maxwell arms of a spring towards its elastic tension: z_i <- z_i + fade_i (T_e - z_i).

    The arm's own tension is g_i (T_e - z_i); all tensions are over l0. At a constant strain z_i approaches T_e as
    1 - exp(-t / tau_i), and the energy stored in an arm never rises by its relaxation.

    In:  arm_modulus g_i (3 * n_spring,), springs: n_spring, elastic T_e / l0 [N/m], fade: share for each arm, moving
    Out: arm_tension z_i / l0 [N/m] (3 * n_spring,), relief: sum_i g_i z_i / l0 [N/m] (n_spring,)
    """
    second, third = springs + spring, 2 * springs + spring
    total = load_shared(lanes, arm_tension, arm_modulus, spring) * _give_way(
        lanes, arm_tension, spring, elastic, fade[0], moving
    )
    total = total + load_shared(lanes, arm_tension, arm_modulus, second) * _give_way(
        lanes, arm_tension, second, elastic, fade[1], moving
    )
    total = total + load_shared(lanes, arm_tension, arm_modulus, third) * _give_way(
        lanes, arm_tension, third, elastic, fade[2], moving
    )
    store_item(lanes, relief, spring, where_moving(lanes, moving, total, load_item(lanes, relief, spring)))


@njit(**INNER)
def add_spring_forces(lanes, position, force, nodes, stiffness, rest_length, begin, law, moving):
    """Springs from number `begin` on to the last: f = k (l - l0) along the spring (Sala 2011, eq. 1), and their law.

    In:  position [m] (n_node, 4), nodes (n_spring, 2), stiffness [N/m], rest_length [m] (n_spring,), begin, law:
         `SpringLaw`, moving: 1 for a moving organ (1,)
    Out: force, added to [N] (n_node, 4), law: arm_tension, relief, steep: first of each `group_width` springs with a
         steep spring
    Returns the number of entries in `law.steep`.
    """
    measured, lengths, pairs = law.measured, law.lengths, law.pairs
    stiffens, steepens, steep, steep_sum = law.stiffens, law.steepens, law.steep, law.steep_sum
    relaxes, gain, relief, fades, fade = law.relaxes, law.gain, law.relief, law.fades, law.fade
    arm_modulus, arm_tension = law.arm_modulus, law.arm_tension
    first, steep_count = _add_groups_of_springs(lanes, position, force, nodes, stiffness, rest_length, begin, law, 0)
    width = group_width(lanes)
    for spring in range(first, nodes.shape[0]):
        x, y, z = difference(lanes, position, nodes, spring, 1)
        if measured:
            length = _kept_length(lanes, lengths, spring, x, y, z)
        else:
            length = spring_length(x, y, z)
        share = load_shared(lanes, position, rest_length, spring) / length
        rigidity = load_item(lanes, stiffness, spring)
        scale = spring_scale(share, rigidity)
        if stiffens:
            factor = _end_sum(lanes, pairs, nodes, spring)
            scale = scale * factor
            if steepens and any_below(factor * -1.0, -steep_sum):
                entry = begin + (spring - begin) // width * width
                if steep_count == 0 or steep[steep_count - 1] != entry:
                    steep[steep_count] = entry
                    steep_count += 1
        if relaxes:
            if fades:
                fade_arms(
                    lanes, arm_modulus, arm_tension, relief, stiffness.shape[0], spring, scale / share, fade, moving
                )
            scale = scale * load_shared(lanes, position, gain, spring) - load_item(lanes, relief, spring) * share
        _pull_ends(lanes, force, nodes, spring, x, y, z, scale)
    return steep_count


@njit(**INNER)
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


@njit(**INLINED)
def _sum_groups_of_tets(lanes, position, total, pairs, lengths, tets, stiffness, rest_length, stiffens):
    """`sum_tet_groups` for an organ alone; returns the first remaining tet."""
    if len(lanes) == 0:
        return sum_tet_groups(position, total, pairs, lengths, tets, stiffness, rest_length, stiffens)
    return 0


@njit(**INNER)
def sum_at_nodes(lanes, position, total, pairs, lengths, tets, stiffness, rest_length, stiffens):
    """Sums of six times the volume of each tet at its corners, and of twice its spring's energy if springs stiffen.

    In:  position [m] (n_node, 4), tets (n_tet, 4), stiffness [N/m], rest_length [m] (n_spring,), stiffens
    Out: total: volumes [m^3], added to (n_node,); if springs stiffen instead pairs: volumes [m^3] and energies [J],
         added to (n_node, 2), and lengths as in `add_energies`
    """
    for tet in range(
        _sum_groups_of_tets(lanes, position, total, pairs, lengths, tets, stiffness, rest_length, stiffens),
        tets.shape[0],
    ):
        b, c, d = three_edges(lanes, position, tets, tet)
        _, six = tet_shape(b, c, d)
        if stiffens:
            twice = _measure(lanes, position, lengths, tet, stiffness, rest_length, b)
            add_volume_and_energy(lanes, pairs, tets, tet, six, twice)
        else:
            add_to_corners(lanes, total, tets, tet, six)


@njit(**KERNEL)
def set_node_tension(lanes, tension, node_inverse_volume, node_bulk):
    """Tension of the averaged volumes, from the sums of six times the volumes around nodes.

    In:  node_inverse_volume [1/m^3], node_bulk [Pa] (n_node,)
    Out: tension: the sums before [m^3], [Pa] after (n_node,)
    """
    for node in range(tension.shape[0]):
        inverse = load_shared(lanes, tension, node_inverse_volume, node)
        bulk = load_item(lanes, node_bulk, node)
        store_item(lanes, tension, node, node_tension(load_item(lanes, tension, node), inverse, bulk))


@njit(**INNER)
def add_volume_rates(lanes, position, velocity, total, pairs, tets, beta, stiffens):
    """Beta's share of the averaged volume term: beta times the rates of volumes, added to the sums of `sum_at_nodes`.

    In:  position [m], velocity [m/s] (n_node, 4), tets (n_tet, 4), beta [s], stiffens
    Out: total or the first numbers of pairs [m^3], as in `sum_at_nodes`
    """
    for tet in range(tets.shape[0]):
        b, c, d = three_edges(lanes, position, tets, tet)
        six = beta * six_rates(b, c, d, *three_edges(lanes, velocity, tets, tet))
        if stiffens:
            for corner in range(4):
                add_half(lanes, pairs, tets[tet, corner], 0, six)
        else:
            add_to_corners(lanes, total, tets, tet, six)


@njit(**INLINED)
def _push_corners(lanes, force, tets, tet, scale, b, c, d, at_b):
    """Add the forces of a tet on its corners: `scale` times `corner_gradient`, at b `at_b`.

    Corner by corner: all gradients at once do not fit into 16 registers.
    """
    x, y, z = at_b
    add_to_node(lanes, force, tets[tet, 1], x, y, z)
    g = corner_gradient(d, b)
    gx, gy, gz = scale * g[0], scale * g[1], scale * g[2]
    add_to_node(lanes, force, tets[tet, 2], gx, gy, gz)
    x, y, z = x + gx, y + gy, z + gz
    g = corner_gradient(b, c)
    gx, gy, gz = scale * g[0], scale * g[1], scale * g[2]
    add_to_node(lanes, force, tets[tet, 3], gx, gy, gz)
    take_from_node(lanes, force, tets[tet, 0], x + gx, y + gy, z + gz)


@njit(**INLINED)
def _add_groups_of_tets(
    lanes, position, force, tension, tets, inverse_volume, bulk, averaged_bulk, stiffness, rest_length, low, squeezed,
    law, steep_count,
):  # fmt: skip
    """`add_tet_groups` for an organ alone; returns the first remaining tet, the entries of `squeezed` and `steep`."""
    if len(lanes) == 0:
        return add_tet_groups(
            position, force, tension, tets, inverse_volume, bulk, averaged_bulk, stiffness, rest_length, low, squeezed,
            law, steep_count,
        )  # fmt: skip
    return 0, 0, steep_count


@njit(**INNER)
def add_tet_forces(
    lanes, position, force, tension, tets, inverse_volume, bulk, averaged_bulk, stiffness, rest_length, low, moving,
    squeezed, law, steep_count,
):  # fmt: skip
    """Volume terms: the tension of a tet pulls its corners along dV/dx; with tet t comes spring t, its first edge.

    K (J - 1) per tet adds K to Lame's lambda and nothing to mu (after the volume-only energy of Golec et al. 2020); the
    mean tension of the volumes averaged at its corners is added.

    In:  position [m] (n_node, 4), tension [Pa] (n_node,), tets (n_tet, 4), inverse_volume [1/m^3], bulk, averaged_bulk
         [Pa] (n_tet,), stiffness [N/m], rest_length [m] (n_spring,), moving: 1 for a moving organ (1,), law:
         `SpringLaw`, steep_count: entries of `law.steep` so far
    Out: force, added to [N] (n_node, 4), low: smallest V / V0, the previous one included (1,), squeezed: first of each
         `group_width` tets with a tet below SQUEEZED_RATIO (n_tet,), law: as in `add_spring_forces`
    Returns the number of entries in `squeezed` and `law.steep`.
    """
    measured, lengths, pairs = law.measured, law.lengths, law.pairs
    stiffens, steepens, steep, steep_sum = law.stiffens, law.steepens, law.steep, law.steep_sum
    relaxes, gain, relief, fades, fade = law.relaxes, law.gain, law.relief, law.fades, law.fade
    arm_modulus, arm_tension = law.arm_modulus, law.arm_tension
    first, count, steep_count = _add_groups_of_tets(
        lanes, position, force, tension, tets, inverse_volume, bulk, averaged_bulk, stiffness, rest_length, low,
        squeezed, law, steep_count,
    )  # fmt: skip
    width = group_width(lanes)
    lowest = load_item(lanes, low, 0)
    for tet in range(first, tets.shape[0]):
        b, c, d = three_edges(lanes, position, tets, tet)
        gradient, six = tet_shape(b, c, d)
        ratio = volume_ratio(six, load_shared(lanes, position, inverse_volume, tet))
        lowest = keep_lower(ratio, lowest, ratio, lowest)
        if any_below(ratio, SQUEEZED_RATIO):
            entry = tet // width * width
            if count == 0 or squeezed[count - 1] != entry:
                squeezed[count] = entry
                count += 1
        if measured:
            averaged = corner_mean_of_pairs(lanes, pairs, tets, tet)
            length = _kept_length(lanes, lengths, tet, b[0], b[1], b[2])
        else:
            averaged, length = corner_mean(lanes, tension, tets, tet), spring_length(b[0], b[1], b[2])
        scale = tet_scale(ratio, load_item(lanes, bulk, tet), load_item(lanes, averaged_bulk, tet), averaged)
        share = load_shared(lanes, position, rest_length, tet) / length
        rigidity = load_item(lanes, stiffness, tet)
        pull = spring_scale(share, rigidity)
        if stiffens:
            factor = _end_sum(lanes, pairs, tets, tet)
            pull = pull * factor
            if steepens and any_below(factor * -1.0, -steep_sum):
                entry = tet // width * width
                if steep_count == 0 or steep[steep_count - 1] != entry:
                    steep[steep_count] = entry
                    steep_count += 1
        if relaxes:
            if fades:
                fade_arms(lanes, arm_modulus, arm_tension, relief, stiffness.shape[0], tet, pull / share, fade, moving)
            pull = pull * load_shared(lanes, position, gain, tet) - load_item(lanes, relief, tet) * share
        at_b = (
            scale * gradient[0] - pull * b[0], scale * gradient[1] - pull * b[1], scale * gradient[2] - pull * b[2]
        )  # fmt: skip
        _push_corners(lanes, force, tets, tet, scale, b, c, d, at_b)
    store_item(lanes, low, 0, where_moving(lanes, moving, lowest, load_item(lanes, low, 0)))
    return count, steep_count


@njit(**INNER)
def add_volume_damping(lanes, position, velocity, force, tets, inverse_volume, bulk, beta):
    """Beta's share of each tet's own volume term: tension K beta dJ/dt.

    In:  position [m], velocity [m/s] (n_node, 4), tets (n_tet, 4), inverse_volume [1/m^3], bulk [Pa] (n_tet,), beta [s]
    Out: force, added to [N] (n_node, 4)
    """
    for tet in range(tets.shape[0]):
        b, c, d = three_edges(lanes, position, tets, tet)
        six_rate = six_rates(b, c, d, *three_edges(lanes, velocity, tets, tet))
        rate = beta * volume_ratio(six_rate, load_shared(lanes, position, inverse_volume, tet))
        scale = load_item(lanes, bulk, tet) * rate * (-1.0 / 6.0)
        g = corner_gradient(c, d)
        _push_corners(lanes, force, tets, tet, scale, b, c, d, (scale * g[0], scale * g[1], scale * g[2]))
