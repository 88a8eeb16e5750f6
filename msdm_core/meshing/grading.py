"""Graded lattices: fine cells at chosen triangles, cells 2 or 4 times as long elsewhere.

The lattice is a weakly balanced octree of cells, filled with tets (Labelle and Shewchuk 2007); a leaf of level l is a
cube of 2^l fine cells along each edge. Grid coordinates count half FINE cells, as in `msdm_core.meshing.stuffing`:
leaf corners and centres are then grid points, all even or (centres of fine leaves) all odd. Labelle and Shewchuk keep
the whole surface in leaves of one size; no bound on the angles is published for a surface that crosses leaves of
several sizes. The angles are therefore measured, and the cells around too small an angle are made fine.
"""

from itertools import product

import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import matmul, norm
from msdm_core.errors import MeshError
from msdm_core.mesh.quality import tet_angles
from msdm_core.mesh.tet_mesh import TET_EDGES, TET_FACES, FloatArray, Int64Array, oriented_tets
from msdm_core.meshing.stuffing import (
    ALPHA_LONG,
    ALPHA_SHORT,
    Body,
    Cuts,
    Lattice,
    fill_background,
    lattice_around,
)

COARSENINGS = (1, 2, 4)  # largest / smallest cell edge of a lattice, per level of the largest

# Nodes of other than BCC tets move onto a surface within this share of an edge. On 16 bumpy bodies with randomly
# scattered leaf sizes 0.30 kept all angles above 10 degrees, 0.35 above 5, 0.38 above 2.
ALPHA_TRANSITION = 0.30
# Smallest accepted dihedral angle [degrees]. BCC tets alone have at least 9.3, so finer cells help.
ANGLE_SMALLEST = 9.0
SAMPLES_PER_CELL = 4  # points on chosen triangles, per cell edge

# Steps to the neighbours of a cell through faces and edges (weak balance), without those through corners.
BESIDE = np.array([step for step in product((-1, 0, 1), repeat=3) if 1 <= np.abs(step).sum() <= 2])
RING = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])  # corners of a face, in turn


def coarsest_level(size: float, coarse_cell_size: float) -> int:
    """Level of the largest cells: 0 for cells of one size, 1 or 2."""
    ratio = coarse_cell_size / size
    for level, coarsening in enumerate(COARSENINGS):
        if abs(ratio - coarsening) <= 1e-9 * coarsening:
            return level
    raise MeshError(
        f"coarse_cell_size {coarse_cell_size:g} m is {ratio:g} times cell_size {size:g} m; "
        f"the rule is 1, 2 or 4 times: use {2 * size:g} or {4 * size:g} m"
    )


