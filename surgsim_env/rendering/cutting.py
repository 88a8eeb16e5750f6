"""Meshes cut by a plane: the rest of a surface, and the section through tets; vertices are mixes of nodes."""

import numpy as np
from scipy.sparse import coo_array, csr_array

from msdm_core.mesh.surface import triangle_lattice
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, TetMesh

# Edges of a section's triangles are split into this number of parts, so that a lesion's outline looks round.
SECTION_SPLITS = 3


def clip_triangles(faces: IntArray, values: FloatArray) -> tuple[csr_array, IntArray]:
    """The part of triangles where a function, linear in each, is negative.

    Args:
        faces: vertices of the triangles                                    (n_face, 3)
        values: of the function at each vertex                              (n_vertex,)

    Returns:
        The mix of old vertices that each new one is (n_new, n_vertex), and the new triangles, with the old orientation.
    """
    inside = values[faces] < 0.0
    count = inside.sum(axis=1)
    whole = faces[count == 3]
    # Rotated so that the only corner inside (or outside) comes first.
    one = _turned(faces[count == 1], inside[count == 1])
    two = _turned(faces[count == 2], ~inside[count == 2])
    cut = np.stack([one[:, [0, 1]], one[:, [0, 2]]], axis=1), np.stack([two[:, [0, 1]], two[:, [0, 2]]], axis=1)
    pairs = np.concatenate([part.reshape(-1, 2) for part in cut])
    mix = _with_cut_points(pairs, values)
    first = len(values) + np.arange(len(one)) * 2
    second = len(values) + 2 * len(one) + np.arange(len(two)) * 2
    triangles = [
        whole,
        np.column_stack([one[:, 0], first, first + 1]),
        np.column_stack([second, two[:, 1], two[:, 2]]),
        np.column_stack([second, two[:, 2], second + 1]),
    ]
    return _without_unused(mix, np.concatenate(triangles))


def cut_tets(mesh: TetMesh, values: FloatArray) -> tuple[csr_array, IntArray]:
    """The section of tets by the plane where a linear function of the resting position is 0.

    Args:
        mesh: the tets.
        values: of the function at each node                                (n_node,)

    Returns:
        The mix of nodes that each vertex is (n_vertex, n_node), and the triangles, which face positive values.
    """
    (_, tri), (_, quad) = cut_edges(mesh.tets, values)
    mix = _with_cut_points(np.concatenate([tri.reshape(-1, 2), quad.reshape(-1, 2)]), values)
    first = len(values) + np.arange(len(tri))[:, None] * 3 + np.arange(3)
    corner = len(values) + 3 * len(tri) + np.arange(len(quad))[:, None] * 4 + np.arange(4)
    faces = np.concatenate([first, corner[:, [0, 1, 2]], corner[:, [0, 2, 3]]])
    position = (mix @ mesh.points)[faces]
    normal = np.cross(position[:, 1] - position[:, 0], position[:, 2] - position[:, 0])
    uphill = _gradient(mesh.points, values)
    faces[normal @ uphill < 0.0] = faces[normal @ uphill < 0.0][:, [0, 2, 1]]
    return _split(*_without_unused(mix, faces))


def cut_edges(tets: IntArray, values: FloatArray) -> tuple[tuple[IntArray, IntArray], tuple[IntArray, IntArray]]:
    """The edges of tets on which a function, linear in each tet and given at the nodes (n_node,), is 0.

    Returns:
        The tets where it is 0 in a triangle (n,) and the nodes of the three edges (n, 3, 2); those where it is 0 in a
        quadrangle (m,) and the nodes of the four edges in turn (m, 4, 2). A node at 0 counts as positive.
    """
    inside = values[tets] < 0.0
    count = inside.sum(axis=1)
    lone = np.where((count == 1)[:, None], inside, ~inside)
    ordered = np.take_along_axis(tets, np.argsort(~lone, axis=1, kind="stable"), axis=1)
    single, double = np.flatnonzero((count == 1) | (count == 3)), np.flatnonzero(count == 2)
    tri, quad = ordered[single][:, [[0, 1], [0, 2], [0, 3]]], ordered[double][:, [[0, 2], [0, 3], [1, 3], [1, 2]]]
    return (single.astype(np.int32), tri), (double.astype(np.int32), quad)


def most_tets_cut(mesh: TetMesh, direction: FloatArray) -> int:
    """Largest number of tets that a plane across a direction cuts."""
    height = (mesh.points @ direction)[mesh.tets]
    lower, upper = np.sort(height.min(axis=1)), np.sort(height.max(axis=1))
    begun = np.arange(1, len(lower) + 1)
    return int((begun - np.searchsorted(upper, lower)).max())


def _gradient(points: FloatArray, values: FloatArray) -> FloatArray:
    """The gradient of a linear function given at points, shape (3,)."""
    centred = points - points.mean(axis=0)
    return np.linalg.lstsq(centred, values - values.mean(), rcond=None)[0]


def _turned(faces: IntArray, marked: np.ndarray) -> IntArray:
    """Triangles with their corners rotated so that the only marked one comes first."""
    start = marked.argmax(axis=1)[:, None]
    return np.take_along_axis(faces, (start + np.arange(3)) % 3, axis=1)


def _with_cut_points(pairs: IntArray, values: FloatArray) -> csr_array:
    """All vertices as they are, then the point of each pair's edge where the function is 0."""
    start, end = values[pairs[:, 0]], values[pairs[:, 1]]
    share = start / (start - end)
    old = np.arange(len(values))
    new = len(values) + np.arange(len(pairs))
    rows, columns = np.concatenate([old, new, new]), np.concatenate([old, pairs[:, 0], pairs[:, 1]])
    entries = np.concatenate([np.ones(len(old)), 1.0 - share, share])
    return csr_array(coo_array((entries, (rows, columns)), shape=(len(values) + len(pairs), len(values))))


def _without_unused(mix: csr_array, faces: IntArray) -> tuple[csr_array, IntArray]:
    used, index = np.unique(faces, return_inverse=True)
    return csr_array(mix[used]), index.reshape(-1, 3).astype(np.int32)


def _split(mix: csr_array, faces: IntArray) -> tuple[csr_array, IntArray]:
    """Every triangle in SECTION_SPLITS^2, with vertices of their own."""
    lattice, small = triangle_lattice(SECTION_SPLITS)
    rows = np.repeat(np.arange(len(faces) * len(lattice)), 3)
    columns = np.repeat(faces[:, None, :], len(lattice), axis=1).ravel()
    entries = np.tile(lattice.ravel() / SECTION_SPLITS, len(faces))
    finer = csr_array(coo_array((entries, (rows, columns)), shape=(len(faces) * len(lattice), len(mix.indptr) - 1)))
    triangles = (np.arange(len(faces))[:, None, None] * len(lattice) + small).reshape(-1, 3)
    return csr_array(finer @ mix), triangles.astype(np.int32)
