"""Vessels on tissue: a procedural texture, and the texture coordinates of a surface."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray, IntArray

# Width of the texture [pixels] and of the piece of surface that it covers [m]; it repeats without a seam.
TEXTURE_SIZE, TEXTURE_WIDTH = 128, 0.06
# Relative bandwidth of the waves of the pattern.
BANDWIDTH = 0.3
# Colour of a vessel relative to the tissue's: darker and bluer.
VESSEL_TINT = np.array([1.0, 1.25, 1.05])
# Texture coordinates of a vertex: one pair for each axis along which triangles are projected.
AXIS_COUNT = 3


@lru_cache(maxsize=64)
def vessel_texture(seed: int, density: float, strength: float, width: float) -> NDArray[np.uint8]:
    """Texture (TEXTURE_SIZE, TEXTURE_SIZE, 3), a factor on the tissue's colour.

    Vessels are the zeros of a random field of waves of about one length.

    Args:
        seed: of the field.
        density: vessels crossed on a metre of surface [1/m].
        strength: darkness, 0 to 1.
        width: approximate share of the surface.
    """
    rng = np.random.default_rng(seed)
    # A wave of length L changes its sign twice.
    cycles = 0.5 * density * TEXTURE_WIDTH
    wave = np.fft.fftfreq(TEXTURE_SIZE, 1.0 / TEXTURE_SIZE)
    length = np.hypot(*np.meshgrid(wave, wave))
    band = np.exp(-0.5 * ((length - cycles) / max(BANDWIDTH * cycles, 0.7)) ** 2)
    field = np.fft.ifft2(np.fft.fft2(rng.normal(size=length.shape)) * band).real
    field /= field.std()
    # Near 0 the field's values are spread evenly: a share w of them lies within about 1.25 w.
    near = np.clip(1.0 - np.abs(field) / max(1.25 * width, 1e-6), 0.0, 1.0)
    shade = 1.0 - strength * near[..., None] / VESSEL_TINT
    return np.rint(255.0 * shade).astype(np.uint8)


def texture_places(vertices: FloatArray, faces: IntArray) -> tuple[NDArray[np.float32], IntArray]:
    """Texture coordinates of a surface at rest; each triangle is projected along the axis nearest to its normal.

    Args:
        vertices: at rest [m], (n_vertex, 3).
        faces: vertices of the triangles, (n_face, 3).

    Returns:
        Coordinates of each vertex for the axes x, y and z, one after the other, in widths of the texture
        (AXIS_COUNT n_vertex, 2), and their indices at each triangle's corners (n_face, 3).
    """
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.abs(normals).argmax(axis=1)
    places = np.stack([vertices[:, [1, 2]], vertices[:, [2, 0]], vertices[:, [0, 1]]], axis=1) / TEXTURE_WIDTH
    return places.reshape(-1, 2).astype(np.float32), (AXIS_COUNT * faces + axis[:, None]).astype(np.int32)
