"""Pictures of a patient's organ without OpenGL: three views, whole and cut open, and histograms of its tets."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from msdm_core.material.regions import Lesion, lesion_extent
from msdm_core.mesh.quality import dihedral_angles, radius_ratios
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, TetMesh
from surgsim_env.palpation.surface_drawing import INK, PAPER, Patches, View, curved_patches, draw_patches
from surgsim_env.rendering.cutting import cut_edges

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from surgsim_env.patient.patient_scene import PatientScene

TISSUE = np.array([0.72, 0.36, 0.30])
PALPABLE = np.array([0.86, 0.56, 0.45])
HELD = np.array([0.42, 0.47, 0.56])
SECTION = np.array([0.90, 0.70, 0.62])
# Colours of the regions after the first, repeated cyclically.
REGIONS = np.array([[0.95, 0.78, 0.18], [0.25, 0.55, 0.85], [0.35, 0.70, 0.45], [0.62, 0.42, 0.75], [0.92, 0.50, 0.20]])
BLUE = "#3b6ea8"


@dataclass(frozen=True)
class Side:
    """A viewing direction, its upward direction, and titles for the axes of a scan and for other axes."""

    along: tuple[float, float, float]
    up: tuple[float, float, float]
    scan: str
    other: str


SIDES = (
    Side((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), "from the front", "along y"),
    Side((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0), "from the patient's left", "against x"),
    Side((0.0, 0.0, -1.0), (0.0, -1.0, 0.0), "from the head", "against z"),
)


def organ_picture(found: PatientScene) -> bytes:
    """PNG of three views: above whole with the palpable face and the anchors, below cut open through a region."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.5, 8.6), dpi=100, facecolor=PAPER, layout="constrained")
    axes = figure.subplots(2, 3)
    mesh = found.anatomy.mesh
    patches = curved_patches(mesh.points, mesh.boundary_triangles)
    colours = _outer_colours(found)[patches.origin]
    through = _through(found)
    for column, side in enumerate(SIDES):
        view = View.along(np.array(side.along), up=np.array(side.up))
        draw_patches(axes[0, column], [(patches, colours, 0.12)], view)
        _draw_cut(axes[1, column], mesh, patches, colours, through, view)
        axes[0, column].set_title(side.scan if found.patient.is_scan else side.other, color=INK, fontsize=11)
        axes[1, column].set_title("cut open there", color=INK, fontsize=11)
    for one in axes.flat:
        one.set_aspect("equal")
        one.set_axis_off()
    _scale_bar(axes[0, 0], mesh)
    _legend(figure, found)
    return _png(figure)


