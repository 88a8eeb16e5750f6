"""The point of a triangle nearest to a query point, for many triangles at once."""

import numpy as np

from msdm_core.mesh import FloatArray


def nearest_weights(corners: FloatArray, query: FloatArray) -> FloatArray:
    """Barycentric weights of the point of each triangle nearest to a query point (3,) [m], shape (n_triangle, 3).

    Args:
        corners: triangle corners [m], shape (n_triangle, 3, 3).
        query: a point [m], shape (3,).
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac, ap = b - a, c - a, query - a
    d00, d01, d11 = (ab * ab).sum(1), (ab * ac).sum(1), (ac * ac).sum(1)
    d20, d21 = (ap * ab).sum(1), (ap * ac).sum(1)
    determinant = d00 * d11 - d01 * d01
    wb = (d11 * d20 - d01 * d21) / determinant
    wc = (d00 * d21 - d01 * d20) / determinant
    weights = np.column_stack([1.0 - wb - wc, wb, wc])
    # Where the foot of the perpendicular misses the triangle, the nearest point lies on one of its edges.
    outside = (weights < 0.0).any(axis=1)
    smallest = np.full(len(corners), np.inf)
    for first, second in ((0, 1), (1, 2), (2, 0)):
        span = corners[:, second] - corners[:, first]
        along = np.clip(((query - corners[:, first]) * span).sum(1) / (span * span).sum(1), 0.0, 1.0)
        squared = ((corners[:, first] + along[:, None] * span - query) ** 2).sum(axis=1)
        better = outside & (squared < smallest)
        smallest[better] = squared[better]
        weights[better] = 0.0
        weights[better, first] = 1.0 - along[better]
        weights[better, second] = along[better]
    return weights


def nearest_triangle(corners: FloatArray, query: FloatArray) -> tuple[int, FloatArray]:
    """The triangle nearest to a query point (3,) [m], and the barycentric weights (3,) of its nearest point."""
    weights = nearest_weights(corners, query)
    points = np.einsum("ti,tij->tj", weights, corners)
    best = int(np.argmin(((points - query) ** 2).sum(axis=1)))
    return best, weights[best]
