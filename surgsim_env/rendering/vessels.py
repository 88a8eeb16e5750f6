"""Textures of tissue: vessels on a surface with its texture coordinates, and a solid field."""

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
# Width of the solid field [voxels], and waves across it.
FIELD_SIZE, FIELD_CYCLES = 64, 8.0
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


@lru_cache(maxsize=1)
def tissue_field() -> NDArray[np.uint8]:
    """Random field of waves of about one length, and its gradient: mottling, vessels and bumps of solid tissue.

    Returns:
        Gradient and value (FIELD_SIZE, FIELD_SIZE, FIELD_SIZE, 4), 128 for 0; it repeats without a seam. The axes are
        z, y, x, the gradient's entries x, y, z.
    """
    wave = np.fft.fftfreq(FIELD_SIZE, 1.0 / FIELD_SIZE)
    cycles = np.stack(np.meshgrid(wave, wave, wave, indexing="ij")[::-1], axis=-1)
    length = np.linalg.norm(cycles, axis=-1)
    band = np.exp(-0.5 * ((length - FIELD_CYCLES) / (BANDWIDTH * FIELD_CYCLES)) ** 2)
    waves = np.fft.fftn(np.random.default_rng(0).normal(size=length.shape)) * band
    values = np.concatenate([2j * np.pi * cycles * waves[..., None], waves[..., None]], axis=-1)
    values = np.fft.ifftn(values, axes=(0, 1, 2)).real
    # Four standard deviations fill the scale.
    values /= 4.0 * values.std(axis=(0, 1, 2))
    return np.clip(np.rint(128.0 + 127.0 * values), 0, 255).astype(np.uint8)
