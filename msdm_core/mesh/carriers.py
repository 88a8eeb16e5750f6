"""What carries points near the boundary of a body of tets: the nearest point of the boundary, and gradients there."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from msdm_core.arithmetic import dot, norm, solve
from msdm_core.errors import MeshError
from msdm_core.mesh.geodesic import nearest_weights
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, TetMesh

# A point is carried to this share of the tets' longest edges at its nearest point of the boundary.
REACH = 0.75
# A vertex that was within its reach still is when a file has rounded its coordinates to single precision.
ROUNDING = 1e-3
# Triangles of a size that are tried first near a point, and points that are tried at once.
NEAR_FIRST, POINTS_AT_ONCE = 8, 4096


@dataclass(frozen=True, eq=False)
class Carriers:
    """For each of some points the nearest point of a mesh's boundary.

    Fields:
        triangle: the boundary triangle                                             (n_point,)
        weights: of its corners at the nearest point, none below 0                  (n_point, 3)
        nearest: that point [m]                                                     (n_point, 3)
        distance: from it [m]                                                       (n_point,)
        reach: largest distance at which a point is carried there [m]               (n_point,)
    """

    triangle: IntArray
    weights: FloatArray
    nearest: FloatArray
    distance: FloatArray
    reach: FloatArray

    @property
    def beyond(self) -> NDArray[np.bool_]:
        """Which points are too far from the boundary to be carried, (n_point,)."""
        return self.distance > self.reach


def find_carriers(points: FloatArray, mesh: TetMesh) -> Carriers:
    """What carries points [m] (n_point, 3) near the boundary of a mesh."""
    corners = mesh.points[mesh.boundary_triangles]
    triangle, weights = _nearest_triangles(points, corners)
    nearest = (weights[:, :, None] * corners[triangle]).sum(axis=1)
    # Interpolated between nodes: where triangles share the nearest point, rounding decides which of them is found, and
    # the reach must not depend on it.
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
    """What carries the vertices [m] (n_vertex, 3) of a finer surface of a mesh.

    Raises:
        MeshError: a vertex farther from the mesh's boundary than REACH allows; names it.
    """
    found = find_carriers(vertices, mesh)
    far = np.flatnonzero(found.distance > (1.0 + ROUNDING) * found.reach)
    if far.size:
        worst = far[np.argmax(found.distance[far] / found.reach[far])]
        x, y, z = vertices[worst] * 1e3
        raise MeshError(
            f"vertex {worst} of the fine surface, at {x:.1f}, {y:.1f}, {z:.1f} mm, is "
            f"{found.distance[worst] * 1e3:.3g} mm from the boundary of the tets; the rule is at most "
            f"{found.reach[worst] * 1e3:.3g} mm there, {REACH:g} of the tets' longest edges ({len(far)} of "
            f"{len(vertices)} vertices break it): is it the surface of this organ, in the same axes and unit?"
        )
    return found


def node_gradients(mesh: TetMesh, nodes: IntArray) -> csr_array:
    """Gradients at nodes (n,) of functions given at all nodes: the mean over the tets around each, by volume.

    Exact where the function is linear. In a tet with corners x_a and volume V the gradient of corner a's function is
    the area vector of the face opposite over 3 V (Zienkiewicz and Taylor, The Finite Element Method, linear tets).

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
    """The triangle nearest to each point, and weights of its corners at its nearest point."""
    from scipy.spatial import KDTree

    triangle, weights = np.zeros(len(points), dtype=np.int32), np.zeros((len(points), 3))
    gap = np.full(len(points), np.inf)
    centre = corners.mean(axis=1)
    radius = norm(corners - centre[:, None], axis=2).max(axis=1)
    # Triangles of about one size, the small ones first: those of a graded mesh differ by a factor of 4.
    _, size = np.frexp(np.square(radius / radius.min()))
    for one in np.unique(size):
        some = np.flatnonzero(size == one)
        tree, reach, count = KDTree(centre[some]), float(radius[some].max()), min(NEAR_FIRST, len(some))
        sought = np.arange(len(points))
        while len(sought):
            left = []
            for first in range(0, len(sought), POINTS_AT_ONCE):
                now = sought[first : first + POINTS_AT_ONCE]
                away, near = (np.reshape(one, (-1, count)) for one in tree.query(points[now], k=count))
                # A triangle is nearer than its centre by its radius at most.
                useful = away - reach < gap[now, None]
                row, column = np.nonzero(useful)
                tried = some[near[row, column]]
                mixed = nearest_weights(corners[tried], points[now[row]])
                found = np.full(away.shape, np.inf)
                found[useful] = norm((mixed[:, :, None] * corners[tried]).sum(axis=1) - points[now[row]], axis=1)
                best = found.argmin(axis=1)
                nearer = np.flatnonzero(found[np.arange(len(now)), best] < gap[now])
                place = (np.cumsum(useful).reshape(useful.shape) - 1)[nearer, best[nearer]]
                gap[now[nearer]] = found[nearer, best[nearer]]
                triangle[now[nearer]], weights[now[nearer]] = tried[place], mixed[place]
                left.append(now[away[:, -1] - reach < gap[now]])
            if count == len(some):
                break
            sought, count = np.concatenate(left), min(4 * count, len(some))
    return triangle, weights
