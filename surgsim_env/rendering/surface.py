"""Drawn surface of an organ: sharp creases, triangles split and bent, smooth normals."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from msdm_core.mesh.surface import triangle_lattice
from msdm_core.mesh.tet_mesh import FloatArray, IntArray

# Angle between resting normals beyond which neighbours meet at a crease, as the faces of a block do [degrees].
CREASE_ANGLE = 50.0
# Each triangle is drawn as splits^2 smaller ones; `splits` is the largest up to SPLITS_MOST within TRIANGLES_MOST.
TRIANGLES_MOST = 15_000
SPLITS_MOST = 4
# Share by which small triangles are bent towards the tangent planes of their corners (Boubekeur & Alexa 2008).
BEND = 0.6
# Largest distance of a vertex from its flat triangle, which the simulation touches [m].
BEND_MOST = 0.0008


@dataclass(frozen=True, eq=False)
class Shape:
    """Shape of a mesh in one picture, in the world's axes.

    Fields:
        vertices: [m]                                                               (n_vertex, 3)
        normals: unit, outward                                                      (n_vertex, 3)
        faces: vertices of the triangles, outward                                   (n_face, 3)
        face_places: places of their corners on a texture; None without one         (n_face, 3)
        shares: places on the scale of a painted field, 0 to 1; None without one    (n_vertex,)
        rest: places of tissue at rest [m]; None of what is no tissue               (n_vertex, 3)
    """

    vertices: FloatArray
    normals: FloatArray
    faces: IntArray
    face_places: IntArray | None = None
    shares: FloatArray | None = None
    rest: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class DrawnSurface:
    """Smoothed triangles over a closed surface; vertices and normals follow the nodes.

    A corner is a node, once for each of the smooth parts of the surface that meet there. With w a vertex's weights of
    corners, x and n their positions and normals, a vertex is drawn at
    p - BEND sum_i w_i n_i n_i . (p - x_i), p = w . x, and within BEND_MOST of p.

    Fields:
        corner_node: node of each corner                                            (n_corner,)
        corner_faces: sums twice the area vectors of triangles at each corner       (n_corner, n_triangle)
        triangles: nodes of the surface's triangles, outward                        (n_triangle, 3)
        weights: of the corners at each vertex                                      (n_vertex, n_corner)
        bend: BEND, but 0 where bending would open a crease                         (n_vertex, 1)
        faces: vertices of the small triangles, outward, `splits`^2 for each triangle in turn   (n_face, 3)
        splits: number of parts of each edge                                        scalar
    """

    corner_node: IntArray
    corner_faces: csr_array
    triangles: IntArray
    weights: csr_array
    bend: FloatArray
    faces: IntArray
    splits: int

    @property
    def vertex_count(self) -> int:
        """Number of drawn vertices."""
        return len(self.bend)

    def follow(self, node_position: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions [m] and unit outward normals of the vertices, each (n_vertex, 3), for nodes [m] (n_node, 3)."""
        points = node_position[self.triangles]
        area_vector = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        corner = node_position[self.corner_node]
        normal = _unit(self.corner_faces @ area_vector)
        flat = self.weights @ corner
        tensor = (normal[:, :, None] * normal[:, None, :]).reshape(-1, 9)
        offset = normal * (corner * normal).sum(axis=1)[:, None]
        mixed = self.weights @ np.concatenate([tensor, offset, normal], axis=1)
        out = self.bend * (np.einsum("vij,vj->vi", mixed[:, :9].reshape(-1, 3, 3), flat) - mixed[:, 9:12])
        out *= np.minimum(1.0, BEND_MOST / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-300))
        return flat - out, _unit(mixed[:, 12:])

    def interpolate(self, values: FloatArray) -> FloatArray:
        """Values at the vertices (n_vertex,) of those at the nodes (n_node,)."""
        return self.weights @ values[self.corner_node]

    def faces_among(self, nodes: IntArray) -> NDArray[np.bool_]:
        """True for small triangles of a triangle with all its nodes among `nodes`, shape (n_face,)."""
        return np.repeat(np.isin(self.triangles, nodes).all(axis=1), self.splits**2)


