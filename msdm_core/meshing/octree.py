"""Graded body-centred cubic lattices: a weakly balanced octree of cells, filled with tets (Labelle and Shewchuk 2007).

A leaf of level l is a cube of 2^l fine cells along each edge. Grid coordinates count half FINE cells, as in
`msdm_core.meshing.stuffing`: every leaf corner and centre is then a grid point, all even or (centres of fine leaves)
all odd.
"""

from itertools import product

import numpy as np
from numpy.typing import NDArray

Int64Array = NDArray[np.int64]

# Steps to the cells with which a cell shares a face or an edge (weak balance), but not only a corner.
BESIDE = np.array([step for step in product((-1, 0, 1), repeat=3) if 1 <= np.abs(step).sum() <= 2])
RING = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])  # corners of a face, in turn


def balanced_levels(permitted: Int64Array) -> Int64Array:
    """Level of the leaf around each fine cell: the largest leaves that weak balance and a permission per cell allow.

    A leaf exceeds the permission of none of its cells, nor, by more than one, the level of a leaf with which it
    shares a face or a part of an edge.

    Args:
        permitted: largest level wanted at each fine cell, shape (nx, ny, nz), multiples of 2^(largest level).
    """
    while True:
        level = _largest_leaves(permitted)
        padded = np.pad(level, 1, mode="edge")
        lowest = np.full(level.shape, level.max())
        for step in BESIDE:
            window = tuple(slice(1 + s, 1 + s + n) for s, n in zip(step, level.shape, strict=True))
            lowest = np.minimum(lowest, padded[window])
        if (level <= lowest + 1).all():
            return level
        permitted = np.minimum(level, lowest + 1)


def _largest_leaves(permitted: Int64Array) -> Int64Array:
    level = np.zeros(permitted.shape, dtype=np.int64)
    for wanted in range(1, int(permitted.max()) + 1):
        width = 2**wanted
        nx, ny, nz = (n // width for n in permitted.shape)
        whole = permitted.reshape(nx, width, ny, width, nz, width).min(axis=(1, 3, 5)) >= wanted
        level[np.kron(whole, np.ones((width, width, width), dtype=bool))] = wanted
    return level


def octree_tets(level: Int64Array) -> Int64Array:
    """Tets that fill a balanced octree, as grid points numbered row by row, not oriented, shape (n_tet, 4).

    Between leaves of one size lie BCC tets (two centres and an edge of the face), cut in two where smaller leaves
    have a corner on that edge; a large leaf meets four small ones in eight quarters of a BCC tet at the centre of
    its face, and the small ones meet it in half pyramids, as they do the outside. An outer face with a corner on one
    of its edges is cut from its centre.

    Args:
        level: from `balanced_levels`, shape (nx, ny, nz).
    """
    is_node = octree_nodes(level)
    found = []
    for size in range(int(level.max()) + 1):
        centre = _leaf_centres(level, size)
        for axis, sign in product(range(3), (-1, 1)):
            found += _face_tets(centre, size, axis, sign, level, is_node)
    places = np.concatenate(found)
    return np.asarray(np.ravel_multi_index(tuple(np.moveaxis(places, -1, 0)), is_node.shape), dtype=np.int64)


def octree_nodes(level: Int64Array) -> NDArray[np.bool_]:
    """Which grid points are corners or centres of leaves, shape (2 nx + 1, 2 ny + 1, 2 nz + 1)."""
    is_node = np.zeros([2 * n + 1 for n in level.shape], dtype=bool)
    for size in range(int(level.max()) + 1):
        centre = _leaf_centres(level, size)
        for corner in [(0, 0, 0), *product((-1, 1), repeat=3)]:
            is_node[tuple((centre + 2**size * np.array(corner)).T)] = True
    return is_node


def _leaf_centres(level: Int64Array, size: int) -> Int64Array:
    """Grid coordinates of the centres of the leaves of one level, shape (n, 3)."""
    width = 2**size
    return 2 * width * np.argwhere(level[::width, ::width, ::width] == size) + width


def _face_tets(
    centre: Int64Array, size: int, axis: int, sign: int, level: Int64Array, is_node: NDArray[np.bool_]
) -> list[Int64Array]:
    """Grid coordinates of the tets of leaves of one level at their faces on one side, each (n, 4, 3)."""
    half = 2**size
    outward, ring = _face_frame(half, axis, sign)
    beyond = (centre + outward) // 2
    beyond[:, axis] += 0 if sign > 0 else -1
    outside = (beyond[:, axis] < 0) | (beyond[:, axis] >= level.shape[axis])
    other = np.where(outside, size + 1, level[tuple(np.where(outside[:, None], 0, beyond).T)])
    is_cut = np.stack([_at(is_node, centre + (ring[k] + ring[(k + 1) % 4]) // 2) for k in range(4)], axis=1)
    fanned = (other < size) | (outside & is_cut.any(axis=1))
    halved = (other > size) & ~fanned
    tets = [_half_pyramids(centre[halved], ring, half)]
    for k in range(4):
        first, second = ring[k], ring[(k + 1) % 4]
        middle = (first + second) // 2
        alike = (other == size) & (sign > 0)
        for apexes, chosen in (((0 * outward, 2 * outward), alike), ((0 * outward, outward), fanned)):
            for ends, picked in (
                ((first, second), chosen & ~is_cut[:, k]),
                ((first, middle), chosen & is_cut[:, k]),
                ((middle, second), chosen & is_cut[:, k]),
            ):
                tets.append(centre[picked][:, None] + np.array([*apexes, *ends]))
    return tets


def _face_frame(half: int, axis: int, sign: int) -> tuple[Int64Array, Int64Array]:
    """Steps from a leaf's centre to the centre of a face, (3,), and to the corners of the face in turn, (4, 3)."""
    outward = np.zeros(3, dtype=np.int64)
    outward[axis] = sign * half
    ring = np.tile(outward, (4, 1))
    ring[:, [(axis + 1) % 3, (axis + 2) % 3]] = half * RING
    return outward, ring


def _half_pyramids(centre: Int64Array, ring: Int64Array, half: int) -> Int64Array:
    """Two tets per leaf on one face, cut along the diagonal that meets the centre of a twice as large neighbour's face.

    Of the four corners, counted in leaf widths, that centre is odd along both directions of the face and its
    opposite even along both; on outer faces the same rule alternates like a checkerboard.
    """
    varying = np.flatnonzero(np.ptp(ring, axis=0))
    odd = ((centre + ring[0])[:, varying] // (2 * half)).sum(axis=1) % 2
    turned = ring[(np.arange(4) + odd[:, None]) % 4]
    apex = centre[:, None]
    corners = apex + turned
    return np.concatenate([np.concatenate([apex, corners[:, pick]], axis=1) for pick in ([0, 1, 2], [0, 2, 3])])


def _at(grid: NDArray[np.bool_], places: Int64Array) -> NDArray[np.bool_]:
    return grid[tuple(places.T)]
