"""Springs and tets of one organ, eight at a time; node arrays are rows of four (x, y, z and nothing).

The rows of eight items are loaded, turned into vectors of eight x, y and z, worked on by the equations of
`element_kernels`, turned back and added up item by item: the same sums in the same order as the plain loops of
`tissue_kernels`, which call these for an organ alone and do the items that are left over.
"""

from numba import njit

from msdm_core.kernels.element_kernels import (
    SQUEEZED_RATIO,
    STEEP_EXCESS,
    node_law,
    node_tension,
    six_volumes,
    spring_energy,
    spring_length,
    spring_scale,
    strain_square,
    tet_gradients,
    tet_scale,
    volume_ratio,
)
from msdm_core.kernels.layout_kernels import add_to_corners, corner_mean
from msdm_core.kernels.option_kernels import INLINED, KERNEL
from msdm_core.kernels.vector_kernels import (
    any_below,
    define_extract,
    define_shuffle,
    keep_lower,
    load_full,
    load_pair,
    load_row,
    pack,
    spread_like,
    store_full,
    store_pair,
    store_row,
)

GROUP = 8

_join = define_shuffle([0, 1, 2, 3, 4, 5, 6, 7])
_pick_xy = define_shuffle([0, 4, 8, 12, 1, 5, 9, 13])
_pick_z = define_shuffle([2, 6, 10, 14, 3, 7, 11, 15])
_low_halves = define_shuffle([0, 1, 2, 3, 8, 9, 10, 11])
_high_halves = define_shuffle([4, 5, 6, 7, 12, 13, 14, 15])
_mesh_low = define_shuffle([0, 8, 1, 9, 2, 10, 3, 11])
_mesh_high = define_shuffle([4, 12, 5, 13, 6, 14, 7, 15])
_pair_0, _pair_1, _pair_2, _pair_3 = (define_shuffle([2 * place, 2 * place + 1]) for place in range(4))
_firsts = define_shuffle([0, 2, 4, 6, 8, 10, 12, 14])
_seconds = define_shuffle([1, 3, 5, 7, 9, 11, 13, 15])
_row_0 = define_shuffle([0, 1, 8, 9])
_row_1 = define_shuffle([2, 3, 10, 11])
_row_2 = define_shuffle([4, 5, 12, 13])
_row_3 = define_shuffle([6, 7, 14, 15])
_at_0, _at_1, _at_2, _at_3, _at_4, _at_5, _at_6, _at_7 = (define_extract(place) for place in range(GROUP))


@njit(**INLINED)
def _columns(r0, r1, r2, r3, r4, r5, r6, r7):
    """Eight rows (x, y, z, -) as three vectors of eight."""
    r01, r23, r45, r67 = _join(r0, r1), _join(r2, r3), _join(r4, r5), _join(r6, r7)
    low, high = _pick_xy(r01, r23), _pick_xy(r45, r67)
    return _low_halves(low, high), _high_halves(low, high), _low_halves(_pick_z(r01, r23), _pick_z(r45, r67))


@njit(**INLINED)
def _rows(x, y, z):
    """Three vectors of eight as eight rows (x, y, z, 0)."""
    nothing = z * 0.0
    low, high, low_z, high_z = _mesh_low(x, y), _mesh_high(x, y), _mesh_low(z, nothing), _mesh_high(z, nothing)
    return (
        _row_0(low, low_z), _row_1(low, low_z), _row_2(low, low_z), _row_3(low, low_z),
        _row_0(high, high_z), _row_1(high, high_z), _row_2(high, high_z), _row_3(high, high_z),
    )  # fmt: skip


@njit(**INLINED)
def _edge(values, items, item, corner):
    """Row from corner 0 of an item to another of its corners."""
    return load_row(values, items[item, corner]) - load_row(values, items[item, 0])


@njit(**INLINED)
def _edges(values, items, first, corner):
    """The same of eight items, as three vectors."""
    return _columns(
        _edge(values, items, first, corner), _edge(values, items, first + 1, corner),
        _edge(values, items, first + 2, corner), _edge(values, items, first + 3, corner),
        _edge(values, items, first + 4, corner), _edge(values, items, first + 5, corner),
        _edge(values, items, first + 6, corner), _edge(values, items, first + 7, corner),
    )  # fmt: skip


@njit(**INLINED)
def _pull(force, items, item, pull):
    """Add a row to the first end of a spring and take it from the other."""
    i, j = items[item, 0], items[item, 1]
    store_row(force, i, load_row(force, i) + pull)
    store_row(force, j, load_row(force, j) - pull)


