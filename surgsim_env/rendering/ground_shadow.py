"""The organ's shadow on the drape, as a flat mesh: costs no second pass over the scene, unlike true shadows."""

import numpy as np

from msdm_core.mesh import FloatArray, IntArray
from surgsim_env.rendering.drawn_mesh import Shape

# How far above the drape the shadow lies [m].
GAP = 0.0002


def ground_shadow(
    points: FloatArray, triangles: IntArray, light: FloatArray, ground: FloatArray, up: FloatArray
) -> Shape:
    """The lit triangles pushed along the light onto the plane through `ground` [m] across the unit direction `up`."""
    height = (points - ground) @ up - GAP
    flat = points - (height / (light @ up))[:, None] * light
    corners = flat[triangles]
    lit = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ up > 0.0
    return Shape(flat, np.tile(up, (len(flat), 1)), triangles[lit])
