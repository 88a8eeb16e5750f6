"""Blocks and filled surfaces on body-centred cubic (BCC) lattices, where the springs of formula (6) are isotropic.

Both can be graded: fine where the tissue is felt, with cells 2 or 4 times as long elsewhere
(`msdm_core.meshing.grading`). At the seams between cell sizes formula (6) is not isotropic.
"""

import warnings

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.arithmetic import cbrt
from msdm_core.errors import MeshError
from msdm_core.mesh.ordering import swept
from msdm_core.mesh.surface import check_surface, surface_volume
from msdm_core.mesh.tet_mesh import FloatArray, Int64Array, TetMesh, connected_tets, oriented_tets, tet_volumes
from msdm_core.meshing.grading import COARSENINGS, balanced_levels, coarsest_level, octree_tets, stuff_graded
from msdm_core.meshing.stuffing import SurfaceBody, lattice_around, stuff

STRETCH_LIMIT = 1.01  # longest / shortest cell edge up to which a lattice counts as cubic
TETS_PER_CELL = 12
CELLS_ACROSS_MIN = 2
TET_LIMIT = 2_000_000
GRID_LIMIT = 200_000_000  # half cells in the box around a surface: about 1 GB while meshing


def box_mesh(
    size: ArrayLike, cells: ArrayLike, *, coarsening: int = 1, fine_depth: float = 0.0, top_nodes: bool = True
) -> TetMesh:
    """The block [0, sx] x [0, sy] x [0, sz] on a body-centred cubic lattice, with exact outer faces.

    Nodes are the corners and centres of the cells, along x, y and z in turn. Each inner face of a cell gives four tets
    (two centres and an edge of the face), an outer face two. The diagonals of outer faces alternate like a
    checkerboard, so that the block prefers no direction; the top face, where a tip presses, has nodes in the middle of
    its squares instead, so that all of it yields alike.

    Args:
        size: edge lengths [m], shape (3,).
        cells: whole numbers of cells along each axis, shape (3,).
        coarsening: largest cell edge over the smallest, 1 (cells of one size), 2 or 4; divides each number of cells.
        fine_depth: depth of the fine cells of a graded block below the top face z = sz [m].
        top_nodes: False for a top face like the other ones, for a longer stable step.

    Warns:
        UserWarning: cells more than 1 % from cubes: formula (6) is then not isotropic; names the stretch.

    Raises:
        ValueError: a size or count that is not positive, a coarsening out of range, or too many cells; names it.
    """
    lengths, counts = _checked_box(size, cells, coarsening)
    edges = lengths / counts
    stretch = edges.max() / edges.min()
    if stretch > STRETCH_LIMIT:
        warnings.warn(
            f"the cells are {' x '.join(f'{edge * 1000:.4g}' for edge in edges)} mm, stretched {stretch:.3g} to 1; "
            f"above {STRETCH_LIMIT} the springs of formula (6) are not isotropic: choose cells in proportion to size",
            UserWarning,
            stacklevel=2,
        )
    permitted = np.full(counts, COARSENINGS.index(coarsening), dtype=np.int64)
    # Rounding must not add a layer to a depth of whole layers.
    fine_layers = int(np.ceil(fine_depth / lengths[2] * counts[2] * (1 - 1e-12)))
    permitted[:, :, counts[2] - fine_layers :] = 0
    used, renumbered = np.unique(octree_tets(balanced_levels(permitted), top_nodes=top_nodes), return_inverse=True)
    places = np.stack(np.unravel_index(used, tuple(2 * counts + 1)), axis=1)
    return _swept_mesh(places / (2 * counts) * lengths, renumbered.reshape(-1, 4))


def _checked_box(size: ArrayLike, cells: ArrayLike, coarsening: int) -> tuple[FloatArray, Int64Array]:
    lengths, counts = np.asarray(size, dtype=np.float64), np.asarray(cells)
    if not (lengths > 0.0).all():
        raise ValueError(f"size is {lengths.tolist()}; the rule is three positive lengths in metres")
    if not ((counts >= 1) & (counts == np.floor(counts))).all():
        raise ValueError(f"cells is {counts.tolist()}; the rule is three whole numbers of at least 1")
    if coarsening not in COARSENINGS or (counts % coarsening != 0).any():
        raise ValueError(f"coarsening is {coarsening}; the rule is 1, 2 or 4, and a divisor of cells {counts.tolist()}")
    if TETS_PER_CELL * float(np.prod(counts.astype(np.float64))) > TET_LIMIT:
        raise ValueError(f"cells is {counts.tolist()}; that is more than {TET_LIMIT} tets: choose fewer cells")
    return lengths, counts.astype(np.int64)