@njit(**INLINED)
def _push(force, items, item, a, b, c, d):
    """Take a row from corner a of a tet and add one to each of the others."""
    at_a, at_b, at_c, at_d = items[item, 0], items[item, 1], items[item, 2], items[item, 3]
    store_row(force, at_a, load_row(force, at_a) - a)
    store_row(force, at_b, load_row(force, at_b) + b)
    store_row(force, at_c, load_row(force, at_c) + c)
    store_row(force, at_d, load_row(force, at_d) + d)


@njit(**INLINED)
def _give_way(arm_tension, arm, elastic, fade):
    """Let one arm of eight springs give way to their elastic tension over l0 [N/m]; returns its tension lost."""
    before = load_full(arm_tension, arm)
    after = before + (elastic - before) * fade
    store_full(arm_tension, arm, after)
    return after


@njit(**INLINED)
def _fade_arms(arm_modulus, arm_tension, relief, springs, first, elastic, fade):
    """`tissue_kernels.fade_arms` of eight springs."""
    second, third = springs + first, 2 * springs + first
    total = load_full(arm_modulus, first) * _give_way(arm_tension, first, elastic, fade[0])
    total = total + load_full(arm_modulus, second) * _give_way(arm_tension, second, elastic, fade[1])
    total = total + load_full(arm_modulus, third) * _give_way(arm_tension, third, elastic, fade[2])
    store_full(relief, first, total)


@njit(**INLINED)
def _end_sum(pairs, items, item):
    """Sum of the second numbers of the pairs of a spring's two ends."""
    return pairs[items[item, 0], 1] + pairs[items[item, 1], 1]


@njit(**INLINED)
def _end_sums(pairs, items, first):
    """The same of eight springs."""
    return pack(
        _end_sum(pairs, items, first), _end_sum(pairs, items, first + 1),
        _end_sum(pairs, items, first + 2), _end_sum(pairs, items, first + 3),
        _end_sum(pairs, items, first + 4), _end_sum(pairs, items, first + 5),
        _end_sum(pairs, items, first + 6), _end_sum(pairs, items, first + 7),
    )  # fmt: skip


@njit(**INLINED)
def _corner_sums(pairs, tets, tet):
    """Sum of the pairs of a tet's first two corners, the ends of its spring, and of all four."""
    ends = load_pair(pairs, tets[tet, 0]) + load_pair(pairs, tets[tet, 1])
    return ends, ends + load_pair(pairs, tets[tet, 2]) + load_pair(pairs, tets[tet, 3])


@njit(**INLINED)
def _corner_means(tension, tets, first):
    """`corner_mean` of eight tets."""
    return pack(
        corner_mean((), tension, tets, first), corner_mean((), tension, tets, first + 1),
        corner_mean((), tension, tets, first + 2), corner_mean((), tension, tets, first + 3),
        corner_mean((), tension, tets, first + 4), corner_mean((), tension, tets, first + 5),
        corner_mean((), tension, tets, first + 6), corner_mean((), tension, tets, first + 7),
    )  # fmt: skip


@njit(**INLINED)
def _means_and_end_sums(pairs, tets, first):
    """Of eight tets the mean of the first numbers of the pairs at their corners, and `_end_sums` of their springs."""
    ends_0, all_0 = _corner_sums(pairs, tets, first)
    ends_1, all_1 = _corner_sums(pairs, tets, first + 1)
    ends_2, all_2 = _corner_sums(pairs, tets, first + 2)
    ends_3, all_3 = _corner_sums(pairs, tets, first + 3)
    ends_4, all_4 = _corner_sums(pairs, tets, first + 4)
    ends_5, all_5 = _corner_sums(pairs, tets, first + 5)
    ends_6, all_6 = _corner_sums(pairs, tets, first + 6)
    ends_7, all_7 = _corner_sums(pairs, tets, first + 7)
    totals = pack(
        _at_0(all_0), _at_0(all_1), _at_0(all_2), _at_0(all_3), _at_0(all_4), _at_0(all_5), _at_0(all_6), _at_0(all_7)
    )
    ends = pack(
        _at_1(ends_0), _at_1(ends_1), _at_1(ends_2), _at_1(ends_3),
        _at_1(ends_4), _at_1(ends_5), _at_1(ends_6), _at_1(ends_7),
    )  # fmt: skip
    return 0.25 * totals, ends


