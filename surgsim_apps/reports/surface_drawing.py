"""Drawing of an organ's surface without GL: curved, shaded triangles in orthographic projection, with a map."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from msdm_core.mesh import FloatArray, IntArray, surface_carriers, triangle_lattice
from surgsim_env.scene import Anatomy, tangent_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, PAPER = "#20242c", "white"
# A triangle is drawn as SPLITS^2 patches, or fewer to stay below PATCHES_MOST, bent towards its corners' tangent planes
# by a share (Boubekeur & Alexa 2008).
SPLITS = 4
PATCHES_MOST = 100_000
BEND = 0.6
# Least cosine between a face and the mean normal of a smooth corner.
CREASE_COSINE = 0.75
AMBIENT, DIFFUSE, GLOSS, SHININESS = 0.42, 0.62, 0.16, 22.0
# Distances of the map's fading from the nearest site, in site spacings.
FADE_FROM, FADE_TO = 0.75, 1.15


@dataclass(frozen=True, eq=False)
class OrthographicView:
    """Orthographic view: unit vectors to the right and up in the picture, and to the viewer."""

    right: FloatArray
    up: FloatArray
    towards: FloatArray

    @classmethod
    def along(cls, direction: FloatArray, up: FloatArray | None = None) -> OrthographicView:
        """View along a direction; without `up`, upright as the raster of a palpable face."""
        towards = -np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
        if up is None:
            return cls(*tangent_axes(-towards), towards)
        right = np.cross(up, towards)
        right /= np.linalg.norm(right)
        return cls(right, np.cross(towards, right), towards)

    def flat(self, points: FloatArray) -> FloatArray:
        """Picture coordinates of points [mm], shape (..., 2)."""
        return np.stack([points @ self.right, points @ self.up], axis=-1) * 1e3


@dataclass(frozen=True, eq=False)
class Patches:
    """Small triangles to draw: corners [m] (n, 3, 3), normals (n, 3), index of their triangle (n,)."""

    corners: FloatArray
    normals: FloatArray
    origin: IntArray


def organ_patches(anatomy: Anatomy) -> Patches:
    """Patches of an organ at rest, with the boundary triangles of the tets below them.

    Raises:
        MeshError: the scene's fine surface cannot be read, or is not of this organ.
    """
    points, triangles = anatomy.outer_surface
    patches = curved_patches(points, triangles)
    if anatomy.fine_surface is None:
        return patches
    first, second, third = surface_carriers(points, anatomy.mesh).triangle[triangles.T]
    # The triangle of two corners, if any, gives smoother borders of colours than that of a single one.
    below = np.where(second == third, second, first)
    return replace(patches, origin=below[patches.origin])


def curved_patches(points: FloatArray, triangles: IntArray, splits_most: int = SPLITS) -> Patches:
    """Patches of a surface, up to splits_most^2 of a triangle, bent towards the smooth normals."""
    splits = max(k for k in range(1, splits_most + 1) if k == 1 or len(triangles) * k * k <= PATCHES_MOST)
    corners = points[triangles]
    area_vector = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face_normal = area_vector / np.linalg.norm(area_vector, axis=1)[:, None]
    mean = np.zeros_like(points)
    for corner in range(3):
        np.add.at(mean, triangles[:, corner], area_vector)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-30)[:, None]
    normals = mean[triangles]
    sharp = np.einsum("fij,fj->fi", normals, face_normal) < CREASE_COSINE
    normals = np.where(sharp[:, :, None], face_normal[:, None], normals)
    lattice, small = triangle_lattice(splits)
    weights = lattice / splits
    flat = np.einsum("wi,fij->fwj", weights, corners)
    offset = np.einsum("fwij,fij->fwi", flat[:, :, None] - corners[:, None], normals)
    bent = flat - np.einsum("wi,fwi,fij->fwj", weights, offset, normals)
    vertices = (1.0 - BEND) * flat + BEND * bent
    smooth = np.einsum("wi,fij->fwj", weights, normals)[:, small].mean(axis=2)
    smooth /= np.linalg.norm(smooth, axis=2, keepdims=True)
    origin = np.repeat(np.arange(len(triangles)), len(small)).astype(np.int32)
    return Patches(vertices[:, small].reshape(-1, 3, 3), smooth.reshape(-1, 3), origin)


def interpolated(sites: FloatArray, values: FloatArray, places: FloatArray) -> FloatArray:
    """Values at places (m, 3) of a continuous field near the values at sites [m] (n, 3), by radial functions."""
    from scipy.interpolate import RBFInterpolator
    from scipy.spatial import KDTree

    if len(sites) < 8 or np.ptp(values) == 0.0:
        return values[KDTree(sites).query(places)[1]]
    # In the best-fit plane of the sites: a flat face has no extent across it.
    centred = sites - sites.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2][:2]
    field = RBFInterpolator(
        centred @ axes.T * 1e3, values, neighbors=min(24, len(sites)), smoothing=0.02, kernel="linear"
    )
    return np.clip(field((places - sites.mean(axis=0)) @ axes.T * 1e3), values.min(), values.max())


def nearness(sites: FloatArray, places: FloatArray, spacing: float, fade_to: float = FADE_TO) -> FloatArray:
    """Opacity of a map at each place, 1 near a site, fading to 0 beyond, shape (m,)."""
    from scipy.spatial import KDTree

    distance = KDTree(sites).query(places)[0] / spacing
    return np.clip((fade_to - distance) / (fade_to - FADE_FROM), 0.0, 1.0)


def shaded(colours: FloatArray, normals: FloatArray, view: OrthographicView, gloss: float = GLOSS) -> FloatArray:
    """Colours (n, 3) under a light above the viewer's left shoulder (Blinn & Phong), shape (n, 3)."""
    light = view.towards + 0.45 * view.up - 0.35 * view.right
    light /= np.linalg.norm(light)
    half = light + view.towards
    half /= np.linalg.norm(half)
    diffuse = np.clip(normals @ light, 0.0, 1.0)[:, None]
    highlight = np.clip(normals @ half, 0.0, 1.0)[:, None] ** SHININESS
    return np.clip(colours * (AMBIENT + DIFFUSE * diffuse) + gloss * highlight, 0.0, 1.0)


