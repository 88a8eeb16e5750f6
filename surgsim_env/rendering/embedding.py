"""Fine surface carried by a tet mesh: each vertex is a fixed linear combination of nodes, computed at rest."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, hstack

from msdm_core.mesh.carriers import node_gradients, surface_carriers
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, TetMesh
from surgsim_env.rendering.surface import TRIANGLES_MOST, DrawnSurface, drawn_surface
from surgsim_env.scene.anatomy import Anatomy


@dataclass(frozen=True, eq=False)
class EmbeddedSurface:
    """Surface carried by the boundary of a mesh; the other kind of drawn surface is `DrawnSurface`.

    With p a vertex at rest, q the nearest point of the boundary, b the weights there of its triangle's corners X, and
    F the deformation gradient at each corner (the mean of the tets around it), the vertex is drawn at
    sum_i b_i (x_i + F_i ((p - q) + (q - X_i) / 2)). This is exact where the motion is linear; the halved term, which
    then vanishes, makes it exact also for a quadratic one along the boundary, so that a dent is smooth.

    Fields:
        gradients: of functions of the nodes at the boundary nodes          (3 n_boundary_node, n_node)
        weights: of the nodes, then of these gradients, at each vertex      (n_vertex, n_node + 3 n_boundary_node)
        node_weights: of the nodes at each vertex's nearest point           (n_vertex, n_node)
        corners: vertices of the triangles, outward                         (3, n_face)
        vertex_faces: sums the area vectors of the triangles at each vertex (n_vertex, n_face)
        node_count: n_node                                                  scalar
    """

    gradients: csr_array
    weights: csr_array
    node_weights: csr_array
    corners: IntArray
    vertex_faces: csr_array
    node_count: int

    @property
    def faces(self) -> IntArray:
        """Vertices of the triangles, outward, shape (n_face, 3)."""
        return self.corners.T

    @property
    def vertex_count(self) -> int:
        """Number of drawn vertices."""
        return len(self.weights.indptr) - 1

    def follow(self, node_position: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions [m] and unit outward normals of the vertices, each (n_vertex, 3), for nodes [m] (n_node, 3)."""
        vertices = self.weights @ np.concatenate([node_position, self.gradients @ node_position])
        first, second, third = (np.take(vertices, corner, axis=0) for corner in self.corners)
        normals = self.vertex_faces @ _cross(second - first, third - first)
        length = np.sqrt(np.einsum("vi,vi->v", normals, normals))
        normals /= np.maximum(length, 1e-300)[:, None]
        return vertices, normals

    def interpolate(self, values: FloatArray) -> FloatArray:
        """Values at the vertices' nearest boundary points (n_vertex,) of those at the nodes (n_node,)."""
        return self.node_weights @ values

    def faces_among(self, nodes: IntArray) -> NDArray[np.bool_]:
        """True for triangles on a part of the boundary with all its nodes among `nodes`, shape (n_face,)."""
        among = np.zeros(self.node_count)
        among[nodes] = 1.0
        return np.asarray((self.interpolate(among) > 1.0 - 1e-9)[self.faces].all(axis=1))


def embedded_surface(vertices: FloatArray, faces: IntArray, mesh: TetMesh) -> EmbeddedSurface:
    """Embed a surface in a mesh.

    Args:
        vertices: at rest [m], (n_vertex, 3).
        faces: outward, (n_face, 3).
        mesh: at rest.

    Raises:
        MeshError: a vertex farther from the mesh's boundary than `msdm_core.mesh.carriers.REACH` allows; names it.
    """
    carriers, triangles, nodes = surface_carriers(vertices, mesh), mesh.boundary_triangles, mesh.boundary_nodes
    corners = triangles[carriers.triangle]
    onto = vertices - carriers.nearest
    lever = carriers.weights[:, :, None] * (onto[:, None] + 0.5 * (carriers.nearest[:, None] - mesh.points[corners]))
    node_weights = _rows(corners, carriers.weights, mesh.node_count)
    components = (3 * np.searchsorted(nodes, corners)[:, :, None] + np.arange(3)).reshape(-1, 9)
    levers = _rows(components, lever.reshape(-1, 9), 3 * len(nodes))
    face = np.repeat(np.arange(len(faces)), 3)
    return EmbeddedSurface(
        gradients=node_gradients(mesh, nodes),
        weights=csr_array(hstack([node_weights, levers], format="csr")),
        node_weights=node_weights,
        corners=np.ascontiguousarray(faces.T, dtype=np.int32),
        vertex_faces=csr_array(coo_array((np.ones(faces.size), (faces.ravel(), face)), (len(vertices), len(faces)))),
        node_count=mesh.node_count,
    )


@lru_cache(maxsize=4)
def organ_surface(anatomy: Anatomy, triangles_most: int = TRIANGLES_MOST) -> DrawnSurface | EmbeddedSurface:
    """Drawn surface of an organ: the scene's fine surface, or without one `boundary_surface`.

    Raises:
        MeshError: the fine surface's file cannot be read, or is not of this organ.
    """
    if anatomy.fine_surface is None:
        return boundary_surface(anatomy, triangles_most)
    return embedded_surface(*anatomy.fine_surface, anatomy.mesh)


def boundary_surface(anatomy: Anatomy, triangles_most: int = TRIANGLES_MOST) -> DrawnSurface:
    """Smoothed boundary of an organ's mesh; split into at most `triangles_most` triangles, if the mesh has no more."""
    return drawn_surface(anatomy.mesh.points, anatomy.mesh.boundary_triangles, triangles_most)


def _rows(columns: IntArray, entries: FloatArray, column_count: int) -> csr_array:
    rows = np.repeat(np.arange(len(columns)), columns.shape[1])
    return csr_array(coo_array((entries.ravel(), (rows, columns.ravel())), shape=(len(columns), column_count)))


def _cross(first: FloatArray, second: FloatArray) -> FloatArray:
    # Takes a third of numpy's time.
    product = np.empty_like(first)
    for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        product[:, axis] = first[:, i] * second[:, j] - first[:, j] * second[:, i]
    return product
