"""Distances along a surface (shortest paths on a graph of vertices and points on edges) and nearest triangles."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from msdm_core.arithmetic import matmul, norm
from msdm_core.mesh.tet_mesh import FloatArray, IntArray

# Points on each edge between its ends. Paths between them are 2 % longer than the true geodesic over several triangles,
# and off by up to the gap of two points (an eighth of an edge) over less than one.
POINTS_PER_EDGE = 7
# Points with distances to all triangles in memory: 10 MB for a surface of 10 000 triangles.
QUERIES_AT_ONCE = 64


class SurfaceDistance:
    """Distances along a triangle surface (Lanthier et al. 2001: Steiner points on edges, Dijkstra's algorithm).

    Args:
        points: vertex positions [m], shape (n_point, 3).
        triangles: vertex indices, shape (n_triangle, 3).
    """

    def __init__(self, points: FloatArray, triangles: IntArray) -> None:
        used, local = np.unique(triangles, return_inverse=True)
        local_triangles = local.reshape(-1, 3)
        vertices = points[used]
        sides = np.stack([local_triangles, local_triangles[:, [1, 2, 0]]], axis=2).reshape(-1, 2)
        edges, side_edge = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
        share = (np.arange(POINTS_PER_EDGE) + 1.0) / (POINTS_PER_EDGE + 1.0)
        between = vertices[edges[:, 0], None] * (1.0 - share[:, None]) + vertices[edges[:, 1], None] * share[:, None]
        on_edge = len(vertices) + side_edge[:, None] * POINTS_PER_EDGE + np.arange(POINTS_PER_EDGE)
        self._nearest = NearestTriangle(vertices[local_triangles])
        self._positions = np.concatenate([vertices, between.reshape(-1, 3)])
        # The graph nodes on the border of each triangle, (n_triangle, 3 + 3 * POINTS_PER_EDGE).
        self._members = np.concatenate([local_triangles, on_edge.reshape(len(local_triangles), -1)], axis=1)
        first, second = np.triu_indices(self._members.shape[1], k=1)
        pairs = np.unique(
            np.sort(np.stack([self._members[:, first], self._members[:, second]], axis=2).reshape(-1, 2), axis=1),
            axis=0,
        )
        self._rows, self._columns = pairs[:, 0], pairs[:, 1]
        self._lengths = norm(self._positions[self._rows] - self._positions[self._columns], axis=1)

    def __call__(self, source: ArrayLike, targets: ArrayLike) -> FloatArray:
        """Distance along the surface from a point (3,) to points (n, 3) [m], each first dropped onto the surface.

        Infinite without a path (another body).
        """
        queries = np.concatenate([np.reshape(source, (1, 3)), np.reshape(targets, (-1, 3))]).astype(np.float64)
        located = [self._nearest(query) for query in queries]
        dropped = np.array([matmul(weights, self._nearest.corners[triangle]) for triangle, weights in located])
        node_count = len(self._positions)
        rows, columns, lengths = [self._rows], [self._columns], [self._lengths]
        for index, (triangle, _) in enumerate(located):
            members = self._members[triangle]
            rows.append(np.full(len(members), node_count + index))
            columns.append(members)
            # A vanishing length would drop the edge from a sparse graph.
            lengths.append(np.maximum(norm(self._positions[members] - dropped[index], axis=1), 1e-15))
        graph = coo_array(
            (np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))),
            shape=(node_count + len(queries),) * 2,
        )
        distance = dijkstra(graph.tocsr(), directed=False, indices=node_count)[node_count + 1 :]
        same = np.array([triangle == located[0][0] for triangle, _ in located[1:]], dtype=bool)
        straight = norm(dropped[1:] - dropped[0], axis=1)
        return np.where(same, straight, distance)


def nearest_weights(corners: FloatArray, query: FloatArray) -> FloatArray:
    """Barycentric weights of the point of each triangle nearest to a query point [m], shape (n_triangle, 3).

    Args:
        corners: triangle corners [m], shape (n_triangle, 3, 3).
        query: a point [m] for all, shape (3,), or a point for each triangle, shape (n_triangle, 3).
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac, ap = b - a, c - a, query - a
    d00, d01, d11 = (ab * ab).sum(1), (ab * ac).sum(1), (ac * ac).sum(1)
    d20, d21 = (ap * ab).sum(1), (ap * ac).sum(1)
    determinant = d00 * d11 - d01 * d01
    wb = (d11 * d20 - d01 * d21) / determinant
    wc = (d00 * d21 - d01 * d20) / determinant
    weights = np.column_stack([1.0 - wb - wc, wb, wc])
    # If the foot of the perpendicular misses the triangle, the nearest point lies on an edge.
    outside = (weights < 0.0).any(axis=1)
    smallest = np.full(len(corners), np.inf)
    for first, second in ((0, 1), (1, 2), (2, 0)):
        span = corners[:, second] - corners[:, first]
        along = np.clip(((query - corners[:, first]) * span).sum(1) / (span * span).sum(1), 0.0, 1.0)
        squared = np.square(corners[:, first] + along[:, None] * span - query).sum(axis=1)
        better = outside & (squared < smallest)
        smallest[better] = squared[better]
        weights[better] = 0.0
        weights[better, first] = 1.0 - along[better]
        weights[better, second] = along[better]
    return weights


class NearestTriangle:
    """Search for the triangle nearest to a point; balls around the triangles exclude most of them.

    Args:
        corners: triangle corners [m], shape (n_triangle, 3, 3).
    """

    def __init__(self, corners: FloatArray) -> None:
        self.corners = corners
        self._centre = corners.mean(axis=1)
        reach = norm(corners - self._centre[:, None], axis=2).max(axis=1)
        # Rounding must not exclude the nearest.
        self._radius = reach * (1.0 + 1e-9)

    def __call__(self, query: FloatArray) -> tuple[int, FloatArray]:
        """Index of the triangle nearest to a query point (3,) [m], and weights (3,) of its corners there."""
        away = norm(self._centre - query, axis=1)
        # Distances that are not finite exclude nothing.
        near = np.flatnonzero(~(away - self._radius > away.min() * (1.0 + 1e-9)))
        corners = self.corners[near]
        weights = nearest_weights(corners, query)
        points = (weights[:, :, None] * corners).sum(axis=1)
        best = int(np.argmin(np.square(points - query).sum(axis=1)))
        return int(near[best]), weights[best]

    def distances(self, queries: FloatArray) -> FloatArray:
        """Distance from points (n, 3) to their nearest triangles [m], shape (n,)."""
        distances = np.zeros(len(queries))
        for start in range(0, len(queries), QUERIES_AT_ONCE):
            batch = queries[start : start + QUERIES_AT_ONCE]
            away = norm(batch[:, None] - self._centre, axis=2)
            query, near = np.nonzero(~(away - self._radius > away.min(axis=1, keepdims=True) * (1.0 + 1e-9)))
            corners = self.corners[near]
            weights = nearest_weights(corners, batch[query])
            gap = norm((weights[:, :, None] * corners).sum(axis=1) - batch[query], axis=1)
            # Each point has at least one triangle, and they are sorted by points.
            first = np.searchsorted(query, np.arange(len(batch)))
            distances[start : start + QUERIES_AT_ONCE] = np.minimum.reduceat(gap, first)
        return distances