def tube(
    start: FloatArray, end: FloatArray, radius: float, rings: int = 17, count: int = 28
) -> tuple[FloatArray, IntArray]:
    """Points and outward triangles of a capsule between two points, or of a ball at a single point."""
    along = end - start
    length = float(np.linalg.norm(along))
    axis = along / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    first, second = tangent_axes(axis)
    latitude = np.linspace(-0.5 * np.pi, 0.5 * np.pi, rings)
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    around = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    balls = [(start if value < 0.0 else end, value) for value in latitude]
    points = [centre + radius * (np.cos(value) * around + np.sin(value) * axis) for centre, value in balls]
    grid = np.arange(rings * count).reshape(rings, count)
    a, b = grid[:-1], np.roll(grid[:-1], -1, axis=1)
    c, d = np.roll(grid[1:], -1, axis=1), grid[1:]
    quads = np.stack([a, b, c, d], axis=-1).reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    vertices = np.concatenate(points)
    # Left-handed axes give inward triangles, which are flipped.
    corners = vertices[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    keep = np.linalg.norm(normal, axis=1) > 1e-16
    middle = corners.mean(axis=1)
    outward = middle - (start + np.clip((middle - start) @ axis, 0, length)[:, None] * axis)
    inward = (normal * outward).sum(axis=1) < 0.0
    triangles[inward] = triangles[inward][:, [0, 2, 1]]
    return vertices, triangles[keep].astype(np.int32)


def draw_patches(
    axes: Axes,
    parts: list[tuple[Patches, FloatArray, float]],
    view: OrthographicView,
    zorder: int = 1,
    flatness: float = 0.0,
) -> None:
    """Draw patches from the farthest to the nearest, without those that face away.

    Args:
        axes: to draw in.
        parts: patches, their colours (n, 3) and gloss.
        view: of them.
        zorder: matplotlib's.
        flatness: 0 for full shading, 1 for the given colours.
    """
    from matplotlib.collections import PolyCollection

    corners = np.concatenate([patches.corners for patches, _, _ in parts])
    colours = np.concatenate([shaded(colour, patches.normals, view, gloss) for patches, colour, gloss in parts])
    if flatness:
        colours = flatness * np.concatenate([colour for _, colour, _ in parts]) + (1.0 - flatness) * colours
    normals = np.concatenate([patches.normals for patches, _, _ in parts])
    order = np.argsort(corners.mean(axis=1) @ view.towards)
    order = order[normals[order] @ view.towards > -0.15]
    face = colours[order]
    axes.add_collection(
        # An array, unknown to matplotlib's types, takes a fifth of the time of a list.
        PolyCollection(
            cast(Any, view.flat(corners[order])), facecolors=face, edgecolors=face, linewidths=0.8, zorder=zorder
        )
    )
    axes.autoscale_view()


def save_png(figure: Figure, path: Path, facecolor: str = PAPER) -> None:
    """Write a figure without display; equal figures give equal bytes."""
    figure.savefig(path, format="png", facecolor=facecolor)
