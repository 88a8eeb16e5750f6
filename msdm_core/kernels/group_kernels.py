"""Springs and tets of one organ, GROUP at a time; node arrays are rows of four (x, y, z and padding).

The rows of a group are gathered into vectors of x, y and z (`gather_kernels`), enter the equations of
`element_kernels`, and are added up item by item: the same sums in the same order as the plain loops of
`tissue_kernels`, which call these functions for an organ alone and do the remaining items.
"""

from numba import njit

from msdm_core.kernels.element_kernels import (
    SQUEEZED_RATIO,
    STEEP_EXCESS,
    averaged_change,
    node_law,
    spring_energy,
    spring_length,
    spring_scale,
    strain_square,
    tet_scale,
    tet_shape,
    volume_energy,
    volume_ratio,
)
from msdm_core.kernels.gather_kernels import (
    add_at_corners,
    add_at_ends,
    add_pairs,
    columns,
    corner_sums,
    edge_rows,
    end_sums,
    pair_sums,
    pull_ends,
    push_corners,
    tet_edges,
)
from msdm_core.kernels.option_kernels import INLINED, INNER
from msdm_core.kernels.space_kernels import minus, times, vector_product
from msdm_core.kernels.vector_kernels import (
    GROUP,
    any_below,
    define_shuffle,
    fold_lower,
    keep_lower,
    load_group,
    spread_group,
    store_group,
)