@njit(**INLINED)
def _add_to_ends(pairs, items, item, value):
    """Add to the second numbers of the pairs of a spring's ends."""
    pairs[items[item, 0], 1] += value
    pairs[items[item, 1], 1] += value


@njit(**INLINED)
def _add_energies(pairs, items, first, value):
    """Add the numbers of eight springs to their ends."""
    _add_to_ends(pairs, items, first, _at_0(value))
    _add_to_ends(pairs, items, first + 1, _at_1(value))
    _add_to_ends(pairs, items, first + 2, _at_2(value))
    _add_to_ends(pairs, items, first + 3, _at_3(value))
    _add_to_ends(pairs, items, first + 4, _at_4(value))
    _add_to_ends(pairs, items, first + 5, _at_5(value))
    _add_to_ends(pairs, items, first + 6, _at_6(value))
    _add_to_ends(pairs, items, first + 7, _at_7(value))


@njit(**INLINED)
def _add_pairs(pairs, tets, tet, at_ends, elsewhere):
    """Add one pair to the first two corners of a tet and another to the other two."""
    a, b, c, d = tets[tet, 0], tets[tet, 1], tets[tet, 2], tets[tet, 3]
    store_pair(pairs, a, load_pair(pairs, a) + at_ends)
    store_pair(pairs, b, load_pair(pairs, b) + at_ends)
    store_pair(pairs, c, load_pair(pairs, c) + elsewhere)
    store_pair(pairs, d, load_pair(pairs, d) + elsewhere)


@njit(**INLINED)
def _add_volumes_and_energies(pairs, tets, first, six, energy):
    """Add six times the volumes of eight tets at their corners, and twice the energies of their springs at the ends."""
    nothing = spread_like(pairs, 0.0)
    low, low_six = _mesh_low(six, energy), _mesh_low(six, nothing)
    high, high_six = _mesh_high(six, energy), _mesh_high(six, nothing)
    _add_pairs(pairs, tets, first, _pair_0(low, low), _pair_0(low_six, low_six))
    _add_pairs(pairs, tets, first + 1, _pair_1(low, low), _pair_1(low_six, low_six))
    _add_pairs(pairs, tets, first + 2, _pair_2(low, low), _pair_2(low_six, low_six))
    _add_pairs(pairs, tets, first + 3, _pair_3(low, low), _pair_3(low_six, low_six))
    _add_pairs(pairs, tets, first + 4, _pair_0(high, high), _pair_0(high_six, high_six))
    _add_pairs(pairs, tets, first + 5, _pair_1(high, high), _pair_1(high_six, high_six))
    _add_pairs(pairs, tets, first + 6, _pair_2(high, high), _pair_2(high_six, high_six))
    _add_pairs(pairs, tets, first + 7, _pair_3(high, high), _pair_3(high_six, high_six))


@njit(**KERNEL)
def add_energy_groups(position, pairs, lengths, nodes, stiffness, rest_length, begin):
    """Energies of whole groups of springs from spring `begin` on; arguments as in `tissue_kernels.add_energies`.

    Returns the first spring that is in no whole group.
    """
    whole = begin + (nodes.shape[0] - begin) // GROUP * GROUP
    for first in range(begin, whole, GROUP):
        x, y, z = _edges(position, nodes, first, 1)
        length = spring_length(x, y, z)
        store_full(lengths, first, length)
        _add_energies(
            pairs, nodes, first, spring_energy(length, load_full(rest_length, first), load_full(stiffness, first))
        )
    return whole


@njit(**KERNEL)
def set_node_law_groups(pairs, inverse_volume, bulk, softness, onset, growth, excess, steepness):
    """`tissue_kernels.set_node_laws` of whole groups of nodes.

    Returns the first node in none, whether one stiffens and whether one is steep.
    """
    whole = pairs.shape[0] // GROUP * GROUP
    stiffens = steepens = False
    for first in range(0, whole, GROUP):
        low, high = load_full(pairs, 2 * first), load_full(pairs, 2 * first + GROUP)
        tension = node_tension(_firsts(low, high), load_full(inverse_volume, first), load_full(bulk, first))
        square = strain_square(_seconds(low, high), load_full(softness, first))
        begin = load_full(onset, first)
        steeper = square * 0.0
        half = steeper + 0.5
        if any_below(begin * begin - square, 0.0):
            half, steeper = node_law(square, begin, load_full(growth, first), load_full(excess, first))
            stiffens = True
            if any_below(STEEP_EXCESS - steeper, 0.0):
                steepens = True
        store_full(pairs, 2 * first, _mesh_low(tension, half))
        store_full(pairs, 2 * first + GROUP, _mesh_high(tension, half))
        store_full(steepness, first, steeper)
    return whole, stiffens, steepens