def drawn_surface(points: FloatArray, triangles: IntArray, triangles_most: int = TRIANGLES_MOST) -> DrawnSurface:
    """Smooth and split a closed surface for drawing.

    Args:
        points: node positions at rest [m], (n_node, 3).
        triangles: outward, (n_triangle, 3).
        triangles_most: largest number of small triangles.
    """
    corner_of, corner_node = _corners(points, triangles)
    splits = max(k for k in range(1, SPLITS_MOST + 1) if k == 1 or len(triangles) * k * k <= triangles_most)
    weights, faces = _split(corner_of, len(corner_node), splits)
    seam = _seam_vertices(corner_of, weights)
    faces_at = (np.ones(corner_of.size), (corner_of.ravel(), np.repeat(np.arange(len(triangles)), 3)))
    return DrawnSurface(
        corner_node=corner_node,
        corner_faces=csr_array(coo_array(faces_at, shape=(len(corner_node), len(triangles)))),
        triangles=triangles,
        weights=weights,
        bend=np.where(seam, 0.0, BEND)[:, None],
        faces=faces,
        splits=splits,
    )


def smooth_normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Unit normals of a surface's vertices, means over its triangles weighted by area, shape (n_vertex, 3)."""
    corners = vertices[faces]
    area_vector = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    at, weight = faces.ravel(), np.repeat(area_vector, 3, axis=0)
    return _unit(np.column_stack([np.bincount(at, weight[:, axis], len(vertices)) for axis in range(3)]))


def _unit(vectors: np.ndarray) -> FloatArray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)


def _corners(points: FloatArray, triangles: IntArray) -> tuple[IntArray, IntArray]:
    """Corners of the triangles (n_triangle, 3) and their nodes (n_corner,); a node on a crease has several corners."""
    position = points[triangles]
    normal = _unit(np.cross(position[:, 1] - position[:, 0], position[:, 2] - position[:, 0]))
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    face = np.repeat(np.arange(len(triangles)), 3)
    start_at = np.arange(triangles.size)
    end_at = start_at.reshape(-1, 3)[:, [1, 2, 0]].ravel()
    # An edge's two half edges are neighbours after sorting by its nodes.
    order = np.lexsort((np.maximum(start, end), np.minimum(start, end))).reshape(-1, 2)
    edge, opposite = order[:, 0], order[:, 1]
    smooth = (normal[face[edge]] * normal[face[opposite]]).sum(axis=1) >= np.cos(np.radians(CREASE_ANGLE))
    edge, opposite = edge[smooth], opposite[smooth]
    rows, columns = (
        np.concatenate([start_at[edge], end_at[edge]]),
        np.concatenate([end_at[opposite], start_at[opposite]]),
    )
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(triangles.size, triangles.size))
    count, corner = connected_components(graph, directed=False)
    corner_node = np.empty(count, dtype=np.int32)
    corner_node[corner] = start
    return corner.astype(np.int32).reshape(-1, 3), corner_node


def _split(corner_of: IntArray, corner_count: int, splits: int) -> tuple[csr_array, IntArray]:
    """Weights of the corners at each vertex, and the small triangles; neighbours share the vertices of their edge."""
    lattice, small = triangle_lattice(splits)
    corners = np.repeat(corner_of[:, None, :], len(lattice), axis=1).reshape(-1, 3)
    counts = np.tile(lattice, (len(corner_of), 1))
    corners = np.where(counts > 0, corners, corner_count)
    order = np.argsort(corners, axis=1, kind="stable")
    key = np.concatenate([np.take_along_axis(corners, order, 1), np.take_along_axis(counts, order, 1)], axis=1)
    unique, index = np.unique(key, axis=0, return_inverse=True)
    row, column = np.repeat(np.arange(len(unique)), 3), unique[:, :3].ravel()
    used = column < corner_count
    entries = (unique[:, 3:].ravel()[used] / splits, (row[used], column[used]))
    faces = index.reshape(len(corner_of), -1)[:, small].reshape(-1, 3)
    return csr_array(coo_array(entries, shape=(len(unique), corner_count))), faces.astype(np.int32)


def _seam_vertices(corner_of: IntArray, weights: csr_array) -> np.ndarray:
    """Vertices inside crease edges, where the two sides have separate corners, as on a block."""
    pairs = np.sort(corner_of[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, uses = np.unique(pairs, axis=0, return_counts=True)
    seams = {tuple(pair) for pair in unique[uses == 1].tolist()}
    starts, columns = weights.indptr, weights.indices
    on_seam = np.zeros(len(starts) - 1, dtype=bool)
    for vertex in np.flatnonzero(np.diff(starts) == 2):
        a, b = columns[starts[vertex]], columns[starts[vertex] + 1]
        on_seam[vertex] = (min(a, b), max(a, b)) in seams
    return on_seam
