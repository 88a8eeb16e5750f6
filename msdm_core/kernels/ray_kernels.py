"""Intersections of rays and triangles (Moeller and Trumbore 1997): visibility, thickness, self-crossing.

Lines of a grid against a closed surface are in `mesh.surface.line_hits`: it decides a line's side of an edge once per
edge, so that no line slips between two triangles.
"""

import numpy as np
from numba import njit

from msdm_core.kernels.option_kernels import INLINED, KERNEL
from msdm_core.kernels.space_kernels import edge, minus, row_of, scalar_product, vector_product


@njit(**INLINED)
def ray_hit(origin, direction, b, c):
    """Intersection of a ray with a triangle, in multiples of its direction; nan without an intersection.

    In: origin: of the ray, from the triangle's corner a [m], direction: of the ray, b and c: edges from a [m]
    """
    p, q = vector_product(direction, c), vector_product(origin, b)
    volume = scalar_product(b, p)
    first = scalar_product(origin, p) / volume
    second = scalar_product(direction, q) / volume
    if first >= 0.0 and second >= 0.0 and first + second <= 1.0:
        return scalar_product(c, q) / volume
    return np.nan


@njit(**KERNEL)
def nearest_hits(origins, directions, corners, least, distance):
    """Distance to the nearest triangle along each ray.

    In:  origins [m], directions: unit vectors (n, 3), corners of triangles [m] (m, 3, 3), least: smallest distance [m]
    Out: distance to the nearest hit, infinite without a hit [m] (n,)
    """
    for ray in range(origins.shape[0]):
        nearest = np.inf
        for triangle in range(corners.shape[0]):
            hit = _hit_of(origins, directions, ray, corners, triangle)
            if least < hit < nearest:
                nearest = hit
        distance[ray] = nearest


@njit(**KERNEL)
def pierces(origins, directions, corners, pierced):
    """Intersection of each segment with the triangle of the same index.

    In:  origins, directions: from one end to the other [m] (n, 3), corners of triangles [m] (n, 3, 3)
    Out: pierced (n,)
    """
    for ray in range(origins.shape[0]):
        pierced[ray] = 0.0 < _hit_of(origins, directions, ray, corners, ray) < 1.0


@njit(**INLINED)
def _hit_of(origins, directions, ray, corners, triangle):
    """`ray_hit` of one ray and one triangle of arrays."""
    chosen = corners[triangle]
    from_a = minus(row_of(origins, ray), row_of(chosen, 0))
    return ray_hit(from_a, row_of(directions, ray), edge(chosen, 0, 1), edge(chosen, 0, 2))