@njit(**KERNEL)
def add_spring_groups(position, force, nodes, stiffness, rest_length, begin, law, steep_count):
    """Forces of whole groups of springs from spring `begin` on; arguments as in `tissue_kernels.add_spring_forces`.

    Returns the first spring that is in no whole group, and how many entries `law.steep` has.
    """
    measured, lengths, pairs = law.measured, law.lengths, law.pairs
    stiffens, steepens, steep, steep_sum = law.stiffens, law.steepens, law.steep, law.steep_sum
    relaxes, gain, relief, fades, fade = law.relaxes, law.gain, law.relief, law.fades, law.fade
    arm_modulus, arm_tension = law.arm_modulus, law.arm_tension
    springs = nodes.shape[0]
    whole = begin + (nodes.shape[0] - begin) // GROUP * GROUP
    for first in range(begin, whole, GROUP):
        r0, r1 = _edge(position, nodes, first, 1), _edge(position, nodes, first + 1, 1)
        r2, r3 = _edge(position, nodes, first + 2, 1), _edge(position, nodes, first + 3, 1)
        r4, r5 = _edge(position, nodes, first + 4, 1), _edge(position, nodes, first + 5, 1)
        r6, r7 = _edge(position, nodes, first + 6, 1), _edge(position, nodes, first + 7, 1)
        x, y, z = _columns(r0, r1, r2, r3, r4, r5, r6, r7)
        if measured:
            length = load_full(lengths, first)
        else:
            length = spring_length(x, y, z)
        share = load_full(rest_length, first) / length
        rigidity = load_full(stiffness, first)
        scale = spring_scale(share, rigidity)
        if stiffens:
            factor = _end_sums(pairs, nodes, first)
            scale = scale * factor
            if steepens and any_below(factor * -1.0, -steep_sum):
                steep[steep_count] = first
                steep_count += 1
        if relaxes:
            if fades:
                _fade_arms(arm_modulus, arm_tension, relief, springs, first, scale / share, fade)
            scale = scale * load_full(gain, first) - load_full(relief, first) * share
        _pull(force, nodes, first, r0 * _at_0(scale))
        _pull(force, nodes, first + 1, r1 * _at_1(scale))
        _pull(force, nodes, first + 2, r2 * _at_2(scale))
        _pull(force, nodes, first + 3, r3 * _at_3(scale))
        _pull(force, nodes, first + 4, r4 * _at_4(scale))
        _pull(force, nodes, first + 5, r5 * _at_5(scale))
        _pull(force, nodes, first + 6, r6 * _at_6(scale))
        _pull(force, nodes, first + 7, r7 * _at_7(scale))
    return whole, steep_count


@njit(**KERNEL)
def sum_tet_groups(position, total, pairs, lengths, tets, stiffness, rest_length, stiffens):
    """Sums at nodes over whole groups of tets; arguments as in `tissue_kernels.sum_at_nodes`.

    Returns the first tet that is in no whole group.
    """
    whole = tets.shape[0] // GROUP * GROUP
    for first in range(0, whole, GROUP):
        bx, by, bz = _edges(position, tets, first, 1)
        cx, cy, cz = _edges(position, tets, first, 2)
        dx, dy, dz = _edges(position, tets, first, 3)
        g = tet_gradients(bx, by, bz, cx, cy, cz, dx, dy, dz)
        six = six_volumes(bx, by, bz, g[0], g[1], g[2])
        if stiffens:
            length = spring_length(bx, by, bz)
            store_full(lengths, first, length)
            energy = spring_energy(length, load_full(rest_length, first), load_full(stiffness, first))
            _add_volumes_and_energies(pairs, tets, first, six, energy)
        else:
            add_to_corners((), total, tets, first, _at_0(six))
            add_to_corners((), total, tets, first + 1, _at_1(six))
            add_to_corners((), total, tets, first + 2, _at_2(six))
            add_to_corners((), total, tets, first + 3, _at_3(six))
            add_to_corners((), total, tets, first + 4, _at_4(six))
            add_to_corners((), total, tets, first + 5, _at_5(six))
            add_to_corners((), total, tets, first + 6, _at_6(six))
            add_to_corners((), total, tets, first + 7, _at_7(six))
    return whole