def mesh_surface(
    vertices: ArrayLike,
    triangles: ArrayLike,
    *,
    cell_size: float,
    coarse_cell_size: float | None = None,
    fine_triangles: NDArray[np.bool_] | None = None,
    fine_depth: float = 0.0,
) -> TetMesh:
    """Fill a closed surface with tets of a BCC lattice by isosurface stuffing (Labelle and Shewchuk 2007).

    Dihedral angles stay between 9.3 and 161.7 degrees with cells of one size, above 9 in a graded lattice;
    boundary nodes lie on the surface. Parts thinner than about a cell can be lost. The same input always gives the
    same mesh, to the bit.

    Args:
        vertices: of the surface [m], shape (n_vertex, 3).
        triangles: vertex indices, shape (n_triangle, 3); turned outward where needed.
        cell_size: cube edge of the lattice, of its fine cells if graded [m].
        coarse_cell_size: edge of the largest cells, 2 or 4 times `cell_size` [m]; left out, all cells have one size.
        fine_triangles: True for triangles surrounded by fine cells, shape (n_triangle,), for instance from
            `triangles_facing`; left out, all of them.
        fine_depth: cells within this distance of such a triangle along each axis are fine [m].

    Warns:
        UserWarning: thin parts that fell off the largest body, or edges of more than two boundary triangles (a wall
            of thickness 0).

    Raises:
        MeshError: a surface that encloses no single body (see `check_surface`), or a cell size out of range; names
            one that works.
    """
    size = float(cell_size)
    if not (np.isfinite(size) and size > 0):
        raise MeshError(f"cell_size is {cell_size}; the rule is a positive length in metres")
    coarsest = 0 if coarse_cell_size is None else coarsest_level(size, coarse_cell_size)
    points, corners = check_surface(vertices, triangles)
    check_cell_size(np.ptp(points, axis=0), surface_volume(points, corners), size)
    if coarsest:
        fine = corners if fine_triangles is None else corners[fine_triangles]
        if not len(fine):
            raise MeshError(
                "fine_triangles chooses no triangle, so no cell would be fine: does the approach meet the surface?"
            )
        nodes, tets = stuff_graded(SurfaceBody(points, corners), points[fine], size, fine_depth, coarsest)
    else:
        nodes, tets = stuff(SurfaceBody(points, corners), lattice_around(points, size))
    if not len(tets):
        raise MeshError(
            f"cell_size {size:g} m leaves no tets: every part of the surface is thinner than a cell; try {size / 2:g} m"
        )
    finer = f"a coarse_cell_size below {coarse_cell_size:g} m" if coarsest else f"a cell_size below {size:g} m"
    return largest_body_mesh(nodes, tets, finer)


def largest_body_mesh(nodes: FloatArray, tets: Int64Array, finer: str) -> TetMesh:
    """Mesh of the largest body of some tets, in the order of the kernels, with the warnings of `mesh_surface`.

    Args:
        nodes: points [m], shape (n, 3).
        tets: shape (n_tet, 4), not oriented.
        finer: remedy against lost thin parts, for the warnings.
    """
    tets = _largest_body(oriented_tets(nodes, tets), tet_volumes(nodes, tets), finer)
    used, renumbered = np.unique(tets, return_inverse=True)
    mesh = _swept_mesh(nodes[used], renumbered.reshape(-1, 4))
    _warn_of_pinches(mesh, finer)
    return mesh


def check_cell_size(extent: FloatArray, volume: float, size: float) -> None:
    """Refuse cells that are too coarse or too fine for a body of an extent (3,) [m] and a volume [m^3]."""
    smallest = extent.min()
    if smallest < CELLS_ACROSS_MIN * size:
        raise MeshError(
            f"cell_size {size:g} m is too coarse: the body is {smallest:.4g} m across its smallest extent, the "
            f"rule is at least {CELLS_ACROSS_MIN} cells: use {smallest / (2 * CELLS_ACROSS_MIN):.2g} m or less"
        )
    tet_count = TETS_PER_CELL * volume / (size * size * size)
    grid_count = np.prod(2 * extent / size)
    finest = max(float(cbrt(TETS_PER_CELL * volume / TET_LIMIT)), 2 * float(cbrt(np.prod(extent) / GRID_LIMIT)))
    if tet_count > TET_LIMIT or grid_count > GRID_LIMIT:
        raise MeshError(
            f"cell_size {size:g} m would give about {tet_count:.3g} tets in {grid_count / 8:.3g} cells; the rule is "
            f"at most {TET_LIMIT:g} tets: use {1.05 * finest:.2g} m or more (is it in metres?)"
        )


def _swept_mesh(points: FloatArray, tets: Int64Array) -> TetMesh:
    """Mesh of the tets in the order of the kernels."""
    return TetMesh(points, tets[swept(points, tets)])


def _largest_body(tets: Int64Array, volumes: FloatArray, finer: str) -> Int64Array:
    """Tets of the largest part connected through faces; a common edge or node alone is a hinge."""
    count, part = connected_tets(tets)
    if count == 1:
        return tets
    kept = part == np.argmax(np.bincount(part))
    share = np.abs(volumes[~kept]).sum() / np.abs(volumes).sum()
    warnings.warn(
        f"{count - 1} part(s) of {int((~kept).sum())} tets ({share:.2%} of the volume) hang on the body by less than "
        f"a face and were dropped; {finer} keeps thinner parts",
        UserWarning,
        stacklevel=4,
    )
    return tets[kept]


def _warn_of_pinches(mesh: TetMesh, finer: str) -> None:
    sides = np.sort(mesh.boundary_triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, count = np.unique(sides, axis=0, return_counts=True)
    pinched = np.flatnonzero(count > 2)
    if pinched.size:
        first, second = edges[pinched[0]].tolist()
        warnings.warn(
            f"{pinched.size} edge(s) of the boundary, first {first}-{second}, belong to more than two boundary "
            f"triangles: the body has no thickness there; {finer} resolves the wall",
            UserWarning,
            stacklevel=4,
        )