def quality_picture(mesh: TetMesh) -> bytes:
    """PNG: histograms of the tets' dihedral angles, radius ratios and volumes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 3.2), dpi=100, facecolor=PAPER, layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    angles = dihedral_angles(mesh).ravel()
    left.hist(angles, bins=np.arange(0.0, 181.0, 4.0), color=BLUE)
    left.set_xlabel(f"dihedral angle [degrees], {angles.min():.1f} to {angles.max():.1f}")
    ratios = radius_ratios(mesh)
    middle.hist(ratios, bins=np.linspace(0.0, 1.0, 41), color=BLUE)
    middle.set_xlabel(f"radius ratio, from {ratios.min():.2f}; 1 is regular")
    volumes = mesh.volumes * 1e9
    right.hist(volumes, bins=40, color=BLUE)
    right.set_xlabel(f"volume [mm³], from {volumes.min():.2g}")
    for one, what in ((left, "angles"), (middle, "tets"), (right, "tets")):
        one.set_ylabel(f"number of {what}")
        one.set_yscale("log")
        one.spines[["top", "right"]].set_visible(False)
    return _png(figure)


def _outer_colours(found: PatientScene) -> FloatArray:
    """Colours of the boundary triangles (n_triangle, 3)."""
    mesh, anatomy = found.anatomy.mesh, found.anatomy
    triangles = mesh.boundary_triangles
    colours = np.broadcast_to(TISSUE, (len(triangles), 3)).copy()
    palpable = {tuple(row) for row in anatomy.face.triangles.tolist()}
    colours[[tuple(row) in palpable for row in triangles.tolist()]] = PALPABLE
    colours[np.isin(triangles, anatomy.anchors).all(axis=1)] = HELD
    tags = mesh.region[mesh.boundary_tets]
    for tag, colour in _region_colours(mesh).items():
        colours[tags == tag] = colour
    return colours


def _region_colours(mesh: TetMesh) -> dict[int, FloatArray]:
    return {tag: REGIONS[number % len(REGIONS)] for number, (tag, _) in enumerate(mesh.region_names[1:])}


def _through(found: PatientScene) -> FloatArray:
    """A point on the cutting planes [m]: the centre of the largest region, lesions first, or of the organ."""
    mesh = found.anatomy.mesh
    inner = found.patient.volumes[1:]
    if not inner:
        return mesh.volumes @ mesh.points[mesh.tets].mean(axis=1) / mesh.volumes.sum()
    largest = max(inner, key=lambda one: (one.name in found.patient.lesions, one.mesh)).name
    return lesion_extent(mesh, Lesion(region=largest, material=found.organ.material, name=largest))[0]


def _draw_cut(
    axes: Axes, mesh: TetMesh, patches: Patches, colours: FloatArray, through: FloatArray, view: View
) -> None:
    """Draw the part behind the plane through a point that faces the viewer, and the section in its regions' colours."""
    from matplotlib.collections import PolyCollection

    behind = (patches.corners.mean(axis=1) - through) @ view.towards < 0.0
    kept = Patches(patches.corners[behind], patches.normals[behind], patches.origin[behind])
    draw_patches(axes, [(kept, colours[behind], 0.12)], view)
    polygons, tags = section(mesh, through, view.towards)
    tints = _region_colours(mesh)
    faces = np.array([tints.get(int(tag), SECTION) for tag in tags]).reshape(-1, 3)
    flat = [view.flat(polygon) for polygon in polygons]
    axes.add_collection(PolyCollection(flat, facecolors=faces, edgecolors=0.8 * faces, linewidths=0.25, zorder=3))
    axes.autoscale_view()


def section(mesh: TetMesh, through: FloatArray, normal: FloatArray) -> tuple[list[FloatArray], IntArray]:
    """Sections of tets with a plane: polygons of 3 or 4 points [m] and the tets' region tags."""
    height = (mesh.points - through) @ normal
    polygons: list[FloatArray] = []
    cut = []
    for tets, edges in cut_edges(mesh.tets, height):
        start, end = height[edges[..., 0]], height[edges[..., 1]]
        share = (start / (start - end))[..., None]
        polygons.extend(mesh.points[edges[..., 0]] * (1.0 - share) + mesh.points[edges[..., 1]] * share)
        cut.append(tets)
    owner = np.concatenate(cut)
    order = np.argsort(owner)
    return [polygons[one] for one in order], mesh.region[owner[order]]


def _scale_bar(axes: Axes, mesh: TetMesh) -> None:
    length = 50.0 if np.ptp(mesh.points, axis=0).max() > 0.08 else 10.0
    low = axes.get_xlim()[0]
    bottom = axes.get_ylim()[0]
    axes.plot([low, low + length], [bottom, bottom], color=INK, lw=2.5)
    axes.annotate(f"{length:g} mm", (low, bottom), (0, 4), textcoords="offset points", color=INK, fontsize=9)


def _legend(figure: Figure, found: PatientScene) -> None:
    from matplotlib.patches import Patch

    mesh = found.anatomy.mesh
    names = dict(mesh.region_names)
    entries = [(PALPABLE, "palpable face"), (HELD, "held"), (SECTION, f"{found.patient.organ_name}, cut")]
    entries += [(colour, names[tag]) for tag, colour in _region_colours(mesh).items()]
    figure.legend(
        handles=[Patch(color=tuple(colour), label=name) for colour, name in entries[:10]],
        loc="outside lower center",
        ncols=5,
        frameon=False,
    )


def _png(figure: Figure) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", facecolor=PAPER, metadata={"Software": None})
    return stream.getvalue()