@njit(**KERNEL)
def add_tet_groups(
    position, force, tension, tets, inverse_volume, bulk, averaged_bulk, stiffness, rest_length, low, squeezed, law,
    steep_count,
):  # fmt: skip
    """Forces of whole groups of tets; arguments as in `tissue_kernels.add_tet_forces`.

    Returns the first tet that is in no whole group, how many groups have a squeezed tet, and how many entries
    `law.steep` has.
    """
    measured, lengths, pairs = law.measured, law.lengths, law.pairs
    stiffens, steepens, steep, steep_sum = law.stiffens, law.steepens, law.steep, law.steep_sum
    relaxes, gain, relief, fades, fade = law.relaxes, law.gain, law.relief, law.fades, law.fade
    arm_modulus, arm_tension = law.arm_modulus, law.arm_tension
    springs = stiffness.shape[0]
    whole = tets.shape[0] // GROUP * GROUP
    count = 0
    lowest = spread_like(inverse_volume, low[0])
    for first in range(0, whole, GROUP):
        bx, by, bz = _edges(position, tets, first, 1)
        cx, cy, cz = _edges(position, tets, first, 2)
        dx, dy, dz = _edges(position, tets, first, 3)
        gbx, gby, gbz, gcx, gcy, gcz, gdx, gdy, gdz = tet_gradients(bx, by, bz, cx, cy, cz, dx, dy, dz)
        ratio = volume_ratio(six_volumes(bx, by, bz, gbx, gby, gbz), load_full(inverse_volume, first))
        lowest = keep_lower(ratio, lowest, ratio, lowest)
        if any_below(ratio, SQUEEZED_RATIO):
            squeezed[count] = first
            count += 1
        if measured:
            averaged, factor = _means_and_end_sums(pairs, tets, first)
            length = load_full(lengths, first)
        else:
            averaged, length = _corner_means(tension, tets, first), spring_length(bx, by, bz)
            factor = length
        scale = tet_scale(ratio, load_full(bulk, first), load_full(averaged_bulk, first), averaged)
        share = load_full(rest_length, first) / length
        rigidity = load_full(stiffness, first)
        pull = spring_scale(share, rigidity)
        if stiffens:
            pull = pull * factor
            if steepens and any_below(factor * -1.0, -steep_sum):
                steep[steep_count] = first
                steep_count += 1
        if relaxes:
            if fades:
                _fade_arms(arm_modulus, arm_tension, relief, springs, first, pull / share, fade)
            pull = pull * load_full(gain, first) - load_full(relief, first) * share
        gbx, gby, gbz = scale * gbx - pull * bx, scale * gby - pull * by, scale * gbz - pull * bz
        gcx, gcy, gcz = scale * gcx, scale * gcy, scale * gcz
        gdx, gdy, gdz = scale * gdx, scale * gdy, scale * gdz
        a = _rows(gbx + gcx + gdx, gby + gcy + gdy, gbz + gcz + gdz)
        b, c, d = _rows(gbx, gby, gbz), _rows(gcx, gcy, gcz), _rows(gdx, gdy, gdz)
        _push(force, tets, first, a[0], b[0], c[0], d[0])
        _push(force, tets, first + 1, a[1], b[1], c[1], d[1])
        _push(force, tets, first + 2, a[2], b[2], c[2], d[2])
        _push(force, tets, first + 3, a[3], b[3], c[3], d[3])
        _push(force, tets, first + 4, a[4], b[4], c[4], d[4])
        _push(force, tets, first + 5, a[5], b[5], c[5], d[5])
        _push(force, tets, first + 6, a[6], b[6], c[6], d[6])
        _push(force, tets, first + 7, a[7], b[7], c[7], d[7])
    _keep(low, _at_0(lowest))
    _keep(low, _at_1(lowest))
    _keep(low, _at_2(lowest))
    _keep(low, _at_3(lowest))
    _keep(low, _at_4(lowest))
    _keep(low, _at_5(lowest))
    _keep(low, _at_6(lowest))
    _keep(low, _at_7(lowest))
    return whole, count, steep_count


@njit(**INLINED)
def _keep(low, ratio):
    """Remember a volume ratio where it is the smallest yet."""
    if not ratio >= low[0]:
        low[0] = ratio
