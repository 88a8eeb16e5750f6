"""Heat maps of two arms on an organ's surface."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from msdm_core.mesh import FloatArray
from surgsim_apps.arms.quantities import QUANTITIES, Quantity
from surgsim_apps.arms.reach_kinds import PORT_COLOURS, REACH_KINDS, reach_kinds
from surgsim_apps.arms.results import ArmsEvaluation
from surgsim_apps.arms.wording import share_text
from surgsim_apps.reports.html_page import Picture
from surgsim_apps.reports.output_folder import AnyFolder
from surgsim_apps.reports.surface_drawing import (
    INK,
    PAPER,
    OrthographicView,
    curved_patches,
    draw_patches,
    save_png,
)
from surgsim_env.step_progress import StepProgress

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize

# Distinct for all kinds of colour blindness, and without grey.
COLOUR_MAP = "viridis"
NEITHER = REACH_KINDS[-1].colour
# Colour of parts without a tried point.
UNTRIED = "#f4e6de"
# Largest distance of a tried part of the organ from a point, over the points' usual spacing.
TRIED_WITHIN = 2.0
SPLITS = 2
NEIGHBOURS = 4
# Extra distance between points with normals at a right angle, as a share of the organ's size: values of one side do not
# show on the other side of a thin lobe.
NORMAL_WEIGHT = 0.15
DPI = 100
# Share of a colour unaffected by light.
FLATNESS = 0.6

# Of a map: title, mask of points with a value, and the values [SI].
Panel = tuple[str, NDArray[np.bool_], FloatArray]


class ArmMaps:
    """The heat maps of one evaluation; the organ's patches and their nearest points are computed once."""

    def __init__(self, evaluation: ArmsEvaluation) -> None:
        """Take an evaluation."""
        self.evaluation = evaluation
        self._patches = curved_patches(evaluation.surface_points, evaluation.surface_triangles, SPLITS)
        surface = ~evaluation.inner
        self._surface = np.flatnonzero(surface)
        size = float(np.ptp(evaluation.surface_points, axis=0).max())
        weight = NORMAL_WEIGHT * size
        tree = KDTree(np.hstack([evaluation.points[surface], weight * evaluation.normals[surface]]))
        count = min(NEIGHBOURS, len(self._surface))
        places = np.hstack([self._patches.corners.mean(axis=1), weight * self._patches.normals])
        distance, index = tree.query(places, k=count)
        self._distance = np.reshape(distance, (-1, count))
        self._nearest = self._surface[np.reshape(index, (-1, count))]
        spacing = float(np.median(tree.query(tree.data, k=2)[0][:, -1]))
        self._tried = self._distance[:, 0] <= TRIED_WITHIN * spacing
        self._view = camera_view(evaluation)

    def write_all(self, folder: AnyFolder, progress: StepProgress | None = None) -> list[Picture]:
        """Write all maps into a folder: reach, and each quantity; a step of `progress`."""
        # The two errors are checks of the method and the same everywhere: the table suffices.
        shown = [quantity for quantity in QUANTITIES if quantity.field not in ("position_error", "trocar_error")]
        quantities = [partial(self._write_quantity, quantity=quantity) for quantity in shown]
        written = []
        with (progress or StepProgress()).step("drawing the maps", len(quantities) + 1) as advance:
            for write in (self._write_reach, *quantities):
                written.append(write(folder))
                advance(1)
        return written

    def _write_reach(self, folder: AnyFolder) -> Picture:
        from matplotlib.colors import to_rgb
        from matplotlib.figure import Figure
        from matplotlib.lines import Line2D

        kind = reach_kinds(self.evaluation)
        palette = np.array([to_rgb(each.colour) for each in REACH_KINDS])
        figure = Figure(figsize=(7.5, 4.2), dpi=DPI, facecolor=PAPER, layout="constrained")
        self._draw(figure.subplots(), palette[kind[self._nearest[:, 0]]], palette[kind], "from the camera")
        shown = [index for index in range(len(REACH_KINDS)) if (kind == index).any()]
        labels = [f"{REACH_KINDS[index].name}: {share_text(kind[self._surface] == index)}" for index in shown]
        handles = [
            Line2D([], [], marker="s", ls="", ms=10, color=palette[index], label=label)
            for index, label in zip(shown, labels, strict=True)
        ]
        if not self._tried.all():
            handles.append(Line2D([], [], marker="s", ls="", ms=10, color=UNTRIED, label="no points there"))
        figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=10)
        figure.suptitle("which arm reaches which part of the organ", fontsize=12, color=INK)
        save_png(figure, folder / "map_reach.png")
        return Picture.of_file(folder / "map_reach.png", "Who reaches what", f"The organ's parts: {', '.join(labels)}.")

    def _write_quantity(self, folder: AnyFolder, quantity: Quantity) -> Picture:
        evaluation = self.evaluation
        panels = [(f"{side} arm", arm.reachable, quantity.values(arm)) for side, arm in evaluation.arms.items()]
        panels.append(("both at once, the worse arm", evaluation.both, quantity.worse_of_both(evaluation)))
        name = f"map_{quantity.field}.png"
        sense = "more is better" if quantity.more_is_better else "less is better"
        label = f"{quantity.label}\n{sense}"
        self._write_panels(folder / name, quantity.title, label, quantity.scale, panels)
        title = quantity.title[0].upper() + quantity.title[1:]
        return Picture.of_file(
            folder / name, title, f"{quantity.definition} Grey: not reached. In the colours, {sense}."
        )

    def _write_panels(self, path: Path, heading: str, label: str, scale: float, panels: list[Panel]) -> None:
        """The organ as the camera sees it, once for each panel, with a colour bar for all."""
        from matplotlib import colormaps
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import to_rgb
        from matplotlib.figure import Figure

        norm = _norm(panels, scale)
        figure = Figure(
            figsize=(0.6 + 3.7 * len(panels), 4.15),
            dpi=DPI,
            facecolor=PAPER,
            layout="constrained",
        )
        row = figure.subplots(1, len(panels), squeeze=False)[0]
        grey = np.array(to_rgb(NEITHER))
        for axes, (title, mask, values) in zip(row, panels, strict=True):
            tint = colormaps[COLOUR_MAP](norm(np.nan_to_num(values * scale)))[:, :3]
            dots = np.where(mask[:, None], tint, grey)
            colours = np.where(mask[self._nearest[:, :1]], self._painted(values * scale, mask, norm), grey)
            self._draw(axes, colours, dots, title)
        figure.colorbar(ScalarMappable(norm, COLOUR_MAP), ax=row, shrink=0.7, pad=0.02, label=label)
        if not any(np.isfinite(values).any() for _, _, values in panels):
            heading = f"{heading}: nothing is reached"
        figure.suptitle(heading, fontsize=12, color=INK)
        save_png(figure, path)

    def _painted(self, values: FloatArray, mask: NDArray[np.bool_], norm: Normalize) -> FloatArray:
        """Colours of the patches: means over the reached points around each, weighted by nearness."""
        from matplotlib import colormaps

        weight = mask[self._nearest] / np.maximum(self._distance, 1e-6) ** 2
        total = weight.sum(axis=1)
        mean = (weight * np.nan_to_num(values)[self._nearest]).sum(axis=1) / np.where(total > 0.0, total, 1.0)
        return colormaps[COLOUR_MAP](norm(mean))[:, :3]

    def _draw(self, axes: Axes, colours: FloatArray, dots: FloatArray, title: str) -> None:
        """The organ painted, its points as dots, inner targets as diamonds, and the ports."""
        evaluation, view = self.evaluation, self._view
        from matplotlib.colors import to_rgb

        painted = np.where(self._tried[:, None], colours, to_rgb(UNTRIED))
        # No gloss and little shading, which would look like values.
        draw_patches(axes, [(self._patches, painted, 0.0)], view, flatness=FLATNESS)
        facing = ~evaluation.inner & (evaluation.normals @ view.towards > 0.1)
        axes.scatter(*view.flat(evaluation.points[facing]).T, s=3.0, color=INK, alpha=0.45, linewidths=0, zorder=2)
        if evaluation.inner.any():
            places = view.flat(evaluation.points[evaluation.inner])
            axes.scatter(
                *places.T, s=26, marker="D", c=dots[evaluation.inner], edgecolors=INK, linewidths=0.8, zorder=3
            )
        _mark_ports(axes, evaluation, view)
        axes.set_title(title, fontsize=10, color=INK)
        axes.set_aspect("equal")
        axes.margins(0.03)
        axes.set_axis_off()


def camera_view(evaluation: ArmsEvaluation) -> OrthographicView:
    """The view along the endoscope."""
    direction = np.array(evaluation.ports["endoscope"].into)
    direction = direction / np.linalg.norm(direction)
    # The patient's head is up (z); where the view is along z, the back is (y).
    return OrthographicView.along(direction, np.array([0.0, 0.0, 1.0] if abs(direction[2]) < 0.9 else [0.0, 1.0, 0.0]))


def _mark_ports(axes: Axes, evaluation: ArmsEvaluation, view: OrthographicView) -> None:
    """Each port as a letter in a disc."""
    for name, port in evaluation.ports.items():
        x, y = view.flat(np.array([port.point]))[0]
        axes.plot(x, y, "o", ms=12, color=PORT_COLOURS[name], mec="white", mew=1.2, zorder=5)
        axes.text(x, y, name[0].upper(), color="white", fontsize=8, weight="bold", ha="center", va="center", zorder=6)


def _norm(panels: list[Panel], scale: float) -> Normalize:
    """From the least to the greatest value of the panels."""
    from matplotlib.colors import Normalize

    known = np.concatenate([values[np.isfinite(values)] for _, _, values in panels]) * scale
    least, most = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    return Normalize(least, most if most > least else least + 1.0)
