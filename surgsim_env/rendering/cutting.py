"""Cutting meshes by a plane: what is left of a surface, and the section through tets; vertices are mixes of nodes."""

import numpy as np
from scipy.sparse import coo_array, csr_array

from msdm_core.mesh import FloatArray, IntArray, TetMesh
from surgsim_env.rendering.surface import triangle_lattice

# Triangles of a section are split so often that a lesion's outline looks round.
SECTION_SPLITS = 3


def clip_triangles(faces: IntArray, values: FloatArray) -> tuple[csr_array, IntArray]:
    """The part of triangles where a function, linear in each, is negative.

    Args:
        faces: vertices of the triangles                                    (n_face, 3)
        values: of the function at each vertex                              (n_vertex,)

    Returns:
        The mix of old vertices that each new one is (n_new, n_vertex), and the new triangles, which turn as the old.
    """
    inside = values[faces] < 0.0
    count = inside.sum(axis=1)
    whole = faces[count == 3]
    # Turned so that the one corner inside (or outside) comes first.
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
    inside = values[mesh.tets] < 0.0
    count = inside.sum(axis=1)
    lone = np.where((count == 1)[:, None], inside, ~inside)
    single, double = (count == 1) | (count == 3), count == 2
    ordered = np.take_along_axis(mesh.tets, np.argsort(~lone, axis=1, kind="stable"), axis=1)
    tri, quad = ordered[single], ordered[double]
    pairs = np.concatenate(
        [tri[:, [0, 1, 0, 2, 0, 3]].reshape(-1, 2), quad[:, [0, 2, 0, 3, 1, 3, 1, 2]].reshape(-1, 2)]
    )
    mix = _with_cut_points(pairs, values)
    first = len(values) + np.arange(len(tri))[:, None] * 3 + np.arange(3)
    corner = len(values) + 3 * len(tri) + np.arange(len(quad))[:, None] * 4 + np.arange(4)
    faces = np.concatenate([first, corner[:, [0, 1, 2]], corner[:, [0, 2, 3]]])
    position = (mix @ mesh.points)[faces]
    normal = np.cross(position[:, 1] - position[:, 0], position[:, 2] - position[:, 0])
    uphill = _gradient(mesh.points, values)
    faces[normal @ uphill < 0.0] = faces[normal @ uphill < 0.0][:, [0, 2, 1]]
    return _split(*_without_unused(mix, faces))


def most_tets_cut(mesh: TetMesh, direction: FloatArray) -> int:
    """How many tets any plane across a direction cuts at most."""
    height = (mesh.points @ direction)[mesh.tets]
    lower, upper = np.sort(height.min(axis=1)), np.sort(height.max(axis=1))
    begun = np.arange(1, len(lower) + 1)
    return int((begun - np.searchsorted(upper, lower)).max())


def _gradient(points: FloatArray, values: FloatArray) -> FloatArray:
    """The gradient of a linear function given at points, shape (3,)."""
    centred = points - points.mean(axis=0)
    return np.linalg.lstsq(centred, values - values.mean(), rcond=None)[0]


def _turned(faces: IntArray, marked: np.ndarray) -> IntArray:
    """Triangles turned so that their one marked corner comes first."""
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
