"""Shapes of an organ and its lesions for a picture: drawn surface, cut-away section, moving lesions.

Meshes are cut by a plane at rest; vertices of cuts are linear combinations of nodes, here called a mix.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array

from msdm_core.material.regions import Lesion, lesion_extent
from msdm_core.mesh.surface import triangle_lattice
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, TetMesh
from surgsim_env.rendering.cameras import cut_direction
from surgsim_env.rendering.embedding import EmbeddedSurface
from surgsim_env.rendering.surface import DrawnSurface, Shape, smooth_normals
from surgsim_env.rendering.vessels import texture_places
from surgsim_env.scene.anatomy import Anatomy

# Parts of each edge of a section's triangles, for a round outline of lesions.
SECTION_SPLITS = 3


@dataclass(frozen=True, eq=False)
class LesionBall:
    """Lesion as an ellipsoid: centre [m], half axes [m], and the nodes inside, whose mean displacement moves it."""

    centre: FloatArray
    half_axes: FloatArray
    nodes: IntArray

    def centre_now(self, rest: FloatArray, node_position: FloatArray) -> FloatArray:
        """Centre moved by the mean displacement of the nodes inside [m], shape (3,)."""
        return self.centre + (node_position[self.nodes] - rest[self.nodes]).mean(axis=0)


class Tissue:
    """Shapes of an organ with given lesions as functions of its node positions."""

    def __init__(
        self, anatomy: Anatomy, surface: DrawnSurface | EmbeddedSurface, lesions: Sequence[Lesion], cut_away: bool
    ) -> None:
        # Lesions are drawn as ellipsoids, tagged regions of the mesh too (`msdm_core.material.regions.lesion_extent`).
        self._rest, self._surface = anatomy.mesh.points, surface
        self.lesions = [lesion_ball(anatomy.mesh, lesion) for lesion in lesions]
        held = surface.faces_among(anatomy.anchors)
        self._faces = {"organ": surface.faces[~held], "held": surface.faces[held]}
        self._vertex_rest = surface.follow(self._rest)[0]
        _, places = texture_places(self._vertex_rest, surface.faces)
        self._face_places = {"organ": places[~held], "held": places[held]}
        self._cut = _CutAway(anatomy, surface, self.lesions, self._faces) if cut_away else None

    def shapes(self, node_position: FloatArray) -> dict[str, Shape]:
        """Surface and cut faces by their names in the scene, with the nodes at their positions [m] (n_node, 3)."""
        vertices, normals = self._surface.follow(node_position)
        if self._cut is None:
            places, rest = self._face_places, self._vertex_rest
            return {
                name: Shape(vertices, normals, faces, places[name], rest=rest) for name, faces in self._faces.items()
            }
        return self._cut.surfaces(vertices, normals) | self._cut.sections(node_position)

    def vertex_values(self, node_values: FloatArray) -> dict[str, FloatArray]:
        """Values at the vertices of each of the `shapes` (n_vertex,) of those at the nodes (n_node,)."""
        values = self._surface.interpolate(node_values)
        if self._cut is None:
            return dict.fromkeys(self._faces, values)
        return self._cut.vertex_values(values, node_values)

    def lesion_ellipsoids(self, node_position: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Current centre [m] (3,) and half axes [m] (3,) of each lesion."""
        return [(lesion.centre_now(self._rest, node_position), lesion.half_axes) for lesion in self.lesions]


class _CutAway:
    """Cut through an organ: an upright plane through its first lesion at rest, moving with the nodes."""

    def __init__(
        self,
        anatomy: Anatomy,
        surface: DrawnSurface | EmbeddedSurface,
        lesions: Sequence[LesionBall],
        faces: dict[str, IntArray],
    ) -> None:
        mesh = anatomy.mesh
        through, towards = cut_plane(anatomy, lesions)
        height = (surface.follow(mesh.points)[0] - through) @ towards
        self._surfaces = {name: clip_triangles(part, height) for name, part in faces.items()}
        self._rest = {name: mix @ surface.follow(mesh.points)[0] for name, (mix, _) in self._surfaces.items()}
        mix, section = cut_tets(mesh, (mesh.points - through) @ towards)
        depth = np.full(len(mix.indptr) - 1, 1.0)
        for lesion in lesions:
            place = (mix @ mesh.points - lesion.centre) / lesion.half_axes
            depth = np.minimum(depth, np.linalg.norm(place, axis=1) - 1.0)
        self._sections: dict[str, tuple[csr_array, IntArray]] = {}
        for name, values in (("section", -depth), ("section_lesion", depth)):
            part, part_faces = clip_triangles(section, values)
            self._sections[name] = csr_array(part @ mix), part_faces

    def surfaces(self, vertices: FloatArray, normals: FloatArray) -> dict[str, Shape]:
        """Remaining part of the drawn surface."""
        shapes = {}
        for name, (mix, faces) in self._surfaces.items():
            turned = mix @ normals
            turned /= np.linalg.norm(turned, axis=1, keepdims=True)
            shapes[name] = Shape(mix @ vertices, turned, faces, rest=self._rest[name])
        return shapes

    def vertex_values(self, values: FloatArray, node_values: FloatArray) -> dict[str, FloatArray]:
        """Values at the vertices of both, of those at the drawn surface's vertices and at the nodes."""
        surfaces = {name: mix @ values for name, (mix, _) in self._surfaces.items()}
        return surfaces | {name: mix @ node_values for name, (mix, _) in self._sections.items()}

    def sections(self, node_position: FloatArray) -> dict[str, Shape]:
        """Cut faces of healthy tissue and of lesions."""
        shapes = {}
        for name, (mix, faces) in self._sections.items():
            vertices = mix @ node_position
            shapes[name] = Shape(vertices, smooth_normals(vertices, faces), faces)
        return shapes


