"""Fields of one press of a palpation: a series of files, and a picture at the end of the press."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msdm_core.mesh import FloatArray, IntArray, triangle_lattice
from msdm_core.organ import FieldSeries, TissueFields, frame_name
from surgsim_apps.palpate.palpation import PalpationResult
from surgsim_apps.reports.surface_drawing import (
    INK,
    PAPER,
    OrthographicView,
    curved_patches,
    draw_patches,
    save_png,
)
from surgsim_env.coupling import Simulation
from surgsim_env.palpation import SitePress, press_phases
from surgsim_env.scene import Scene
from surgsim_env.step_progress import StepProgress

FIELDS_NAME = "fields.png"
# Folder and stem of the series.
FOLDER, STEM = "fields", "press"
COLOUR_MAP = "inferno"
# Half the side of the picture around the site, in tip radii.
WINDOW = 3.5


@dataclass(frozen=True, eq=False)
class PressedFields:
    """Fields of the organ at the end of a press.

    Fields:
        site, normal: of the press [m], (3,) each
        points: present positions of the organ's nodes [m], (n_node, 3)
        triangles: of its surface, (n_surface, 3)
        nodal: contact pressure [kPa], von Mises stress [kPa], largest stretch, energy density [J/m^3], (n_node,) each
    """

    site: FloatArray
    normal: FloatArray
    points: FloatArray
    triangles: IntArray
    nodal: dict[str, FloatArray]


def field_names(scene: Scene) -> tuple[str, ...]:
    """Names of all files that `record_press` may write for a scene."""
    frames = [frame_name(STEM, number) for number in range(len(press_phases(scene)))]
    return tuple(f"{FOLDER}/{name}" for name in (f"{STEM}.pvd", *frames))


def record_press(palpation: PalpationResult, path: Path, progress: StepProgress) -> PressedFields:
    """Press over the first lesion, or at the first site of an organ without, and write the fields after each phase.

    Args:
        palpation: its result.
        path: of the series' pvd file.
        progress: display of the steps.

    Raises:
        ValueError: a fault in the press.
    """
    anatomy = palpation.anatomy
    first = next(iter(palpation.truths), None)
    press = palpation.presses[0]
    site, normal = (press.site, press.normal) if first is None else (first.point, first.normal)
    simulation = Simulation(anatomy)
    simulation.reset(anatomy.organ(palpation.lesions), simulation.instrument.parked)
    series = FieldSeries(path, simulation.organ_model)
    pressing, phases = SitePress(simulation, site, normal), press_phases(anatomy.scene)
    with progress.step("recording the fields of a press", len(phases)) as advance:
        for phase in phases:
            if pressing.begin(phase):
                simulation.control_step(phase.count, phase.force_limit)
                pressing.end(phase)
                if simulation.fault:
                    raise ValueError(f"the press for --fields ended by a fault: {simulation.fault}")
                series.add(simulation.time, simulation.organ_state, simulation.fields())
            advance(1)
    points, triangles = simulation.organ_state.node_position, simulation.organ_model.surface_triangles
    return PressedFields(site, normal, points, triangles, _at_nodes(simulation, simulation.fields()))


def _at_nodes(simulation: Simulation, fields: TissueFields) -> dict[str, FloatArray]:
    """Fields of the picture at nodes; those of triangles and tets as means by area and undeformed volume."""
    model = simulation.organ_model
    pressure = _node_means(model.surface_triangles, fields.area, fields.pressure, len(model.node_mass))
    stretch = fields.principal_stretch[:, 0]
    return {
        "contact pressure [kPa]": pressure * 1e-3,
        "von Mises stress [kPa]": fields.von_mises * 1e-3,
        "largest principal stretch": _node_means(model.tet_nodes, model.tet_rest_volume, stretch, len(pressure)),
        "energy density [J/m³]": fields.energy_density,
    }


def _node_means(nodes: IntArray, size: FloatArray, value: FloatArray, count: int) -> FloatArray:
    """Mean at each node (n_node,) of a value (n,) of the items around it, weighted by size; 0 without items."""
    rows, corners = nodes.ravel(), nodes.shape[1]
    total = np.bincount(rows, np.repeat(size * value, corners), count)
    weight = np.bincount(rows, np.repeat(size, corners), count)
    return np.divide(total, weight, out=np.zeros(count), where=weight > 0.0)


def write_fields_picture(pressed: PressedFields, scene: Scene, path: Path) -> None:
    """Write the four fields on the pressed organ's surface around the site, seen along the inward normal."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 9.6), dpi=110, facecolor=PAPER, layout="constrained")
    view = OrthographicView.along(-pressed.normal)
    half = WINDOW * scene.instrument.tip_radius * 1e3
    x, y = view.flat(pressed.site)
    near = np.abs(view.flat(pressed.points) - (x, y)).max(axis=1) < 1.5 * half
    triangles = pressed.triangles[near[pressed.triangles].any(axis=1)]
    patches = curved_patches(pressed.points, triangles)
    splits = round((len(patches.origin) / len(triangles)) ** 0.5)
    lattice, small = triangle_lattice(splits)
    weights = np.tile((lattice / splits)[small].mean(axis=1), (len(triangles), 1))
    shown = np.unique(triangles)
    for axes, (name, value) in zip(figure.subplots(2, 2).flat, pressed.nodal.items(), strict=True):
        norm = Normalize(float(value[shown].min()), float(value[shown].max()))
        field = (weights * value[triangles[patches.origin]]).sum(axis=1)
        draw_patches(axes, [(patches, colormaps[COLOUR_MAP](norm(field))[:, :3], 0.0)], view, flatness=0.75)
        figure.colorbar(ScalarMappable(norm, COLOUR_MAP), ax=axes, shrink=0.8, pad=0.02)
        axes.set_title(name, color=INK, fontsize=11)
        axes.set_aspect("equal")
        axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half), xlabel="[mm]")
        axes.set_axis_off()
    save_png(figure, path)
