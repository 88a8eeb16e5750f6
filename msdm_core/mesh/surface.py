"""Closed triangle surfaces: validity, normals, crossings with straight lines, subdivision."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.arithmetic import cos, matmul, norm
from msdm_core.errors import MeshError
from msdm_core.kernels.ray_kernels import pierces
from msdm_core.mesh.tet_mesh import (
    FloatArray,
    Int64Array,
    area_vectors,
    check_finite,
    check_indices,
    connected_parts,
    part_sizes,
)

# Smallest height of a triangle, as a share of its longest edge: a lower one has no direction.
DEGENERATE_HEIGHT_RATIO = 1e-9

# Shift of the vertices, as a share of the surface's size, for the test of self-crossing: coplanar and touching
# triangles then either cross or do not, and no determinant is zero.
CROSSING_SHIFT = 1e-11


def surface_volume(vertices: ArrayLike, triangles: ArrayLike) -> float:
    """Enclosed volume, V = sum of a . (b x c) / 6 over the triangles [m^3], positive where normals point outward."""
    points = np.asarray(vertices, dtype=np.float64)
    a, b, c = (points[corner] - points.mean(axis=0) for corner in np.asarray(triangles).T)
    return float((a * np.cross(b, c)).sum() / 6)


def triangles_facing(
    vertices: ArrayLike, triangles: ArrayLike, direction: ArrayLike, angle_deg: float
) -> NDArray[np.bool_]:
    """True for triangles with an inward normal within an angle of a direction, shape (n_triangle,).

    Args:
        vertices: of a closed surface [m], shape (n_vertex, 3).
        triangles: vertex indices, shape (n_triangle, 3); turned outward where needed (see `check_surface`).
        direction: any length above zero, shape (3,).
        angle_deg: [degrees].
    """
    return outward_facing(*check_surface(vertices, triangles), direction, angle_deg)


def outward_facing(
    points: FloatArray, triangles: NDArray[np.integer], direction: ArrayLike, angle_deg: float
) -> NDArray[np.bool_]:
    """`triangles_facing` for triangles in outward order."""
    normal = area_vectors(points[triangles])
    along = np.asarray(direction, dtype=np.float64)
    cosine = -matmul(normal, along) / (norm(normal, axis=1) * norm(along))
    return cosine >= cos(np.radians(angle_deg))


def node_normals(points: FloatArray, triangles: NDArray[np.integer]) -> FloatArray:
    """Unit outward normal at each node, the area-weighted mean of its triangles', 0 without any, shape (n_node, 3).

    Args:
        points: nodes [m], shape (n_node, 3).
        triangles: corners in outward order, shape (n_triangle, 3).
    """
    area_vector = area_vectors(points[triangles])
    normals = np.zeros_like(points)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], area_vector)
    length = norm(normals, axis=1)
    normals[length > 0.0] /= length[length > 0.0, None]
    return normals


def merge_vertices(vertices: ArrayLike, triangles: ArrayLike) -> tuple[FloatArray, Int64Array]:
    """Merge exactly coinciding vertices (an STL file shares none) and drop the unused ones."""
    points, corners = np.asarray(vertices, dtype=np.float64), np.asarray(triangles)
    _, first, same = np.unique(points, axis=0, return_index=True, return_inverse=True)
    kept = first[same.ravel()][corners]
    used, renumbered = np.unique(kept, return_inverse=True)
    return points[used], renumbered.reshape(-1, 3).astype(np.int64)


def check_surface(vertices: ArrayLike, triangles: ArrayLike) -> tuple[FloatArray, Int64Array]:
    """The surface of a single body, with merged vertices and outward normals.

    Args:
        vertices: [m], shape (n_vertex, 3).
        triangles: vertex indices, shape (n_triangle, 3).

    Raises:
        MeshError: a surface that encloses no single body: names the first vertex, triangle or edge (in merged
            numbering, with its place [m]) that is not finite, out of range, degenerate, open, shared by more than two
            triangles or self-crossing, or the sizes of several bodies.
    """
    points, corners = merge_vertices(*_checked_arrays(vertices, triangles))
    _check_shape(points, corners)
    left, right, opposed = _paired_sides(points, corners)
    _check_one_body(left, right, len(corners))
    corners = _oriented(corners, left, right, opposed)
    if surface_volume(points, corners) < 0:
        corners = corners[:, ::-1].copy()
    _check_no_crossing(points, corners)
    return points, corners


def _checked_arrays(vertices: ArrayLike, triangles: ArrayLike) -> tuple[FloatArray, Int64Array]:
    points, corners = np.asarray(vertices, dtype=np.float64), np.asarray(triangles)
    if corners.size == 0:
        raise MeshError("the surface has no triangles; a body needs a closed surface: read or make one first")
    check_finite(points, "vertex")
    check_indices(corners, len(points), "triangle", "vertices")
    return points, corners.astype(np.int64)


def _check_shape(points: FloatArray, corners: Int64Array) -> None:
    a, b, c = (points[corner] for corner in corners.T)
    longest = np.max([np.square(p - q).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    area = norm(area_vectors(points[corners]), axis=1)
    flat = np.flatnonzero(2.0 * area <= DEGENERATE_HEIGHT_RATIO * longest)
    if flat.size:
        triangle = int(flat[0])
        raise MeshError(
            f"triangle {triangle} (of {flat.size}) at {_place(a[triangle])} is degenerate: area "
            f"{area[triangle]:.2g} m^2, the rule is a height above {DEGENERATE_HEIGHT_RATIO:g} of the "
            "longest edge: remove it, or merge its corners"
        )


def _paired_sides(points: FloatArray, corners: Int64Array) -> tuple[Int64Array, Int64Array, NDArray[np.bool_]]:
    """The two triangles at each edge, and True where they run along it in opposite directions, shape (n_edge,) each."""
    sides = corners[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    low, high = sides.min(axis=1), sides.max(axis=1)
    edges, edge_of_side, count = np.unique(low * len(points) + high, return_inverse=True, return_counts=True)
    for wrong, problem, way_out in (
        (np.flatnonzero(count == 1), "belongs to one triangle only: the surface is open", "close the hole"),
        (np.flatnonzero(count > 2), "is shared by more than two triangles: not a manifold", "separate the sheets"),
    ):
        if wrong.size:
            p, q = divmod(int(edges[wrong[0]]), len(points))
            raise MeshError(
                f"edge {p}-{q} (of {wrong.size} such edges) at {_place(points[p])} {problem}; "
                f"every edge must belong to exactly two triangles: {way_out} (in a mesh editor) and try again"
            )
    order = np.argsort(edge_of_side.ravel(), kind="stable").reshape(-1, 2)
    opposed = sides[order[:, 0], 0] != sides[order[:, 1], 0]
    return order[:, 0] // 3, order[:, 1] // 3, opposed


def _check_one_body(left: Int64Array, right: Int64Array, triangle_count: int) -> None:
    count, part = connected_parts(left, right, triangle_count)
    if count > 1:
        raise MeshError(
            f"the surface falls into {count} bodies (or a body and its cavities) of {part_sizes(part)} triangles; "
            "an organ is one body: keep the largest, or mesh each alone"
        )


def _oriented(corners: Int64Array, left: Int64Array, right: Int64Array, opposed: NDArray[np.bool_]) -> Int64Array:
    """Triangles of one orientation, by parts of the double cover: each triangle once in either orientation."""
    n = len(corners)
    across = np.where(opposed, 0, n)
    _, part = connected_parts(
        np.concatenate([left, left + n]), np.concatenate([right + across, right + n - across]), 2 * n
    )
    if part[0] == part[n]:
        raise MeshError(
            "the surface has one side only (like a Klein bottle), so it cannot be oriented; "
            "a body needs an inside: repair the surface in a mesh editor"
        )
    turned = part[:n] != part[0]
    return np.where(turned[:, None], corners[:, ::-1], corners)


def _check_no_crossing(points: FloatArray, corners: Int64Array) -> None:
    size = np.ptp(points, axis=0).max()
    # Fixed seed, same answer every time. A shift that is linear in the index would keep regular tiles coplanar.
    shift = CROSSING_SHIFT * (np.random.default_rng(0).random(points.shape) - 0.5)
    shifted = (points - points.mean(axis=0)) / size + shift
    first, second = _near_pairs(shifted, corners)
    crossing = np.zeros(len(first), dtype=bool)
    for piercing, pierced in ((first, second), (second, first)):
        for side in ([0, 1], [1, 2], [2, 0]):
            crossing |= _pierces(shifted, corners[piercing][:, side], corners[pierced])
    if crossing.any():
        pair = np.argmax(crossing)
        raise MeshError(
            f"triangles {first[pair]} and {second[pair]} (of {crossing.sum()} pairs) cross each other near "
            f"{_place(points[corners[first[pair]]].mean(axis=0))}; a surface must not cross itself: "
            "repair it in a mesh editor, for instance by a boolean union"
        )


def _near_pairs(points: FloatArray, corners: Int64Array) -> tuple[Int64Array, Int64Array]:
    """Pairs of triangles with overlapping bounding boxes, from grids with cells doubled from level to level."""
    low, high = points[corners].min(axis=1), points[corners].max(axis=1)
    extent = (high - low).max(axis=1)
    mantissa, exponent = np.frexp(extent / np.median(extent))
    level = np.maximum(exponent - (mantissa == 0.5), 0)
    pairs = []
    for coarse in np.unique(level):
        cell = np.ldexp(np.median(extent), coarse)
        members = np.flatnonzero(level == coarse)
        # Each box is at most one cell wide here, so it touches at most two cells along each axis.
        key, owner = _cells_of(low[members], high[members], members, cell)
        order = np.argsort(key, kind="stable")
        key, owner = key[order], owner[order]
        seekers = np.flatnonzero(level <= coarse)
        seek_key, seeker = _cells_of(low[seekers], high[seekers], seekers, cell)
        start, stop = np.searchsorted(key, seek_key, "left"), np.searchsorted(key, seek_key, "right")
        a, b = np.repeat(seeker, stop - start), owner[_ranges(start, stop)]
        keep = (level[a] < coarse) | (a < b)
        a, b = a[keep], b[keep]
        keep = ((low[a] <= high[b]) & (low[b] <= high[a])).all(axis=1)
        pairs.append(np.minimum(a[keep], b[keep]) * len(corners) + np.maximum(a[keep], b[keep]))
    unique = np.unique(np.concatenate(pairs))
    return unique // len(corners), unique % len(corners)


def _cells_of(low: FloatArray, high: FloatArray, items: Int64Array, cell: float) -> tuple[Int64Array, Int64Array]:
    """Numbers of the grid cells touched by boxes up to one cell wide, and the item of each."""
    span = int(2.2 / cell) + 4  # points lie in -1..1
    first, last = np.floor(low / cell).astype(np.int64), np.floor(high / cell).astype(np.int64)
    keys, owners = [], []
    for corner in np.ndindex(2, 2, 2):
        touched = (first + corner <= last).all(axis=1)
        index = (first + corner)[touched] + span // 2
        keys.append((index[:, 0] * span + index[:, 1]) * span + index[:, 2])
        owners.append(items[touched])
    return np.concatenate(keys), np.concatenate(owners)


def _ranges(start: Int64Array, stop: Int64Array) -> Int64Array:
    """Whole numbers of all ranges start..stop - 1, range after range."""
    count = stop - start
    return np.arange(count.sum()) + np.repeat(start - np.concatenate([[0], np.cumsum(count)[:-1]]), count)


def _pierces(points: FloatArray, segment: Int64Array, triangle: Int64Array) -> NDArray[np.bool_]:
    """True for segments through triangles with which they share no vertex, shape (n,)."""
    result = np.zeros(len(segment), dtype=bool)
    apart = np.flatnonzero((segment[:, :, None] != triangle[:, None, :]).all(axis=(1, 2)))
    start, end = (points[corner] for corner in segment[apart].T)
    pierced = np.zeros(len(apart), dtype=bool)
    pierces(start, end - start, points[triangle[apart]], pierced)
    result[apart] = pierced
    return result


def _place(point: FloatArray) -> str:
    return "(" + ", ".join(f"{x:.6g}" for x in point) + ") m"


def line_hits(
    u: FloatArray, v: FloatArray, w: FloatArray, triangles: Int64Array, offset: int
) -> tuple[Int64Array, Int64Array, FloatArray]:
    """Crossings of the lines u = offset + 2 i, v = offset + 2 j (i, j whole) with triangles: u, v and w of each.

    A line's side of an edge is computed from the edge's lower vertex, so the triangles at an edge agree and no line
    slips between them or hits both.

    Args:
        u: first coordinate of the vertices across the lines, in units of half the line spacing, shape (n_vertex,).
        v: second coordinate across the lines, same unit and shape.
        w: coordinate along the lines, any unit, shape (n_vertex,).
        triangles: shape (n_triangle, 3).
        offset: 0 or 1.
    """
    triangle, line_u, line_v = _lines_over_triangles(u, v, triangles, offset)
    corners = triangles[triangle]
    weights = np.empty((len(triangle), 3))
    left_of = np.empty((len(triangle), 3), dtype=bool)
    for corner in range(3):
        start, end = corners[:, (corner + 1) % 3], corners[:, (corner + 2) % 3]
        low, high = np.minimum(start, end), np.maximum(start, end)
        turn = (u[high] - u[low]) * (line_v - v[low]) - (v[high] - v[low]) * (line_u - u[low])
        weights[:, corner] = np.where(start < end, turn, -turn)
        left_of[:, corner] = (turn >= 0) == (start < end)
    hit = (left_of == left_of[:, :1]).all(axis=1)
    corner_w = w[corners[hit]]
    at = (weights[hit] * corner_w).sum(axis=1) / weights[hit].sum(axis=1)
    return line_u[hit], line_v[hit], np.clip(at, corner_w.min(axis=1), corner_w.max(axis=1))


def _lines_over_triangles(
    u: FloatArray, v: FloatArray, triangles: Int64Array, offset: int
) -> tuple[Int64Array, Int64Array, Int64Array]:
    """Triangle, u and v of each line through a triangle's bounding rectangle."""
    first_u, first_v = (np.ceil((x[triangles].min(axis=1) - offset) / 2).astype(np.int64) for x in (u, v))
    last_u, last_v = (np.floor((x[triangles].max(axis=1) - offset) / 2).astype(np.int64) for x in (u, v))
    wide, high = (last_u - first_u + 1).clip(min=0), (last_v - first_v + 1).clip(min=0)
    count = wide * high
    triangle = np.repeat(np.arange(len(triangles)), count)
    place = _ranges(np.zeros_like(count), count)
    line_u = first_u[triangle] + place % wide[triangle]
    line_v = first_v[triangle] + place // wide[triangle]
    return triangle, 2 * line_u + offset, 2 * line_v + offset


def triangle_lattice(splits: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Subdivision of a triangle with each edge in `splits` parts.

    Returns:
        Lattice points as barycentric weights, three counts of sum `splits` (n_point, 3), and the small triangles
        between them, in the order of the large one's corners (splits^2, 3).
    """
    index: dict[tuple[int, int], int] = {}
    for i in range(splits + 1):
        for j in range(splits + 1 - i):
            index[i, j] = len(index)
    small = []
    for i in range(splits):
        for j in range(splits - i):
            small.append((index[i, j], index[i + 1, j], index[i, j + 1]))
            if i + j + 1 < splits:
                small.append((index[i + 1, j], index[i + 1, j + 1], index[i, j + 1]))
    points = [(splits - i - j, i, j) for i, j in index]
    return np.array(points, dtype=np.int32), np.array(small, dtype=np.int32)
