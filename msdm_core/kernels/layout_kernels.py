"""Memory layout of nodes, springs and tets, for an organ alone and for vectorised organs in lanes.

The length of the tuple `lanes` is the number of organs side by side, and thereby part of the compiled type. One
register then holds the same number of every organ (8 of float64, 16 or 8 of float32): arrays are (n_item, n_lane) and
(n_node, 3, n_lane), without gathering and scattering. For an organ alone `lanes` is empty: arrays are (n_item,) of
numbers and (n_node, 4) of float64, with rows of x, y, z and padding that load as one register. The layout is known at
compile time, so that the other branch of each `if len(lanes) == 0` disappears.
"""

import numpy as np
from numba import njit

from msdm_core.kernels.option_kernels import ALLOCATING_KERNEL, INLINED
from msdm_core.kernels.space_kernels import minus, plus, row_of, set_row
from msdm_core.kernels.vector_kernels import (
    GROUP,
    define_extract,
    keep_lower,
    load_lanes,
    load_or_spread,
    load_row,
    store_lanes,
    store_row,
)

_at_0, _at_1, _at_2 = define_extract(0), define_extract(1), define_extract(2)


@njit(**INLINED)
def group_width(lanes):
    """Number of tets or springs in a row that an entry of `squeezed_tets` or `steep_springs` stands for."""
    if len(lanes) == 0:
        return GROUP
    return 1


@njit(**INLINED)
def load_item(lanes, values, item):
    """Number of an item, or vector of all organs' numbers."""
    if len(lanes) == 0:
        return values[item]
    return load_lanes(lanes, values, item)


@njit(**INLINED)
def store_item(lanes, values, item, value):
    """Store for `load_item`."""
    if len(lanes) == 0:
        values[item] = value
    else:
        store_lanes(values, item, value)


@njit(**INLINED)
def load_shared(lanes, like, values, item):
    """`load_item` of an array of the type of `like`, (n_item,) if all organs share it."""
    if len(lanes) == 0:
        return values[item]
    return load_or_spread(lanes, like, values, item)


@njit(**INLINED)
def load_half(lanes, pairs, node, half):
    """First (0) or second (1) of a node's two numbers, in an array (n_node, 2) or (2, n_node, n_lane).

    For an organ alone both load as one register; for organs side by side each is a line of the cache, and numbers read
    together stand together.
    """
    if len(lanes) == 0:
        return pairs[node, half]
    return load_lanes(lanes, pairs, half * pairs.shape[1] + np.intp(node))


@njit(**INLINED)
def store_half(lanes, pairs, node, half, value):
    """Store for `load_half`."""
    if len(lanes) == 0:
        pairs[node, half] = value
    else:
        store_lanes(pairs, half * pairs.shape[1] + np.intp(node), value)


@njit(**INLINED)
def add_half(lanes, pairs, node, half, value):
    """Addition to the number of `load_half`."""
    store_half(lanes, pairs, node, half, load_half(lanes, pairs, node, half) + value)


@njit(**INLINED)
def load_column(lanes, values, width, item, column):
    """Number of an item's row, or vector of all organs' numbers, of an array (n_item, width, n_lane).

    An organ alone may have wider rows than `width`.
    """
    if len(lanes) == 0:
        return values[item, column]
    return load_lanes(lanes, values, width * np.intp(item) + column)


@njit(**INLINED)
def store_column(lanes, values, width, item, column, value):
    """Store for `load_column`."""
    if len(lanes) == 0:
        values[item, column] = value
    else:
        store_lanes(values, width * np.intp(item) + column, value)


@njit(**INLINED)
def parts_of(lanes):
    """Number of registers for a node's x, y and z."""
    if len(lanes) == 0:
        return 1
    return 3


@njit(**INLINED)
def load_part(lanes, values, part):
    """Register of an array of nodes; node i begins at i * parts_of(lanes)."""
    if len(lanes) == 0:
        return load_row(values, part)
    return load_lanes(lanes, values, part)


@njit(**INLINED)
def store_part(lanes, values, part, value):
    """Store for `load_part`."""
    if len(lanes) == 0:
        store_row(values, part, value)
    else:
        store_lanes(values, part, value)


@njit(**INLINED)
def store_sum(lanes, total, value):
    """Store a sum over `load_part` in an array (1,) or (1, n_lane), for a row the sum of its three numbers."""
    if len(lanes) == 0:
        total[0] = (_at_0(value) + _at_1(value)) + _at_2(value)
    else:
        store_lanes(total, 0, value)


@njit(**INLINED)
def where_moving(lanes, moving, after, before):
    """Value `after` of each moving organ (1 in `moving`), `before` of the others."""
    if len(lanes) == 0:
        return after
    moves = load_lanes(lanes, moving, 0)
    return keep_lower(moves, moves * 0.0 + 1.0, before, after)


@njit(**INLINED)
def at_node(lanes, values, node):
    """Vector of a node, of an array of nodes."""
    if len(lanes) == 0:
        return row_of(values, node)
    part = 3 * np.intp(node)
    return load_lanes(lanes, values, part), load_lanes(lanes, values, part + 1), load_lanes(lanes, values, part + 2)


