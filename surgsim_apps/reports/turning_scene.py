"""Scene of a report that the reader turns: trimesh's viewer with its copy of three.js (MIT), which loads nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.mesh import FloatArray, IntArray
from surgsim_apps.reports.surface_drawing import OrthographicView, tube

if TYPE_CHECKING:
    import trimesh

# The viewer's light is 1.75 times as strong as paper is white.
BRIGHTNESS = 0.62
FOV_DEG, ASPECT = 30.0, 4 / 3


@dataclass(frozen=True, eq=False)
class SolidPart:
    """A part of a scene.

    Fields:
        name: unique in the scene
        points, triangles: outward [m]                                  (n, 3), (m, 3)
        colour: matplotlib's, for all of it, or red, green, blue of each point (n, 3)
        opacity: below 1 for a translucent part
    """

    name: str
    points: FloatArray
    triangles: IntArray
    colour: ArrayLike
    opacity: float = 1.0


@dataclass(frozen=True)
class TurningScene:
    """A scene that turns.

    Fields:
        description: for its caption
        html: a document that shows it
        legend: names and colours (#rrggbb) of its parts
    """

    description: str
    html: str
    legend: tuple[tuple[str, str], ...]


def capsules_part(name: str, ends: ArrayLike, radius: ArrayLike, colour: ArrayLike, opacity: float = 1.0) -> SolidPart:
    """Capsules with ends (n, 2, 3) and radii (n,) [m] as a part; of a ball both ends are the same."""
    tubes = [
        tube(start, end, float(size), rings=9, count=14)
        for (start, end), size in zip(np.asarray(ends), np.asarray(radius))
    ]
    first = np.cumsum([0, *(len(points) for points, _ in tubes)])
    points = np.concatenate([points for points, _ in tubes])
    triangles = np.concatenate([triangles + start for (_, triangles), start in zip(tubes, first)])
    return SolidPart(name, points, triangles.astype(np.int32), colour, opacity)


def marks_part(name: str, places: FloatArray, radius: float, colour: ArrayLike) -> SolidPart:
    """Places (n, 3) [m] as small balls of 20 triangles each."""
    from trimesh.creation import icosahedron

    ball = icosahedron()
    points = places[:, None] + radius * ball.vertices
    triangles = 12 * np.arange(len(places))[:, None, None] + ball.faces
    return SolidPart(name, points.reshape(-1, 3), triangles.reshape(-1, 3).astype(np.int32), colour)


def turning_scene(
    parts: Sequence[SolidPart], view: OrthographicView, description: str, legend: Sequence[tuple[str, str]]
) -> TurningScene:
    """A scene of parts, first seen in a view, about the middle of the box around them."""
    import trimesh
    from trimesh.scene import Camera
    from trimesh.viewer import scene_to_html

    # Points of no triangle would count for the middle.
    used = [np.unique(part.triangles, return_inverse=True) for part in parts]
    places = np.concatenate([part.points[rows] for part, (rows, _) in zip(parts, used, strict=True)])
    # The viewer turns about the origin at first, with y up.
    axes = np.stack([view.right, view.up, view.towards])
    seen = places @ axes.T
    middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    scene = trimesh.Scene()
    for part, (rows, index) in zip(parts, used, strict=True):
        colour = part.colour if isinstance(part.colour, str) else np.asarray(part.colour)[rows]
        mesh = _mesh(part.points[rows] @ axes.T - middle, index.reshape(-1, 3).astype(np.int32), colour, part.opacity)
        scene.add_geometry(mesh, geom_name=part.name, node_name=part.name)
    # The nearest place from which all points are in the picture.
    x, y, z = np.abs(seen - middle)[:, 0] / ASPECT, np.abs(seen - middle)[:, 1], (seen - middle)[:, 2]
    distance = float((np.maximum(x, y) / math.tan(math.radians(0.48 * FOV_DEG)) + z).max())
    # A camera without a name would have a random one, and the report other bytes each time.
    scene.camera = Camera("camera", fov=(ASPECT * FOV_DEG, FOV_DEG))
    scene.set_camera((0.0, 0.0, 0.0), distance, np.zeros(3), fov=(ASPECT * FOV_DEG, FOV_DEG))
    return TurningScene(description, scene_to_html(scene), tuple(legend))


def _mesh(points: FloatArray, triangles: IntArray, colour: str | FloatArray, opacity: float) -> trimesh.Trimesh:
    import trimesh
    from matplotlib.colors import to_rgb
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    base = [*(BRIGHTNESS * np.array(to_rgb(colour) if isinstance(colour, str) else np.ones(3))), opacity]
    mode = "OPAQUE" if opacity == 1.0 else "BLEND"
    material = PBRMaterial(baseColorFactor=base, alphaMode=mode, metallicFactor=0.0, roughnessFactor=1.0)
    visual = TextureVisuals(material=material)
    if not isinstance(colour, str):
        rgba = np.concatenate([colour, np.ones((len(points), 1))], axis=1)
        visual.vertex_attributes["color"] = np.round(255.0 * rgba).astype(np.uint8)
    mesh = trimesh.Trimesh(points, triangles, process=False, visual=visual)
    # Written with the mesh once they are computed; without them the viewer shows flat triangles.
    assert len(mesh.vertex_normals) == len(points)
    return mesh