def stuff_graded(
    body: Body, fine: FloatArray, cell_size: float, fine_depth: float, coarsest: int
) -> tuple[FloatArray, Int64Array]:
    """Fill a body with tets: points (n_node, 3) [m] and tets (n_tet, 4), not oriented.

    Args:
        body: inside of a closed surface or level set.
        fine: corners of the triangles surrounded by fine cells [m], shape (n_fine, 3, 3).
        cell_size: edge of the fine cells [m].
        fine_depth: cells within this distance of such a triangle along each axis are fine [m].
        coarsest: level of the largest cells, with an edge of 2^coarsest fine cells.
    """
    from scipy.ndimage import maximum_filter

    lattice = lattice_around(body.box, cell_size, 2**coarsest)
    permitted = _permitted_levels(fine, lattice, fine_depth, coarsest)
    inside = body.signs(lattice) > 0
    lattice, permitted = _shifted(lattice, permitted, inside.reshape(lattice.shape))
    sign = body.signs(lattice)
    reach = 0
    while True:
        level = balanced_levels(permitted)
        points, tets = _fill(body, sign.copy(), lattice, level)
        places = points[tets[_poor_tets(points, tets)]].mean(axis=1)
        if not len(places):
            return points, tets
        # The fine zone grows until there are no poor tets, at the latest when all cells are fine.
        reach += 1
        poor = np.zeros(permitted.shape, dtype=bool)
        poor[tuple(((places - lattice.origin) // (2 * lattice.half_cell)).astype(np.int64).T)] = True
        permitted = np.where(maximum_filter(poor, size=2 * reach + 1), np.maximum(level - 1, 0), level)


def _permitted_levels(corners: FloatArray, lattice: Lattice, fine_depth: float, coarsest: int) -> Int64Array:
    """Level 0 at cells within a depth [m] of triangles (n, 3, 3), the coarsest level elsewhere."""
    from scipy.spatial import KDTree

    shape = np.array(lattice.shape) // 2
    size = 2 * lattice.half_cell
    cells = np.stack(np.unravel_index(np.arange(shape.prod()), shape), axis=1)
    reach = fine_depth + lattice.half_cell
    tree = KDTree(_points_on(corners, size / SAMPLES_PER_CELL))
    distance, _ = tree.query(lattice.origin + size * (cells + 0.5), p=np.inf, distance_upper_bound=1.01 * reach)
    return np.where(distance <= reach, 0, coarsest).reshape(shape)


def _points_on(corners: FloatArray, spacing: float) -> FloatArray:
    """Points on triangles (n, 3, 3), along each side no farther apart than a spacing [m], shape (n_point, 3)."""
    longest = norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    counts = np.ceil(longest / spacing).astype(np.int64)
    points = []
    for count in np.unique(counts).tolist():
        weights = np.array([(i, j, count - i - j) for i in range(count + 1) for j in range(count + 1 - i)]) / count
        points.append(matmul(weights, corners[counts == count]).reshape(-1, 3))
    return np.concatenate(points)


def _shifted(lattice: Lattice, permitted: Int64Array, inside: NDArray[np.bool_]) -> tuple[Lattice, Int64Array]:
    """The lattice and the permitted levels, shifted by whole fine cells for the fewest nodes inside."""
    width = 2 ** int(permitted.max())
    best, least = (0, 0, 0), np.inf
    # No wrap-around: the surface keeps more than `width` cells from the grid's sides.
    for shift in product(range(width), repeat=3):
        nodes = octree_nodes(balanced_levels(np.roll(permitted, shift, (0, 1, 2))))
        count = int((nodes & np.roll(inside, 2 * np.array(shift), (0, 1, 2))).sum())
        if count < least:
            best, least = shift, count
    origin = lattice.origin - 2 * lattice.half_cell * np.array(best)
    return Lattice(origin, lattice.half_cell, lattice.shape), np.roll(permitted, best, (0, 1, 2))


def _fill(body: Body, sign: NDArray[np.int8], lattice: Lattice, level: Int64Array) -> tuple[FloatArray, Int64Array]:
    background = octree_tets(level)
    background = background[(sign[background] > 0).any(axis=1)]
    cuts, limit = _edge_cuts(background, sign, body, lattice)
    return fill_background(background, cuts, limit, sign, lattice)


def _edge_cuts(background: Int64Array, sign: NDArray[np.int8], body: Body, lattice: Lattice) -> tuple[Cuts, FloatArray]:
    """Cuts of the edges between inside and outside, and the share of each for `fill_background`."""
    ends = np.sort(background[:, TET_EDGES], axis=2)
    keys = ends[..., 0] * sign.size + ends[..., 1]
    is_cut = sign[ends[..., 0]] * sign[ends[..., 1]] < 0
    cut_keys = np.unique(keys[is_cut])
    node, other = cut_keys // sign.size, cut_keys % sign.size
    step = lattice.coordinates(other) - lattice.coordinates(node)
    fraction = np.empty(len(node))
    directions, direction = np.unique(np.sign(step), axis=0, return_inverse=True)
    for k in range(len(directions)):
        chosen = direction.ravel() == k
        fraction[chosen] = body.fractions(step[chosen], node[chosen], sign, lattice)
    is_long = (step != 0).sum(axis=1) == 1
    diagonal_count = (lattice.coordinates(ends[..., 0]) != lattice.coordinates(ends[..., 1])).all(axis=2).sum(axis=1)
    # A BCC tet has four diagonal edges.
    at_transition = np.isin(cut_keys, keys[diagonal_count != 4])
    limit = np.where(at_transition, ALPHA_TRANSITION, np.where(is_long, ALPHA_LONG, ALPHA_SHORT))
    return Cuts(node, other, fraction, is_long), limit


def _poor_tets(points: FloatArray, tets: Int64Array) -> NDArray[np.bool_]:
    """Tets with too small an angle, or folded: on the same side of a face as their neighbour, shape (n_tet,)."""
    tets = oriented_tets(points, tets)
    with np.errstate(divide="ignore", invalid="ignore"):
        fits = tet_angles(points, tets).min(axis=1) >= ANGLE_SMALLEST
    faces = tets[:, TET_FACES].reshape(-1, 3)
    ordered = np.sort(faces, axis=1)
    turn = (faces[:, 0] < faces[:, 1]) ^ (faces[:, 1] < faces[:, 2]) ^ (faces[:, 0] < faces[:, 2])
    keys = (ordered[:, 0] * len(points) + ordered[:, 1]) * len(points) + ordered[:, 2]
    order = np.argsort(keys, kind="stable")
    twin = np.flatnonzero((keys[order[1:]] == keys[order[:-1]]) & (turn[order[1:]] == turn[order[:-1]]))
    fits[order[twin] // 4] = False
    return ~fits


def balanced_levels(permitted: Int64Array) -> Int64Array:
    """Level of the leaf around each fine cell, in the octree of the largest permitted leaves.

    A leaf exceeds the permission of none of its cells, nor, by more than one, the level of a neighbour through a face
    or a part of an edge (weak balance).

    Args:
        permitted: largest level at each fine cell, shape (nx, ny, nz), multiples of 2^(largest level).
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
    for size in range(1, int(permitted.max()) + 1):
        width = 2**size
        nx, ny, nz = (n // width for n in permitted.shape)
        whole = permitted.reshape(nx, width, ny, width, nz, width).min(axis=(1, 3, 5)) >= size
        level[np.kron(whole, np.ones((width, width, width), dtype=bool))] = size
    return level


def octree_tets(level: Int64Array, *, top_nodes: bool = False) -> Int64Array:
    """Tets of a balanced octree, as grid points numbered row by row, not oriented, shape (n_tet, 4).

    Between leaves of one size lie BCC tets (two centres and an edge of the face), cut in two by a corner of smaller
    leaves on that edge. A large leaf meets four small ones in eight quarters of a BCC tet around the centre of its
    face; the small ones meet it in half pyramids, as they do the outside. An outer face with a corner on an edge is
    cut from its centre.

    Args:
        level: from `balanced_levels`, shape (nx, ny, nz).
        top_nodes: True for all outer faces at the end of the third axis cut from their centres, into half BCC tets.
    """
    is_node = octree_nodes(level)
    tets = []
    for size in range(int(level.max()) + 1):
        centre = _leaf_centres(level, size)
        for axis, sign in product(range(3), (-1, 1)):
            tets += _face_tets(centre, size, axis, sign, level, is_node, top_nodes)
    places = np.moveaxis(np.concatenate(tets), -1, 0)
    return np.asarray(np.ravel_multi_index(tuple(places), is_node.shape), dtype=np.int64)


def octree_nodes(level: Int64Array) -> NDArray[np.bool_]:
    """Corners and centres of leaves among the grid points, shape (2 nx + 1, 2 ny + 1, 2 nz + 1)."""
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
    centre: Int64Array,
    size: int,
    axis: int,
    sign: int,
    level: Int64Array,
    is_node: NDArray[np.bool_],
    top_nodes: bool,
) -> list[Int64Array]:
    """Grid coordinates of the tets of leaves of one level at their faces on one side, each (n, 4, 3)."""
    half = 2**size
    # Steps from the centre to that of the face, and to the face's corners in turn.
    outward = np.zeros(3, dtype=np.int64)
    outward[axis] = sign * half
    ring = np.tile(outward, (4, 1))
    ring[:, [(axis + 1) % 3, (axis + 2) % 3]] = half * RING
    beyond = (centre + outward) // 2
    beyond[:, axis] += 0 if sign > 0 else -1
    outside = (beyond[:, axis] < 0) | (beyond[:, axis] >= level.shape[axis])
    other = np.where(outside, size + 1, level[tuple(np.where(outside[:, None], 0, beyond).T)])
    is_cut = np.stack([is_node[tuple((centre + (ring[k] + ring[(k + 1) % 4]) // 2).T)] for k in range(4)], axis=1)
    fanned = (other < size) | (outside & ((top_nodes and axis == 2 and sign > 0) | is_cut.any(axis=1)))
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


def _half_pyramids(centre: Int64Array, ring: Int64Array, half: int) -> Int64Array:
    """Two tets per leaf on one face, cut along the diagonal through the centre of a twice as large neighbour's face.

    Of the four corners, counted in leaf widths, that centre is odd along both directions of the face and its
    opposite even along both; on outer faces the same rule alternates like a checkerboard.
    """
    varying = np.flatnonzero(np.ptp(ring, axis=0))
    odd = ((centre + ring[0])[:, varying] // (2 * half)).sum(axis=1) % 2
    apex = centre[:, None]
    corners = apex + ring[(np.arange(4) + odd[:, None]) % 4]
    return np.concatenate([np.concatenate([apex, corners[:, pick]], axis=1) for pick in ([0, 1, 2], [0, 2, 3])])
