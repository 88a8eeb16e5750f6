"""Heat maps of two arms on an organ's surface, and with OpenGL a picture of both at home."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from msdm_core.mesh import FloatArray
from surgsim_apps.arms.arm_picture import filling_camera
from surgsim_apps.arms.ports import Ports
from surgsim_apps.arms.quantities import QUANTITIES, Quantity
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
from surgsim_env.instruments import Arm
from surgsim_env.rendering import DrawnCapsule, draw_still
from surgsim_env.step_progress import StepProgress

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize

# Distinct for all kinds of colour blindness: viridis, which contains no grey, and Okabe & Ito's colours.
COLOUR_MAP = "viridis"
LEFT, RIGHT, BOTH, APART, NEITHER = "#0072b2", "#e69f00", "#009e73", "#cc79a7", "#bdbdbd"
# Colour of parts without a tried point.
UNTRIED = "#f4e6de"
# Largest distance of a tried part of the organ from a point, over the points' usual spacing.
TRIED_WITHIN = 2.0
PORT_MARKS = {"left": ("L", LEFT), "right": ("R", RIGHT), "endoscope": ("E", INK)}
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
SIZE = 960, 720
SCOPE, PORT, WALL = (0.36, 0.39, 0.44, 1.0), (0.95, 0.75, 0.2, 1.0), (0.85, 0.65, 0.55, 0.18)
SCOPE_RADIUS, PORT_RADIUS = 0.005, 0.008
# Length of the drawn endoscope outside its port [m].
SCOPE_OUTSIDE = 0.18
# Field of view of the camera beside the table [degrees], and share of the arms in the picture.
BESIDE_FOV, SHARE = 35.0, 0.85


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

        evaluation = self.evaluation
        left, right = evaluation.left.reachable, evaluation.right.reachable
        either = np.where(left, np.where(right, 2, 0), np.where(right, 1, 3))
        # Each arm reaches the point alone, but the arms would come too close.
        kind = np.where((either == 2) & ~evaluation.both, 4, either)
        palette = np.array([to_rgb(colour) for colour in (LEFT, RIGHT, BOTH, NEITHER, APART)])
        names = ("left arm only", "right arm only", "both at once", "neither", "each, but not both at once")
        figure = Figure(figsize=(7.5, 4.2), dpi=DPI, facecolor=PAPER, layout="constrained")
        self._draw(figure.subplots(), palette[kind[self._nearest[:, 0]]], palette[kind], "from the camera")
        shown = [index for index in (2, 0, 1, 4, 3) if (kind == index).any()]
        labels = [f"{names[index]}: {share_text(kind[self._surface] == index)}" for index in shown]
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
        letter, colour = PORT_MARKS[name]
        place = view.flat(np.array([port.point]))[0]
        axes.plot(*place, "o", ms=12, color=colour, mec="white", mew=1.2, zorder=5)
        axes.text(
            place[0], place[1], letter, color="white", fontsize=8, weight="bold", ha="center", va="center", zorder=6
        )


def _norm(panels: list[Panel], scale: float) -> Normalize:
    """From the least to the greatest value of the panels."""
    from matplotlib.colors import Normalize

    known = np.concatenate([values[np.isfinite(values)] for _, _, values in panels]) * scale
    least, most = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    return Normalize(least, most if most > least else least + 1.0)


def draw_arms(evaluation: ArmsEvaluation, arms: Sequence[Arm], ports: Ports) -> NDArray[np.uint8]:
    """A picture (720, 960, 3) of the arms at home in their ports, from beside the table.

    Raises:
        NoGLError: there is no OpenGL; names what is missing.
    """
    posed = [(arm.model, mujoco.MjData(arm.model)) for arm in arms]
    for arm, (model, data) in zip(arms, posed, strict=True):
        arm.write(data, arm.home)
        mujoco.mj_kinematics(model, data)
    capsules = [DrawnCapsule(np.array([port.point] * 2), PORT_RADIUS, PORT) for port in evaluation.ports.values()]
    scope = evaluation.ports["endoscope"]
    point, into = np.array(scope.point), np.array(scope.into) / np.linalg.norm(scope.into)
    capsules.append(DrawnCapsule(np.stack([point - SCOPE_OUTSIDE * into, point]), SCOPE_RADIUS, SCOPE))
    if not ports.wall.plate:
        capsules.append(DrawnCapsule(np.stack([ports.dome_centre] * 2), ports.wall.radius, WALL))
    ends = np.concatenate([arm.shape_ends(arm.home).reshape(-1, 3) for arm in arms])
    line, up = np.array(ports.right.point) - np.array(ports.left.point), ports.wall_normal
    away = np.cross(line, up) / np.linalg.norm(line)
    # From the side away from the arms' bases.
    if (ends.mean(axis=0) - evaluation.surface_points.mean(axis=0)) @ away > 0.0:
        away = -away
    seen = np.concatenate([ends, evaluation.surface_points])
    camera = filling_camera(seen, 0.88 * away + 0.48 * up, up, BESIDE_FOV, SIZE[0] / SIZE[1], SHARE)
    surface = evaluation.surface_points, evaluation.surface_triangles
    return draw_still(surface, posed, capsules, [camera], SIZE)[0]


def write_picture(image: NDArray[np.uint8], path: Path) -> Picture:
    """Write the picture of the arms as a PNG file."""
    from matplotlib.image import imsave

    imsave(path, np.ascontiguousarray(image), format="png")
    return Picture.of_file(path, "The arms at their ports", "Both arms at home, the endoscope, the ports and the wall.")