@njit(**INLINED)
def set_node(lanes, values, node, vector):
    """Store for `at_node`."""
    if len(lanes) == 0:
        set_row(values, node, 0, vector)
    else:
        part = 3 * np.intp(node)
        store_lanes(values, part, vector[0])
        store_lanes(values, part + 1, vector[1])
        store_lanes(values, part + 2, vector[2])


@njit(**INLINED)
def difference(lanes, values, items, item, corner):
    """Vector from corner 0 of an item to another corner, of an array of nodes."""
    return minus(at_node(lanes, values, items[item, corner]), at_node(lanes, values, items[item, 0]))


@njit(**INLINED)
def three_edges(lanes, values, tets, tet):
    """Vectors from corner 0 of a tet to its other three corners."""
    return (
        difference(lanes, values, tets, tet, 1),
        difference(lanes, values, tets, tet, 2),
        difference(lanes, values, tets, tet, 3),
    )


@njit(**INLINED)
def add_to_node(lanes, force, node, share):
    """Add a vector to a node's force."""
    set_node(lanes, force, node, plus(at_node(lanes, force, node), share))


@njit(**INLINED)
def take_from_node(lanes, force, node, share):
    """Subtract a vector from a node's force."""
    set_node(lanes, force, node, minus(at_node(lanes, force, node), share))


@njit(**INLINED)
def add_to_corners(lanes, total, tets, tet, value):
    """Add a number to each corner of a tet."""
    for corner in range(4):
        node = tets[tet, corner]
        store_item(lanes, total, node, load_item(lanes, total, node) + value)


@njit(**INLINED)
def add_volume_and_energies(lanes, pairs, tets, tet, volume, at_ends, elsewhere):
    """Add to the first numbers of the pairs at a tet's corners, and to the second ones at its spring's ends, elsewhere.

    All loads come before the stores: the compiler cannot know that the places differ.
    """
    a, b, c, d = tets[tet, 0], tets[tet, 1], tets[tet, 2], tets[tet, 3]
    volume_a, volume_b = load_half(lanes, pairs, a, 0) + volume, load_half(lanes, pairs, b, 0) + volume
    volume_c, volume_d = load_half(lanes, pairs, c, 0) + volume, load_half(lanes, pairs, d, 0) + volume
    energy_a, energy_b = load_half(lanes, pairs, a, 1) + at_ends, load_half(lanes, pairs, b, 1) + at_ends
    energy_c, energy_d = load_half(lanes, pairs, c, 1) + elsewhere, load_half(lanes, pairs, d, 1) + elsewhere
    store_half(lanes, pairs, a, 0, volume_a)
    store_half(lanes, pairs, b, 0, volume_b)
    store_half(lanes, pairs, c, 0, volume_c)
    store_half(lanes, pairs, d, 0, volume_d)
    store_half(lanes, pairs, a, 1, energy_a)
    store_half(lanes, pairs, b, 1, energy_b)
    store_half(lanes, pairs, c, 1, energy_c)
    store_half(lanes, pairs, d, 1, energy_d)


@njit(**INLINED)
def corner_sum_of_pairs(lanes, pairs, tets, tet, half):
    """Sum of the first (0) or second (1) numbers of pairs at the corners of a tet."""
    return (
        load_half(lanes, pairs, tets[tet, 0], half) + load_half(lanes, pairs, tets[tet, 1], half)
        + load_half(lanes, pairs, tets[tet, 2], half) + load_half(lanes, pairs, tets[tet, 3], half)
    )  # fmt: skip


@njit(**INLINED)
def corner_mean(lanes, values, tets, tet):
    """Mean of the numbers at the corners of a tet."""
    return 0.25 * (
        load_item(lanes, values, tets[tet, 0]) + load_item(lanes, values, tets[tet, 1])
        + load_item(lanes, values, tets[tet, 2]) + load_item(lanes, values, tets[tet, 3])
    )  # fmt: skip


@njit(**ALLOCATING_KERNEL)
def spread_order(items, base, gap, waiting, last, order):
    """Change of a base order that keeps items of a common node apart.

    Each place takes the first of the next n_waiting items without a node in the last `gap` places; failing that, the
    item with the least recent nodes.

    In:  items: their nodes (n_item, 2 or 4), base: an order (n_item,), gap
    Out: waiting: scratch (n_waiting,), last: last place of each node, initially -gap (n_node,), order (n_item,)
    """
    count, held = base.shape[0], min(waiting.shape[0], base.shape[0])
    # Entry by entry: for slices numba would compile an error message with both shapes, which takes a second.
    for entry in range(held):
        waiting[entry] = base[entry]
    for place in range(count):
        chosen, widest = 0, -1
        for entry in range(held):
            apart = gap + place
            for corner in range(items.shape[1]):
                apart = min(apart, place - last[items[waiting[entry], corner]])
            if apart > widest:
                chosen, widest = entry, apart
                if apart >= gap:
                    break
        item = waiting[chosen]
        for entry in range(chosen, held - 1):
            waiting[entry] = waiting[entry + 1]
        held -= 1
        for corner in range(items.shape[1]):
            last[items[item, corner]] = place
        order[place] = item
        following = place + waiting.shape[0]
        if following < count:
            waiting[held] = base[following]
            held += 1
