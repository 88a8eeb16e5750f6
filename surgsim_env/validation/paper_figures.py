"""Figures 4 and 5 of the paper redone from tests A and B."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from msdm_core.mesh import TET_FACES, FloatArray, IntArray
from msdm_core.regions import boundary_layer
from surgsim_env.validation.paper_tests import Deformed, settling

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# From where a body is seen: unit vectors to the right and up on the page, and towards the eye.
View = tuple[FloatArray, FloatArray, FloatArray]
RING = 0.04  # [m] of the white circle around the press
STROMA, PARENCHYMA, GEL = (0.25, 0.40, 0.80), (0.80, 0.25, 0.25), (0.86, 0.80, 0.62)


def oblique(azimuth_deg: float, elevation_deg: float) -> View:
    """The view from an azimuth about z (0 is from +x) and an elevation."""
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    eye = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    return right, np.cross(eye, right), eye


def draw_triangles(
    axes: "Axes",
    corners: FloatArray,
    colours: FloatArray,
    view: View,
    *,
    wire: bool = False,
    light: tuple[float, float, float] = (0.3, -0.5, 0.8),
) -> None:
    """Triangles (n, 3, 3) [m] from back to front, shaded, or as their edges only."""
    from matplotlib.collections import PolyCollection

    right, up, eye = view
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    seen = np.arange(len(corners)) if wire else np.flatnonzero(normal @ eye > 0.0)
    order = seen[np.argsort(corners[seen].mean(axis=1) @ eye, kind="stable")]
    plane = 1e3 * np.stack([corners[order] @ right, corners[order] @ up], axis=2)
    if wire:
        lines = PolyCollection(list(plane), facecolors="none", edgecolors=(0.2, 0.3, 0.5), linewidths=0.35)
        axes.add_collection(lines)
    else:
        bright = 0.65 + 0.35 * np.clip(normal[order] @ (np.array(light) / np.linalg.norm(light)), 0.0, 1.0)
        shaded = np.clip(colours[order] * bright[:, None], 0.0, 1.0)
        axes.add_collection(PolyCollection(list(plane), facecolors=shaded, edgecolors=(0, 0, 0, 0.35), linewidths=0.3))
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_axis_off()


def write_figure_4(twisted: Deformed, angle_deg: float, path: Path) -> None:
    """The prism twisted, as a wireframe and as a body."""
    from matplotlib.figure import Figure

    mesh = twisted.anatomy.mesh
    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    view = oblique(-60.0, 15.0)
    left, right = figure.subplots(1, 2)
    edges = twisted.position[_faces(mesh.tets)]
    draw_triangles(left, edges, np.zeros((len(edges), 3)), view, wire=True)
    body = twisted.position[mesh.boundary_triangles]
    draw_triangles(right, body, np.tile(GEL, (len(body), 1)), view)
    left.set_title("(a) the network")
    right.set_title("(b) the body")
    figure.suptitle(
        f"Test A: 2 x 5 x 10 cm, E 20 kPa, top turned by {angle_deg:.0f} degrees, both ends held\n"
        f"{mesh.node_count} nodes, {mesh.tet_count} tets; torque {1e3 * twisted.load:.1f} mN m"
    )
    _save(figure, path)


def write_figure_5(pressed: Deformed, path: Path) -> None:
    """The block cut open to show its layer of stroma, pressed, and how its upper side moves away from the press."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    mesh = pressed.anatomy.mesh
    figure = Figure(figsize=(9.0, 7.5), layout="constrained")
    structure, body, curve = figure.subplots(3, 1, height_ratios=[1.0, 1.0, 0.9])
    view = oblique(-75.0, 25.0)
    half = np.flatnonzero(mesh.points[mesh.tets, 1].mean(axis=1) > pressed.site[1])
    faces, owner = _outer_faces(mesh.tets[half])
    layer = boundary_layer(mesh)[half][owner]
    colours = np.where(layer[:, None], np.array(STROMA), np.array(PARENCHYMA))
    draw_triangles(structure, mesh.points[faces], colours, view)
    structure.set_title("(a) cut open: stroma (blue, 60 kPa) and parenchyma (red, 20 kPa)")
    triangles = mesh.boundary_triangles
    moved = pressed.displacement[triangles].mean(axis=1) / pressed.displacement.max()
    draw_triangles(body, pressed.position[triangles], colormaps["viridis"](moved)[:, :3], view)
    depth = pressed.anatomy.scene.palpation.press_depth
    right, up, _ = view
    ring = np.array([[np.cos(t), np.sin(t), 0.0] for t in np.linspace(0.0, 2.0 * np.pi, 61)]) * RING + pressed.site
    body.plot(1e3 * ring @ right, 1e3 * ring @ up, "w-", linewidth=2.0)
    body.set_title(
        f"(b) pressed {1e3 * depth:.0f} mm with {pressed.load:.1f} N; colour: displacement (dark 0, yellow "
        f"{1e3 * pressed.displacement.max():.0f} mm); white: {1e2 * RING:.0f} cm around"
    )
    distance, share = settling(pressed)
    curve.plot(1e3 * distance, 100.0 * share, "o", markersize=3)
    curve.set_xlabel("distance from the press on the upper side [mm]")
    curve.set_ylabel("displacement\n[% of that beside the tip]")
    curve.grid(alpha=0.3)
    _save(figure, path)


def _faces(tets: IntArray) -> IntArray:
    """Every face of every tet, once each (n, 3)."""
    faces = tets[:, TET_FACES].reshape(-1, 3)
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return faces[first]


def _outer_faces(tets: IntArray) -> tuple[IntArray, IntArray]:
    """Faces that belong to one of these tets only, outward (n, 3), and that tet (n,)."""
    faces = tets[:, TET_FACES].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outer = first[count == 1]
    return faces[outer], (outer // 4).astype(np.int32)


def _save(figure: "Figure", path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=110, metadata={"Software": None})
