"""Fields of one press of a palpation: a series of files, and a picture at the end of the press."""

from pathlib import Path

import numpy as np

from msdm_core.mesh import triangle_lattice
from msdm_core.organ import FieldSeries
from surgsim_apps.palpate.palpation import PalpationResult
from surgsim_apps.reports.surface_drawing import INK, PAPER, OrthographicView, curved_patches, draw_patches, save_png
from surgsim_env.coupling import Simulation
from surgsim_env.palpation import SitePress, press_phases
from surgsim_env.rendering import COLOUR_MAP, PAINTED_FIELDS
from surgsim_env.step_progress import StepProgress

FIELDS_NAME, SERIES_NAME = "fields.png", "fields/press.pvd"
# Half the side of the picture around the tip, in tip radii.
WINDOW = 2.0


def record_press(palpation: PalpationResult, path: Path, picture: Path, progress: StepProgress) -> None:
    """Press over the first lesion, or at the first site of an organ without, and write the fields after each phase.

    Args:
        palpation: its result.
        path: of the series' pvd file.
        picture: PNG file of the fields at the end.
        progress: display of the steps.

    Raises:
        ValueError: a fault in the press.
    """
    anatomy, press = palpation.anatomy, palpation.presses[0]
    places = [*((truth.point, truth.normal) for truth in palpation.truths), (press.site, press.normal)]
    simulation = Simulation(anatomy)
    simulation.reset(anatomy.organ(palpation.lesions), simulation.instrument.parked)
    series = FieldSeries(path, simulation.organ_model)
    pressing, phases = SitePress(simulation, *places[0]), press_phases(anatomy.scene)
    with progress.step("recording the fields of a press", len(phases)) as advance:
        for phase in phases:
            if pressing.begin(phase):
                simulation.control_step(phase.count, phase.force_limit)
                pressing.end(phase)
                if simulation.fault:
                    raise ValueError(f"the press for --fields ended by a fault: {simulation.fault}; leave --fields out")
                series.add(simulation.time, simulation.organ_state, simulation.fields())
            advance(1)
    _write_picture(pressing, picture)


def _write_picture(press: SitePress, path: Path) -> None:
    """Write four fields on the pressed organ's surface around the tip, seen along the press."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    simulation = press.simulation
    model, fields, points = simulation.organ_model, simulation.fields(), simulation.organ_state.node_position
    view, radius = OrthographicView.along(-press.normal), simulation.anatomy.scene.instrument.tip_radius * 1e3
    (x, y), half = view.flat(simulation.instrument.tip_position), WINDOW * radius
    near = (np.abs(view.flat(points) - (x, y)).max(axis=1) < 1.5 * half)[model.surface_triangles].any(axis=1)
    triangles = model.surface_triangles[near]
    patches = curved_patches(points, triangles)
    lattice, small = triangle_lattice(round(np.sqrt(len(patches.origin) / len(triangles))))
    shares = np.tile(lattice[small].mean(axis=1) / lattice.max(), (len(triangles), 1))
    figure = Figure(figsize=(11.0, 9.6), dpi=110, facecolor=PAPER, layout="constrained")
    for axes, field in zip(figure.subplots(2, 2).flat, PAINTED_FIELDS.values(), strict=True):
        corners = field.node_values(model, fields)[triangles]
        values = (shares * corners[patches.origin]).sum(axis=1)
        norm = Normalize(field.lowest, field.scale_end(values))
        draw_patches(axes, [(patches, colormaps[COLOUR_MAP](norm(values))[:, :3], 0.0)], view, flatness=0.6)
        axes.add_patch(Circle((x, y), radius, fill=False, ls="--", color="white"))
        figure.colorbar(ScalarMappable(norm, COLOUR_MAP), ax=axes, shrink=0.8, pad=0.02)
        axes.set_title(f"{field.title} [{field.unit}]" if field.unit else field.title, color=INK, fontsize=11)
        axes.set_aspect("equal")
        axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half))
        axes.set_axis_off()
    save_png(figure, path)
