"""Directions from which a point can be approached: 32 over the half space about its outward normal."""

import math

import numpy as np

from msdm_core.mesh import FloatArray

# Directions of one ring each; every direction stands for the same share of the half space.
RINGS = (1, 6, 11, 14)
DIRECTION_COUNT = sum(RINGS)
# A direction counts as reached within this [rad].
APPROACH_ANGLE = math.radians(10.0)


def approach_directions(normals: FloatArray, towards: FloatArray, line: FloatArray) -> FloatArray:
    """Unit vectors out of the tissue that a tip may come from, about outward normals (n, 3), shape (n, 32, 3).

    Rings of 1, 6, 11 and 14 directions lie in the middles of bands of equal area: after k of 32 directions a band of m
    has cos(theta) = 1 - (k + m/2) / 32 (the first is the normal itself). Azimuths are even and start towards a point
    (`towards` (n, 3), from the surface to the endoscope), so that a mirrored scene has mirrored directions; where the
    normal looks right at it, along `line` (3,).
    """
    first = _across(towards, normals)
    short = np.linalg.norm(first, axis=1) < 1e-6 * np.linalg.norm(towards, axis=1)
    first[short] = _across(np.broadcast_to(line, first.shape), normals)[short]
    first /= np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(normals, first)
    found = [normals]
    before = 1
    for count in RINGS[1:]:
        cosine = 1.0 - (before + 0.5 * count) / DIRECTION_COUNT
        sine = math.sqrt(1.0 - cosine**2)
        for index in range(count):
            azimuth = 2.0 * math.pi * index / count
            found.append(cosine * normals + sine * (math.cos(azimuth) * first + math.sin(azimuth) * second))
        before += count
    return np.stack(found, axis=1)


def _across(vectors: FloatArray, normals: FloatArray) -> FloatArray:
    return vectors - (vectors * normals).sum(axis=1)[:, None] * normals


def approach_share(pointing: FloatArray, usable: np.ndarray, directions: FloatArray) -> FloatArray:
    """Share of directions (n, 32, 3) that usable tips (n, k), pointing along (n, k, 3), have within 10 degrees."""
    cosine = -np.einsum("nki,ndi->nkd", pointing, directions)
    return ((cosine >= math.cos(APPROACH_ANGLE)) & usable[:, :, None]).any(axis=1).mean(axis=1)