def cut_plane(anatomy: Anatomy, lesions: Sequence[LesionBall]) -> tuple[FloatArray, FloatArray]:
    """Point of the cutting plane [m] and its unit normal towards the removed side."""
    face = anatomy.mesh.points[anatomy.face.triangles].mean(axis=(0, 1))
    return (lesions[0].centre if lesions else face), cut_direction(anatomy)


def lesion_ball(mesh: TetMesh, lesion: Lesion) -> LesionBall:
    """Ellipsoid of a lesion of an organ at rest; see `msdm_core.material.regions.lesion_extent`."""
    centre, half_axes = lesion_extent(mesh, lesion)
    distance = np.linalg.norm((mesh.points - centre) / half_axes, axis=1)
    nodes = np.flatnonzero(distance <= max(1.0, float(distance.min())))
    return LesionBall(centre, half_axes, nodes.astype(np.int32))


def clip_triangles(faces: IntArray, values: FloatArray) -> tuple[csr_array, IntArray]:
    """Clip triangles to the part with negative values of a piecewise linear function.

    Args:
        faces: vertices of the triangles                                    (n_face, 3)
        values: of the function at each vertex                              (n_vertex,)

    Returns:
        Mix of old vertices for each new one (n_new, n_vertex), and the new triangles, with the old orientation.
    """
    inside = values[faces] < 0.0
    count = inside.sum(axis=1)
    whole = faces[count == 3]
    # Rotated: the only corner inside (or outside) comes first.
    single = _turned(faces[count == 1], inside[count == 1])
    double = _turned(faces[count == 2], ~inside[count == 2])
    cut = (
        np.stack([single[:, [0, 1]], single[:, [0, 2]]], axis=1),
        np.stack([double[:, [0, 1]], double[:, [0, 2]]], axis=1),
    )
    pairs = np.concatenate([part.reshape(-1, 2) for part in cut])
    mix = _with_cut_points(pairs, values)
    first = len(values) + np.arange(len(single)) * 2
    second = len(values) + 2 * len(single) + np.arange(len(double)) * 2
    triangles = [
        whole,
        np.column_stack([single[:, 0], first, first + 1]),
        np.column_stack([second, double[:, 1], double[:, 2]]),
        np.column_stack([second, double[:, 2], second + 1]),
    ]
    return _without_unused(mix, np.concatenate(triangles))


def cut_tets(mesh: TetMesh, values: FloatArray) -> tuple[csr_array, IntArray]:
    """Section of tets by the zero plane of a linear function of the resting position.

    Args:
        mesh: the tets.
        values: of the function at each node                                (n_node,)

    Returns:
        Mix of nodes for each vertex (n_vertex, n_node), and the triangles, which face positive values.
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
    """Edges of tets crossed by the zero surface of a piecewise linear function, given at the nodes (n_node,).

    Returns:
        Tets cut in a triangle (n,) and the nodes of the three edges (n, 3, 2); tets cut in a quadrangle (m,) and the
        nodes of the four edges in turn (m, 4, 2). A node at 0 counts as positive.
    """
    inside = values[tets] < 0.0
    count = inside.sum(axis=1)
    lone = np.where((count == 1)[:, None], inside, ~inside)
    ordered = np.take_along_axis(tets, np.argsort(~lone, axis=1, kind="stable"), axis=1)
    single, double = np.flatnonzero((count == 1) | (count == 3)), np.flatnonzero(count == 2)
    tri, quad = ordered[single][:, [[0, 1], [0, 2], [0, 3]]], ordered[double][:, [[0, 2], [0, 3], [1, 3], [1, 2]]]
    return (single.astype(np.int32), tri), (double.astype(np.int32), quad)


def most_tets_cut(mesh: TetMesh, direction: FloatArray) -> int:
    """Largest number of tets cut by one plane normal to a direction."""
    height = (mesh.points @ direction)[mesh.tets]
    lower, upper = np.sort(height.min(axis=1)), np.sort(height.max(axis=1))
    begun = np.arange(1, len(lower) + 1)
    return int((begun - np.searchsorted(upper, lower)).max())


def _gradient(points: FloatArray, values: FloatArray) -> FloatArray:
    """Gradient of a linear function given at points, shape (3,)."""
    centred = points - points.mean(axis=0)
    return np.linalg.lstsq(centred, values - values.mean(), rcond=None)[0]


def _turned(faces: IntArray, marked: np.ndarray) -> IntArray:
    """Triangles with their corners rotated: the only marked one comes first."""
    start = marked.argmax(axis=1)[:, None]
    return np.take_along_axis(faces, (start + np.arange(3)) % 3, axis=1)


def _with_cut_points(pairs: IntArray, values: FloatArray) -> csr_array:
    """Mix for all old vertices, then for the zero of the function on each pair's edge."""
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
    """Split each triangle into SECTION_SPLITS^2, with vertices of their own."""
    lattice, small = triangle_lattice(SECTION_SPLITS)
    rows = np.repeat(np.arange(len(faces) * len(lattice)), 3)
    columns = np.repeat(faces[:, None, :], len(lattice), axis=1).ravel()
    entries = np.tile(lattice.ravel() / SECTION_SPLITS, len(faces))
    finer = csr_array(coo_array((entries, (rows, columns)), shape=(len(faces) * len(lattice), len(mix.indptr) - 1)))
    triangles = (np.arange(len(faces))[:, None, None] * len(lattice) + small).reshape(-1, 3)
    return csr_array(finer @ mix), triangles.astype(np.int32)
