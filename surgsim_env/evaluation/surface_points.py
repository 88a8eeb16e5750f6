"""Points spread evenly over the part of an organ's surface that faces the ports."""

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.mesh import FloatArray
from surgsim_env.anatomy import Anatomy

# So many places are tried for each point that is taken.
PLACES_PER_POINT = 12


def facing_points(anatomy: Anatomy, ports: ArrayLike, count: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Points on the organ's surface [m] and unit outward normals there, each (count, 3).

    A triangle faces the ports if the middle of the ports (n_port, 3) [m] lies on its outer side; what is anchored is
    left out, something lies on it. Triangles are quartered until there are many small ones; from their centroids each
    next point is the one furthest from all before it (farthest-point sampling), the first drawn from the seed.

    Raises:
        ValueError: fewer than one point asked for, or no triangle faces the ports.
    """
    if count < 1:
        raise ValueError(f"{count} points of the surface asked for; at least 1 is needed")
    corners = anatomy.mesh.points[anatomy.mesh.boundary_triangles]
    held = np.isin(anatomy.mesh.boundary_triangles, anatomy.anchors).all(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    middle = np.asarray(ports, dtype=np.float64).mean(axis=0)
    facing = ~held & (((middle - corners.mean(axis=1)) * normals).sum(axis=1) > 0.0)
    if not facing.any():
        raise ValueError("no free part of the organ's surface faces the ports: move the ports")
    corners, normals = corners[facing], normals[facing]
    while len(corners) < PLACES_PER_POINT * count:
        corners, normals = _quartered(corners), np.repeat(normals, 4, axis=0)
    centres = corners.mean(axis=1)
    # Ranked by distance from the ports: a mirrored organ has mirrored points, in the same order.
    ranked = np.argsort(np.linalg.norm(centres - middle, axis=1), kind="stable")
    chosen = _spread(centres, count, int(ranked[np.random.default_rng(seed).integers(len(centres))]))
    return centres[chosen], normals[chosen]


def _quartered(corners: FloatArray) -> FloatArray:
    """Each triangle (n, 3, 3) cut into four alike."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
    parts = [np.stack(three, axis=1) for three in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.stack(parts, axis=1).reshape(-1, 3, 3)


def _spread(points: FloatArray, count: int, first: int) -> np.ndarray:
    """Indices of points, each the furthest from those before it, (count,)."""
    chosen = [first]
    nearest = ((points - points[first]) ** 2).sum(axis=1)
    for _ in range(count - 1):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
    return np.array(chosen)
