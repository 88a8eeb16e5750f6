"""Springs and tets of one organ, GROUP at a time; node arrays are rows of four (x, y, z and padding).

The rows of a group are gathered into vectors of x, y and z (`gather_kernels`), enter the equations of
`element_kernels`, and are added up item by item: the same sums in the same order as the plain loops of
`tissue_kernels`, which call these functions for an organ alone and do the remaining items.
"""

from numba import njit

from msdm_core.kernels.element_kernels import (
    SQUEEZED_RATIO,
    STEEP_EXCESS,
    node_law,
    node_tension,
    spring_energy,
    spring_length,
    spring_scale,
    strain_square,
    tet_scale,
    tet_shape,
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
    """Relax one arm of a group of springs towards their elastic tension over l0 [N/m]; returns its relief."""
    before = load_group(arm_tension, arm)
    after = before + (elastic - before) * fade
    store_group(arm_tension, arm, after)
    return after


@njit(**INLINED)
def _fade_arms(model, state, first, elastic, fade):
    """`tissue_kernels.fade_arms` of a group of springs."""
    arm_modulus, arm_tension, springs = model.spring_arm_modulus, state.spring_arm_tension, model.spring_nodes.shape[0]
    second, third = springs + first, 2 * springs + first
    total = load_group(arm_modulus, first) * _give_way(arm_tension, first, elastic, fade[0])
    total = total + load_group(arm_modulus, second) * _give_way(arm_tension, second, elastic, fade[1])
    total = total + load_group(arm_modulus, third) * _give_way(arm_tension, third, elastic, fade[2])
    store_group(state.spring_relief, first, total)


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
def set_node_law_groups(model, state):
    """`tissue_kernels.set_node_laws` of whole groups of nodes.

    Returns the first remaining node, True if any stiffens, True if any is steep.
    """
    pairs, steepness, inverse_volume, bulk = (
        state.node_pairs, state.node_steepness, model.node_inverse_volume, model.node_bulk
    )  # fmt: skip
    softness, onset, growth, excess = model.node_softness, model.node_onset, model.node_growth, model.node_excess
    whole = pairs.shape[0] // GROUP * GROUP
    stiffens = steepens = False
    for first in range(0, whole, GROUP):
        low, high = load_group(pairs, 2 * first), load_group(pairs, 2 * first + GROUP)
        tension = node_tension(_firsts(low, high), load_group(inverse_volume, first), load_group(bulk, first))
        square = strain_square(_seconds(low, high), load_group(softness, first))
        begin = load_group(onset, first)
        steeper = square * 0.0
        half = steeper + 0.5
        if any_below(begin * begin - square, 0.0):
            half, steeper = node_law(square, begin, load_group(growth, first), load_group(excess, first))
            stiffens = True
            if any_below(STEEP_EXCESS - steeper, 0.0):
                steepens = True
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
            if law.fades:
                _fade_arms(model, state, first, scale / share, law.fade)
            scale = scale * load_group(model.spring_gain, first) - load_group(state.spring_relief, first) * share
        pull_ends(force, nodes, first, (rows, scale))
    return whole, steep_count


@njit(**INNER)
def sum_tet_groups(model, state):
    """`tissue_kernels.sum_at_nodes` of whole groups of tets; returns the first remaining tet."""
    position, total, pairs, lengths = state.row_position, state.node_tension, state.node_pairs, state.spring_lengths
    tets, stiffens = model.tet_nodes, model.stiffens
    stiffness, rest_length = model.spring_stiffness, model.spring_rest_length
    whole = tets.shape[0] // GROUP * GROUP
    for first in range(0, whole, GROUP):
        b, c, d = tet_edges(position, tets, first)
        _, six = tet_shape(b, c, d)
        if stiffens:
            length = spring_length(b)
            store_group(lengths, first, length)
            energy = spring_energy(length, load_group(rest_length, first), load_group(stiffness, first))
            add_pairs(pairs, tets, first, (six, energy))
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
    steep, steep_sum = state.steep_springs, 1.0 + model.steep_rise
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
            averaged, factor = pair_sums(pairs, tets, first)
            length = load_group(lengths, first)
        else:
            averaged, length = corner_sums(tension, tets, first), spring_length(b)
            factor = length
        bulk, averaged_bulk = load_group(model.tet_bulk, first), load_group(model.tet_averaged_bulk, first)
        scale = tet_scale(ratio, bulk, averaged_bulk, 0.25 * averaged)
        share = load_group(rest_length, first) / length
        rigidity = load_group(stiffness, first)
        pull = spring_scale(share, rigidity)
        if law.stiffens:
            pull = pull * factor
            if law.steepens and any_below(factor * -1.0, -steep_sum):
                steep[steep_count] = first
                steep_count += 1
        if model.relaxes:
            if law.fades:
                _fade_arms(model, state, first, pull / share, law.fade)
            pull = pull * load_group(model.spring_gain, first) - load_group(state.spring_relief, first) * share
        at_b = minus(times(scale, gradient), times(pull, b))
        at_c, at_d = times(scale, vector_product(d, b)), times(scale, vector_product(b, c))
        push_corners(force, tets, first, (at_b, at_c, at_d))
    low[0] = fold_lower(lowest, low[0])
    return whole, count, steep_count
