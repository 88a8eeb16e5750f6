"""Points near the boundary of a body of tets: their carriers, the nearest points of the boundary; gradients there."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from msdm_core.arithmetic import dot, norm, solve
from msdm_core.errors import MeshError
from msdm_core.mesh.geodesic import nearest_weights
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, TetMesh

# Largest distance of a carried point, as a share of the tets' longest edges at its nearest point of the boundary.
REACH = 0.75
# Tolerance of the reach for coordinates rounded to single precision by a file.
ROUNDING = 1e-3
# Nearest triangles of a size in the first search, and points in a search.
NEAR_FIRST, POINTS_AT_ONCE = 8, 4096


@dataclass(frozen=True, eq=False)
class Carriers:
    """Nearest points of a mesh's boundary.

    Fields:
        triangle: the boundary triangle                                             (n_point,)
        weights: of its corners at the nearest point, none below 0                  (n_point, 3)
        nearest: the nearest point [m]                                              (n_point, 3)
        distance: from it [m]                                                       (n_point,)
        reach: largest distance of a carried point there [m]                        (n_point,)
    """

    triangle: IntArray
    weights: FloatArray
    nearest: FloatArray
    distance: FloatArray
    reach: FloatArray

    @property
    def beyond(self) -> NDArray[np.bool_]:
        """True for points too far from the boundary to be carried, (n_point,)."""
        return self.distance > self.reach


def find_carriers(points: FloatArray, mesh: TetMesh) -> Carriers:
    """Nearest points of a mesh's boundary to points [m] (n_point, 3)."""
    corners = mesh.points[mesh.boundary_triangles]
    triangle, weights = _nearest_triangles(points, corners)
    nearest = (weights[:, :, None] * corners[triangle]).sum(axis=1)
    # Interpolated between nodes: rounding decides between triangles that share the nearest point, and must not change
    # the reach.
    longest = _longest_edges(mesh)[mesh.boundary_triangles[triangle]]
    reach = REACH * dot(weights, longest)
    return Carriers(triangle, weights, nearest, norm(points - nearest, axis=1), reach)


def _longest_edges(mesh: TetMesh) -> FloatArray:
    """Mean over the tets around each node of their longest edges [m], (n_node,)."""
    tets = mesh.points[mesh.tets]
    longest = norm(tets[:, :, None] - tets[:, None], axis=3).max(axis=(1, 2))
    corners = mesh.tets.ravel()
    total = np.bincount(corners, np.repeat(longest, 4), mesh.node_count)
    return total / np.bincount(corners, minlength=mesh.node_count)


def surface_carriers(vertices: FloatArray, mesh: TetMesh) -> Carriers:
    """Carriers of the vertices [m] (n_vertex, 3) of a finer surface of a mesh.

    Raises:
        MeshError: a vertex farther from the mesh's boundary than its reach; names it.
    """
    carriers = find_carriers(vertices, mesh)
    distance, reach = carriers.distance, carriers.reach
    far = np.flatnonzero(distance > (1.0 + ROUNDING) * reach)
    if far.size:
        worst = far[np.argmax(distance[far] / reach[far])]
        x, y, z = vertices[worst] * 1e3
        raise MeshError(
            f"vertex {worst} of the fine surface, at {x:.1f}, {y:.1f}, {z:.1f} mm, is {distance[worst] * 1e3:.3g} mm "
            f"from the boundary of the tets; the rule is at most {reach[worst] * 1e3:.3g} mm there, {REACH:g} of the "
            f"tets' longest edges ({len(far)} of {len(vertices)} vertices break it): is it the surface of this organ, "
            "in the same axes and unit?"
        )
    return carriers


def node_gradients(mesh: TetMesh, nodes: IntArray) -> csr_array:
    """Gradients at nodes (n,) of functions of the nodes: the mean over the tets around each, by volume.

    Exact for linear functions. In a tet with corners x_a and volume V the gradient of corner a's function is the area
    vector of the face opposite over 3 V (Zienkiewicz and Taylor, The Finite Element Method, linear tets).

    Returns:
        The operator [1/m]: rows 3 i to 3 i + 2 give the gradient's components at nodes[i], (3 n, n_node).
    """
    place = np.full(mesh.node_count, -1)
    place[nodes] = np.arange(len(nodes))
    tet, corner = np.nonzero(place[mesh.tets] >= 0)
    x = mesh.points[mesh.tets]
    # Rows of the inverse of the edges are the gradients of the last three corners' functions.
    last = solve(np.swapaxes(x[:, 1:] - x[:, :1], 1, 2), np.broadcast_to(np.eye(3), (len(x), 3, 3)))
    slopes = np.concatenate([-last.sum(axis=1, keepdims=True), last], axis=1)
    at = place[mesh.tets[tet, corner]]
    around = np.bincount(at, mesh.volumes[tet], len(nodes))
    entries = (mesh.volumes[tet] / around[at])[:, None, None] * slopes[tet]
    rows = np.broadcast_to(3 * at[:, None, None] + np.arange(3), entries.shape)
    columns = np.broadcast_to(mesh.tets[tet][:, :, None], entries.shape)
    flat = entries.ravel(), (rows.ravel(), columns.ravel())
    return csr_array(coo_array(flat, shape=(3 * len(nodes), mesh.node_count)))


def _nearest_triangles(points: FloatArray, corners: FloatArray) -> tuple[IntArray, FloatArray]:
    """Triangle nearest to each point, and weights of its corners at its nearest point."""
    from scipy.spatial import KDTree

    triangle, weights = np.zeros(len(points), dtype=np.int32), np.zeros((len(points), 3))
    gap = np.full(len(points), np.inf)
    centre = corners.mean(axis=1)
    radius = norm(corners - centre[:, None], axis=2).max(axis=1)
    # Triangles of about one size, the small ones first: those of a graded mesh differ by a factor of 4.
    _, size = np.frexp(np.square(radius / radius.min()))
    for level in np.unique(size):
        alike = np.flatnonzero(size == level)
        tree, reach, count = KDTree(centre[alike]), float(radius[alike].max()), min(NEAR_FIRST, len(alike))
        open_points = np.arange(len(points))
        while len(open_points):
            left = []
            for first in range(0, len(open_points), POINTS_AT_ONCE):
                batch = open_points[first : first + POINTS_AT_ONCE]
                away, near = (np.reshape(array, (-1, count)) for array in tree.query(points[batch], k=count))
                # A triangle is nearer than its centre by its radius at most.
                useful = away - reach < gap[batch, None]
                row, column = np.nonzero(useful)
                tried = alike[near[row, column]]
                mixed = nearest_weights(corners[tried], points[batch[row]])
                distance = np.full(away.shape, np.inf)
                distance[useful] = norm((mixed[:, :, None] * corners[tried]).sum(axis=1) - points[batch[row]], axis=1)
                best = distance.argmin(axis=1)
                nearer = np.flatnonzero(distance[np.arange(len(batch)), best] < gap[batch])
                place = (np.cumsum(useful).reshape(useful.shape) - 1)[nearer, best[nearer]]
                gap[batch[nearer]] = distance[nearer, best[nearer]]
                triangle[batch[nearer]], weights[batch[nearer]] = tried[place], mixed[place]
                left.append(batch[away[:, -1] - reach < gap[batch]])
            if count == len(alike):
                break
            open_points, count = np.concatenate(left), min(4 * count, len(alike))
    return triangle, weights