# Pairs of numbers in two vectors as a vector of the first and a vector of the second numbers; and back.
_firsts = define_shuffle([2 * item for item in range(GROUP)])
_seconds = define_shuffle([2 * item + 1 for item in range(GROUP)])
_low_pairs = define_shuffle([item + half for item in range(GROUP // 2) for half in (0, GROUP)])
_high_pairs = define_shuffle([item + half for item in range(GROUP // 2, GROUP) for half in (0, GROUP)])


@njit(**INLINED)
def _give_way(arm_tension, arm, elastic, fade):
    """Relax one arm of a group of elements towards their elastic tension; returns its relief."""
    before = load_group(arm_tension, arm)
    after = before + (elastic - before) * fade
    store_group(arm_tension, arm, after)
    return after


@njit(**INLINED)
def _fade_arms(model, state, first, elastic, fade):
    """`tissue_kernels.fade_arms` of a group of elements."""
    arm_modulus, arm_tension, count = model.element_arm_modulus, state.element_arm_tension, model.element_gain.shape[0]
    second, third = count + first, 2 * count + first
    total = load_group(arm_modulus, first) * _give_way(arm_tension, first, elastic, fade[0])
    total = total + load_group(arm_modulus, second) * _give_way(arm_tension, second, elastic, fade[1])
    total = total + load_group(arm_modulus, third) * _give_way(arm_tension, third, elastic, fade[2])
    store_group(state.element_relief, first, total)


@njit(**INLINED)
def _relaxed(model, state, law, first, tension, share):
    """`tissue_kernels.relaxed` of a group of elements."""
    if law.fades:
        _fade_arms(model, state, first, tension / share, law.fade)
    return tension * load_group(model.element_gain, first) - load_group(state.element_relief, first) * share


@njit(**INNER)
def add_energy_groups(model, state):
    """`tissue_kernels.add_energies` of whole groups of springs; returns the first remaining spring."""
    position, pairs, lengths, nodes = state.row_position, state.node_pairs, state.spring_lengths, model.spring_nodes
    stiffness, rest_length, begin = model.spring_stiffness, model.spring_rest_length, model.tet_nodes.shape[0]
    whole = begin + (nodes.shape[0] - begin) // GROUP * GROUP
    for first in range(begin, whole, GROUP):
        length = spring_length(columns(edge_rows(position, nodes, first)))
        store_group(lengths, first, length)
        energy = spring_energy(length, load_group(rest_length, first), load_group(stiffness, first))
        add_at_ends(pairs, nodes, first, energy)
    return whole


@njit(**INNER)
def set_node_law_groups(model, state, law):
    """`tissue_kernels.set_node_laws` of whole groups of nodes.

    Returns the first remaining node, True if any stiffens, True if any is steep.
    """
    pairs, steepness, inverse_volume, volume, bulk = (
        state.node_pairs, state.node_steepness, model.node_inverse_volume, model.node_rest_volume, model.node_bulk
    )  # fmt: skip
    elements = model.spring_nodes.shape[0] + model.tet_nodes.shape[0]
    softness, onset, growth, excess = model.node_softness, model.node_onset, model.node_growth, model.node_excess
    whole = pairs.shape[0] // GROUP * GROUP
    stiffens = steepens = False
    for first in range(0, whole, GROUP):
        low, high = load_group(pairs, 2 * first), load_group(pairs, 2 * first + GROUP)
        change, rigidity = (
            averaged_change(_firsts(low, high), load_group(inverse_volume, first)),
            load_group(bulk, first),
        )
        energy = _seconds(low, high) + 2.0 * volume_energy(change, rigidity, load_group(volume, first))
        tension, square = rigidity * change, strain_square(energy, load_group(softness, first))
        begin = load_group(onset, first)
        steeper = square * 0.0
        half = steeper + 0.5
        if any_below(begin * begin - square, 0.0):
            half, steeper = node_law(square, begin, load_group(growth, first), load_group(excess, first))
            stiffens = True
            tension = tension * (half + half)
            if any_below(STEEP_EXCESS - steeper, 0.0):
                steepens = True
        if model.relaxes:
            tension = _relaxed(model, state, law, elements + first, tension, 1.0)
        store_group(pairs, 2 * first, _low_pairs(tension, half))
        store_group(pairs, 2 * first + GROUP, _high_pairs(tension, half))
        store_group(steepness, first, steeper)
    return whole, stiffens, steepens


@njit(**INNER)
def add_spring_groups(model, state, law):
    """`tissue_kernels.add_spring_forces` of whole groups of springs.

    Returns the first remaining spring and the number of entries in `steep_springs`.
    """
    position, force, nodes, begin = state.row_position, state.row_force, model.spring_nodes, model.tet_nodes.shape[0]
    stiffness, rest_length = model.spring_stiffness, model.spring_rest_length
    pairs, lengths = state.node_pairs, state.spring_lengths
    steep, steep_sum = state.steep_springs, 1.0 + model.steep_rise
    whole = begin + (nodes.shape[0] - begin) // GROUP * GROUP
    steep_count = 0
    for first in range(begin, whole, GROUP):
        rows = edge_rows(position, nodes, first)
        if model.stiffens:
            length = load_group(lengths, first)
        else:
            length = spring_length(columns(rows))
        share = load_group(rest_length, first) / length
        rigidity = load_group(stiffness, first)
        scale = spring_scale(share, rigidity)
        if law.stiffens:
            factor = end_sums(pairs, nodes, first)
            scale = scale * factor
            if law.steepens and any_below(factor * -1.0, -steep_sum):
                steep[steep_count] = first
                steep_count += 1
        if model.relaxes:
            scale = _relaxed(model, state, law, first, scale, share)
        pull_ends(force, nodes, first, (rows, scale))
    return whole, steep_count


@njit(**INNER)
def sum_tet_groups(model, state):
    """`tissue_kernels.sum_at_nodes` of whole groups of tets; returns the first remaining tet."""
    position, total, pairs, lengths = state.row_position, state.node_tension, state.node_pairs, state.spring_lengths
    tets, stiffens, bulk, volume = model.tet_nodes, model.stiffens, model.tet_bulk, model.tet_rest_volume
    stiffness, rest_length = model.spring_stiffness, model.spring_rest_length
    whole = tets.shape[0] // GROUP * GROUP
    for first in range(0, whole, GROUP):
        b, c, d = tet_edges(position, tets, first)
        _, six = tet_shape(b, c, d)
        if stiffens:
            length = spring_length(b)
            store_group(lengths, first, length)
            energy = spring_energy(length, load_group(rest_length, first), load_group(stiffness, first))
            change = volume_ratio(six, load_group(model.tet_inverse_volume, first)) - 1.0
            all_four = 0.5 * volume_energy(change, load_group(bulk, first), load_group(volume, first))
            add_pairs(pairs, tets, first, (six, energy + all_four, all_four))
        else:
            add_at_corners(total, tets, first, six)
    return whole


@njit(**INNER)
def add_tet_groups(model, state, law, steep_count):
    """`tissue_kernels.add_tet_forces` of whole groups of tets.

    Returns the first remaining tet, the number of groups with a squeezed tet and of entries in `steep_springs`.
    """
    position, force, tension, tets = state.row_position, state.row_force, state.node_tension, model.tet_nodes
    stiffness, rest_length = model.spring_stiffness, model.spring_rest_length
    low, squeezed = state.volume_ratio_smallest, state.squeezed_tets
    pairs, lengths = state.node_pairs, state.spring_lengths
    steep, steep_sum, springs = state.steep_springs, 1.0 + model.steep_rise, model.spring_nodes.shape[0]
    whole = tets.shape[0] // GROUP * GROUP
    count = 0
    lowest = spread_group(low[0])
    for first in range(0, whole, GROUP):
        b, c, d = tet_edges(position, tets, first)
        gradient, six = tet_shape(b, c, d)
        ratio = volume_ratio(six, load_group(model.tet_inverse_volume, first))
        lowest = keep_lower(ratio, lowest, ratio, lowest)
        if any_below(ratio, SQUEEZED_RATIO):
            squeezed[count] = first
            count += 1
        if model.stiffens:
            averaged, factor, all_halves = pair_sums(pairs, tets, first)
            length = load_group(lengths, first)
        else:
            averaged, length = corner_sums(tension, tets, first), spring_length(b)
            factor = all_halves = length
        own = load_group(model.tet_bulk, first) * (ratio - 1.0)
        share = load_group(rest_length, first) / length
        rigidity = load_group(stiffness, first)
        pull = spring_scale(share, rigidity)
        if law.stiffens:
            pull, own = pull * factor, own * (0.5 * all_halves)
            if law.steepens and any_below(factor * -1.0, -steep_sum):
                steep[steep_count] = first
                steep_count += 1
        if model.relaxes:
            pull = _relaxed(model, state, law, first, pull, share)
            own = _relaxed(model, state, law, springs + first, own, 1.0)
        scale = tet_scale(ratio, own, load_group(model.tet_barrier_bulk, first), 0.25 * averaged)
        at_b = minus(times(scale, gradient), times(pull, b))
        at_c, at_d = times(scale, vector_product(d, b)), times(scale, vector_product(b, c))
        push_corners(force, tets, first, (at_b, at_c, at_d))
    low[0] = fold_lower(lowest, low[0])
    return whole, count, steep_count
