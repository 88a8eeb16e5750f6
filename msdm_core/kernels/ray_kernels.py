"""Intersections of rays and triangles (Moeller and Trumbore 1997): visibility, thickness, self-crossing.

Lines of a grid against a closed surface are in `mesh.surface.line_hits`: it decides a line's side of an edge once per
edge, so that no line slips between two triangles.
"""

import numpy as np
from numba import njit

from msdm_core.kernels.option_kernels import INLINED, KERNEL


@njit(**INLINED)
def ray_hit(ox, oy, oz, dx, dy, dz, bx, by, bz, cx, cy, cz):
    """Intersection of a ray with a triangle, in multiples of d from its origin; nan without an intersection.

    In: o: from the triangle's corner a to the origin of the ray [m], d: the ray, b and c: edges from a [m]
    """
    px, py, pz = dy * cz - dz * cy, dz * cx - dx * cz, dx * cy - dy * cx
    qx, qy, qz = oy * bz - oz * by, oz * bx - ox * bz, ox * by - oy * bx
    volume = bx * px + by * py + bz * pz
    first = (ox * px + oy * py + oz * pz) / volume
    second = (dx * qx + dy * qy + dz * qz) / volume
    if first >= 0.0 and second >= 0.0 and first + second <= 1.0:
        return (cx * qx + cy * qy + cz * qz) / volume
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
    ax, ay, az = corners[triangle, 0, 0], corners[triangle, 0, 1], corners[triangle, 0, 2]
    return ray_hit(
        origins[ray, 0] - ax, origins[ray, 1] - ay, origins[ray, 2] - az,
        directions[ray, 0], directions[ray, 1], directions[ray, 2],
        corners[triangle, 1, 0] - ax, corners[triangle, 1, 1] - ay, corners[triangle, 1, 2] - az,
        corners[triangle, 2, 0] - ax, corners[triangle, 2, 1] - ay, corners[triangle, 2, 2] - az,
    )  # fmt: skip
