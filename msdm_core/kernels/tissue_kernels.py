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
    averaged_change,
    node_law,
    six_rates,
    spring_drag,
    spring_energy,
    spring_length,
    spring_scale,
    strain_square,
    tet_scale,
    tet_shape,
    volume_energy,
    volume_ratio,
)
from msdm_core.kernels.group_kernels import (
    add_energy_groups,
    add_spring_groups,
    add_tet_groups,
    set_node_law_groups,
    sum_tet_groups,
)
from msdm_core.kernels.lane_view_kernels import nodes_of
from msdm_core.kernels.layout_kernels import (
    add_half,
    add_to_corners,
    add_to_node,
    add_volume_and_energies,
    corner_mean,
    corner_sum_of_pairs,
    difference,
    group_width,
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
from msdm_core.kernels.option_kernels import INLINED, INNER
from msdm_core.kernels.space_kernels import minus, plus, times, vector_product
from msdm_core.kernels.vector_kernels import any_below, keep_lower


@njit(**INNER)
def set_gravity(lanes, model, state):
    """F = m g into the forces."""
    _, _, force = nodes_of(lanes, state)
    mass, gravity = model.node_mass, model.gravity
    for node in range(force.shape[0]):
        if len(lanes) == 0:
            for axis in range(3):
                force[node, axis] = mass[node] * gravity[axis]
            force[node, 3] = 0.0
        else:
            for axis in range(3):
                store_item(lanes, force, 3 * node + axis, load_item(lanes, mass, node) * gravity[axis])


@njit(**INNER)
def integrate(lanes, model, state, dt, decay):
    """Symplectic Euler step of the moving organs: v = decay v + dt f / m, x = x + dt v, decay = e^(-alpha dt)."""
    position, velocity, force = nodes_of(lanes, state)
    inverse_mass, moving = model.node_inverse_mass, state.moving
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
    store_sum(lanes, state.finite_sum, check)


@njit(**INNER)
def put_back(lanes, state):
    """Restore the kept forces of stopped organs."""
    values, kept, moving = state.node_force, state.kept_force, state.moving
    for part in range(3 * values.shape[0]):
        value = where_moving(lanes, moving, load_part(lanes, values, part), load_part(lanes, kept, part))
        store_part(lanes, values, part, value)


@njit(**INLINED)
def _pull_ends(lanes, force, nodes, spring, pull):
    """Pull the ends of a spring together."""
    add_to_node(lanes, force, nodes[spring, 0], pull)
    take_from_node(lanes, force, nodes[spring, 1], pull)


@njit(**INLINED)
def _end_sum(lanes, pairs, items, item):
    """Sum of the second numbers of the pairs of a spring's two ends."""
    return load_half(lanes, pairs, items[item, 0], 1) + load_half(lanes, pairs, items[item, 1], 1)


@njit(**INLINED)
def _keep_length(lanes, lengths, spring, length):
    """Keep the length of a spring of an organ alone.

    Organs side by side compute it again: memory limits them, and loads of all lengths take longer than the roots.
    """
    if len(lanes) == 0:
        lengths[spring] = length


@njit(**INLINED)
def _kept_length(lanes, lengths, spring, along):
    """Length of a spring, kept or computed again."""
    if len(lanes) == 0:
        return lengths[spring]
    return spring_length(along)


@njit(**INLINED)
def _measure(lanes, position, lengths, item, stiffness, rest_length, edge):
    """Keep the length of a spring along an edge; returns its `spring_energy`."""
    length = spring_length(edge)
    _keep_length(lanes, lengths, item, length)
    return spring_energy(length, load_shared(lanes, position, rest_length, item), load_item(lanes, stiffness, item))


@njit(**INNER)
def add_energies(lanes, model, state):
    """Twice the energy of linear springs without a tet, k (l - l0)^2, added to the second number of both ends' pairs.

    Notes the lengths of an organ alone.
    """
    position, _, _ = nodes_of(lanes, state)
    pairs, lengths, nodes = state.node_pairs, state.spring_lengths, model.spring_nodes
    stiffness, rest_length = model.spring_stiffness, model.spring_rest_length
    first = model.tet_nodes.shape[0]
    if len(lanes) == 0:
        first = add_energy_groups(model, state)
    for spring in range(first, nodes.shape[0]):
        edge = difference(lanes, position, nodes, spring, 1)
        twice = _measure(lanes, position, lengths, spring, stiffness, rest_length, edge)
        add_half(lanes, pairs, nodes[spring, 0], 1, twice)
        add_half(lanes, pairs, nodes[spring, 1], 1, twice)


@njit(**INNER)
def set_node_laws(lanes, model, state, law):
    """Tension of the averaged volumes and `node_law`, from the sums of volumes and energies around nodes.

    Pairs hold the sums of six times the volumes [m^3] and of four times the node's shares of the energies of linear
    springs and tets [J] before, tension [Pa] and half the factor on linear tensions after. One loop for both, as the
    root and the quotient of the law take longer than all else of a node.

    Returns True if any factor differs from 1, and True if any steepness is above STEEP_EXCESS.
    """
    pairs, steepness, inverse_volume, volume, bulk = (
        state.node_pairs, state.node_steepness, model.node_inverse_volume, model.node_rest_volume, model.node_bulk
    )  # fmt: skip
    elements = model.spring_nodes.shape[0] + model.tet_nodes.shape[0]
    softness, onset, growth, excess = model.node_softness, model.node_onset, model.node_growth, model.node_excess
    first, stiffens, steepens = 0, False, False
    if len(lanes) == 0:
        first, stiffens, steepens = set_node_law_groups(model, state, law)
    for node in range(first, steepness.shape[0]):
        six, energy = load_half(lanes, pairs, node, 0), load_half(lanes, pairs, node, 1)
        change = averaged_change(six, load_shared(lanes, pairs, inverse_volume, node))
        rigidity = load_item(lanes, bulk, node)
        energy = energy + 2.0 * volume_energy(change, rigidity, load_shared(lanes, pairs, volume, node))
        tension, square = rigidity * change, strain_square(energy, load_item(lanes, softness, node))
        begin = load_shared(lanes, pairs, onset, node)
        steeper = square * 0.0
        half = steeper + 0.5
        if any_below(begin * begin - square, 0.0):
            half, steeper = node_law(
                square, begin, load_shared(lanes, pairs, growth, node), load_shared(lanes, pairs, excess, node)
            )
            stiffens = True
            tension = tension * (half + half)
            if any_below(STEEP_EXCESS - steeper, 0.0):
                steepens = True
        if model.relaxes:
            tension = relaxed(lanes, model, state, law, elements + node, tension, 1.0)
        store_half(lanes, pairs, node, 0, tension)
        store_half(lanes, pairs, node, 1, half)
        store_item(lanes, steepness, node, steeper)
    return stiffens, steepens


@njit(**INLINED)
def _give_way(lanes, arm_tension, arm, elastic, fade, moving):
    """Relax one arm towards the elastic tension of its element; returns its relief."""
    before = load_item(lanes, arm_tension, arm)
    after = before + (elastic - before) * fade
    store_item(lanes, arm_tension, arm, where_moving(lanes, moving, after, before))
    return after


@njit(**INLINED)
def fade_arms(lanes, model, state, element, elastic, fade):
    """Relax the Maxwell arms of an element towards its elastic tension: z_i <- z_i + fade_i (T_e - z_i).

    The arm's own tension is g_i (T_e - z_i). At a constant strain z_i approaches T_e as 1 - exp(-t / tau_i), and the
    energy stored in an arm never rises by its relaxation.

    In:  elastic T_e: of a spring over l0 [N/m], of a volume [Pa], fade: share for each arm
    Out: element_arm_tension z_i, element_relief
    """
    arm_modulus, arm_tension, relief = model.element_arm_modulus, state.element_arm_tension, state.element_relief
    moving, count = state.moving, model.element_gain.shape[0]
    second, third = count + element, 2 * count + element
    total = load_shared(lanes, arm_tension, arm_modulus, element) * _give_way(
        lanes, arm_tension, element, elastic, fade[0], moving
    )
    total = total + load_shared(lanes, arm_tension, arm_modulus, second) * _give_way(
        lanes, arm_tension, second, elastic, fade[1], moving
    )
    total = total + load_shared(lanes, arm_tension, arm_modulus, third) * _give_way(
        lanes, arm_tension, third, elastic, fade[2], moving
    )
    store_item(lanes, relief, element, where_moving(lanes, moving, total, load_item(lanes, relief, element)))


@njit(**INLINED)
def relaxed(lanes, model, state, law, element, tension, share):
    """Tension of an element with its Maxwell arms, which relax if `law.fades`: (1 + sum g_i) T_e - sum_i g_i z_i.

    Elements are the springs, then the tets, then the averaged volumes.

    In: tension T_e: of a spring over its length [N/m], of a volume [Pa], share: l0 / l of a spring, 1 of a volume
    """
    if law.fades:
        fade_arms(lanes, model, state, element, tension / share, law.fade)
    gain = load_shared(lanes, state.element_relief, model.element_gain, element)
    return tension * gain - load_item(lanes, state.element_relief, element) * share


@njit(**INNER)
def add_spring_forces(lanes, model, state, law):
    """Springs without a tet: f = k (l - l0) along the spring (Sala 2011, eq. 1), and their `TissueLaw`.

    The arms relax, and `steep_springs` gets the first of each `group_width` springs with a steep spring. Returns the
    number of its entries.
    """
    position, _, force = nodes_of(lanes, state)
    nodes, stiffness, rest_length = model.spring_nodes, model.spring_stiffness, model.spring_rest_length
    begin = model.tet_nodes.shape[0]
    pairs, lengths = state.node_pairs, state.spring_lengths
    steep, steep_sum = state.steep_springs, 1.0 + model.steep_rise
    first, steep_count = begin, 0
    if len(lanes) == 0:
        first, steep_count = add_spring_groups(model, state, law)
    width = group_width(lanes)
    for spring in range(first, nodes.shape[0]):
        along = difference(lanes, position, nodes, spring, 1)
        if model.stiffens:
            length = _kept_length(lanes, lengths, spring, along)
        else:
            length = spring_length(along)
        share = load_shared(lanes, position, rest_length, spring) / length
        rigidity = load_item(lanes, stiffness, spring)
        scale = spring_scale(share, rigidity)
        if law.stiffens:
            factor = _end_sum(lanes, pairs, nodes, spring)
            scale = scale * factor
            if law.steepens and any_below(factor * -1.0, -steep_sum):
                entry = begin + (spring - begin) // width * width
                if steep_count == 0 or steep[steep_count - 1] != entry:
                    steep[steep_count] = entry
                    steep_count += 1
        if model.relaxes:
            scale = relaxed(lanes, model, state, law, spring, scale, share)
        _pull_ends(lanes, force, nodes, spring, times(scale, along))
    return steep_count


@njit(**INNER)
def add_spring_damping(lanes, model, state):
    """Rayleigh's beta along all springs: f = k beta dl/dt."""
    position, velocity, force = nodes_of(lanes, state)
    nodes, stiffness, beta = model.spring_nodes, model.spring_stiffness, model.beta
    for spring in range(nodes.shape[0]):
        along, rate = difference(lanes, position, nodes, spring, 1), difference(lanes, velocity, nodes, spring, 1)
        scale = spring_drag(along, rate, load_item(lanes, stiffness, spring), beta)
        _pull_ends(lanes, force, nodes, spring, times(scale, along))


@njit(**INNER)
def sum_at_nodes(lanes, model, state):
    """Sums of six times the volume of each tet [m^3] at its corners, in node_tension.

    Where springs stiffen, in node_pairs with four times the shares of the tet's own energy and its spring's [J].
    """
    position, _, _ = nodes_of(lanes, state)
    total, pairs, lengths, tets = state.node_tension, state.node_pairs, state.spring_lengths, model.tet_nodes
    stiffness, rest_length, stiffens = model.spring_stiffness, model.spring_rest_length, model.stiffens
    bulk, volume, inverse_volume = model.tet_bulk, model.tet_rest_volume, model.tet_inverse_volume
    first = 0
    if len(lanes) == 0:
        first = sum_tet_groups(model, state)
    for tet in range(first, tets.shape[0]):
        b, c, d = three_edges(lanes, position, tets, tet)
        _, six = tet_shape(b, c, d)
        if stiffens:
            twice = _measure(lanes, position, lengths, tet, stiffness, rest_length, b)
            change = volume_ratio(six, load_shared(lanes, position, inverse_volume, tet)) - 1.0
            all_four = 0.5 * volume_energy(
                change, load_item(lanes, bulk, tet), load_shared(lanes, position, volume, tet)
            )
            add_volume_and_energies(lanes, pairs, tets, tet, six, twice + all_four, all_four)
        else:
            add_to_corners(lanes, total, tets, tet, six)


@njit(**INNER)
def set_node_tension(lanes, model, state, law):
    """Tension of the averaged volumes, from the sums of six times the volumes around nodes, in node_tension."""
    total, elements = state.node_tension, model.spring_nodes.shape[0] + model.tet_nodes.shape[0]
    for node in range(total.shape[0]):
        inverse = load_shared(lanes, total, model.node_inverse_volume, node)
        tension = load_item(lanes, model.node_bulk, node) * averaged_change(load_item(lanes, total, node), inverse)
        if model.relaxes:
            tension = relaxed(lanes, model, state, law, elements + node, tension, 1.0)
        store_item(lanes, total, node, tension)


@njit(**INNER)
def add_volume_rates(lanes, model, state):
    """Beta's share of the averaged volume term, added to the tensions: K_a beta dJ_a/dt."""
    position, velocity, _ = nodes_of(lanes, state)
    total, pairs, tets, beta, stiffens = (
        state.node_tension, state.node_pairs, model.tet_nodes, model.beta, model.stiffens
    )  # fmt: skip
    for tet in range(tets.shape[0]):
        b, c, d = three_edges(lanes, position, tets, tet)
        six = beta * six_rates(b, c, d, *three_edges(lanes, velocity, tets, tet))
        for corner in range(4):
            node = tets[tet, corner]
            inverse = load_shared(lanes, position, model.node_inverse_volume, node)
            tension = load_item(lanes, model.node_bulk, node) * (six * (inverse * (1.0 / 24.0)))
            if stiffens:
                add_half(lanes, pairs, node, 0, tension)
            else:
                store_item(lanes, total, node, load_item(lanes, total, node) + tension)


@njit(**INLINED)
def _push_corners(lanes, force, tets, tet, scale, b, c, d, at_b):
    """Add the forces of a tet on its corners: `scale` times six times the gradient of its volume, at b `at_b`.

    Corner by corner: all gradients at once do not fit into 16 registers.
    """
    add_to_node(lanes, force, tets[tet, 1], at_b)
    at_c = times(scale, vector_product(d, b))
    add_to_node(lanes, force, tets[tet, 2], at_c)
    at_d = times(scale, vector_product(b, c))
    add_to_node(lanes, force, tets[tet, 3], at_d)
    take_from_node(lanes, force, tets[tet, 0], plus(plus(at_b, at_c), at_d))


@njit(**INNER)
def add_tet_forces(lanes, model, state, law, steep_count):
    """Volume terms: the tension of a tet pulls its corners along dV/dx; with tet t comes spring t, its first edge.

    K (J - 1) per tet adds K to Lame's lambda and nothing to mu (after the volume-only energy of Golec et al. 2020); the
    mean tension of the volumes averaged at its corners is added.

    Keeps the smallest V / V0, and in `squeezed_tets` the first of each `group_width` tets with a tet below
    SQUEEZED_RATIO; arms and `steep_springs` as in `add_spring_forces`, of which steep_count entries are there so far.
    Returns the numbers of entries in `squeezed_tets` and `steep_springs`.
    """
    position, _, force = nodes_of(lanes, state)
    tension, tets = state.node_tension, model.tet_nodes
    stiffness, rest_length = model.spring_stiffness, model.spring_rest_length
    low, squeezed = state.volume_ratio_smallest, state.squeezed_tets
    pairs, lengths = state.node_pairs, state.spring_lengths
    steep, steep_sum, springs = state.steep_springs, 1.0 + model.steep_rise, model.spring_nodes.shape[0]
    first, count = 0, 0
    if len(lanes) == 0:
        first, count, steep_count = add_tet_groups(model, state, law, steep_count)
    width = group_width(lanes)
    lowest = load_item(lanes, low, 0)
    for tet in range(first, tets.shape[0]):
        b, c, d = three_edges(lanes, position, tets, tet)
        gradient, six = tet_shape(b, c, d)
        ratio = volume_ratio(six, load_shared(lanes, position, model.tet_inverse_volume, tet))
        lowest = keep_lower(ratio, lowest, ratio, lowest)
        if any_below(ratio, SQUEEZED_RATIO):
            entry = tet // width * width
            if count == 0 or squeezed[count - 1] != entry:
                squeezed[count] = entry
                count += 1
        if model.stiffens:
            averaged = 0.25 * corner_sum_of_pairs(lanes, pairs, tets, tet, 0)
            length = _kept_length(lanes, lengths, tet, b)
        else:
            averaged, length = corner_mean(lanes, tension, tets, tet), spring_length(b)
        own = load_item(lanes, model.tet_bulk, tet) * (ratio - 1.0)
        share = load_shared(lanes, position, rest_length, tet) / length
        rigidity = load_item(lanes, stiffness, tet)
        pull = spring_scale(share, rigidity)
        if law.stiffens:
            factor = _end_sum(lanes, pairs, tets, tet)
            pull, own = pull * factor, own * (0.5 * corner_sum_of_pairs(lanes, pairs, tets, tet, 1))
            if law.steepens and any_below(factor * -1.0, -steep_sum):
                entry = tet // width * width
                if steep_count == 0 or steep[steep_count - 1] != entry:
                    steep[steep_count] = entry
                    steep_count += 1
        if model.relaxes:
            pull = relaxed(lanes, model, state, law, tet, pull, share)
            own = relaxed(lanes, model, state, law, springs + tet, own, 1.0)
        scale = tet_scale(ratio, own, load_item(lanes, model.tet_barrier_bulk, tet), averaged)
        at_b = minus(times(scale, gradient), times(pull, b))
        _push_corners(lanes, force, tets, tet, scale, b, c, d, at_b)
    store_item(lanes, low, 0, where_moving(lanes, state.moving, lowest, load_item(lanes, low, 0)))
    return count, steep_count


@njit(**INNER)
def add_volume_damping(lanes, model, state):
    """Beta's share of each tet's own volume term: tension K beta dJ/dt."""
    position, velocity, force = nodes_of(lanes, state)
    tets, inverse_volume, bulk, beta = model.tet_nodes, model.tet_inverse_volume, model.tet_bulk, model.beta
    for tet in range(tets.shape[0]):
        b, c, d = three_edges(lanes, position, tets, tet)
        six_rate = six_rates(b, c, d, *three_edges(lanes, velocity, tets, tet))
        rate = beta * volume_ratio(six_rate, load_shared(lanes, position, inverse_volume, tet))
        scale = load_item(lanes, bulk, tet) * rate * (-1.0 / 6.0)
        _push_corners(lanes, force, tets, tet, scale, b, c, d, times(scale, vector_product(c, d)))
