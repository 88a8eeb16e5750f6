"""Heat maps of two arms on an organ's surface, and pictures of both where there is OpenGL.

In the pictures each arm has its tip at the point that `poses` names; an arm that reaches nothing stands at home.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.arm_study.ports import Ports
from surgsim_env.arm_study.results import (
    DISTANCES,
    QUANTITIES,
    SIDES,
    ArmsEvaluation,
    Quantity,
    reason_counts,
    share_text,
    sides,
    spread,
    values_of,
    worse_of_both,
)
from surgsim_env.instruments.arm.arm import Arm
from surgsim_env.palpation.surface_drawing import (
    INK,
    PAPER,
    OrthographicView,
    curved_patches,
    draw_patches,
    save_png,
)
from surgsim_env.rendering.cameras import Camera
from surgsim_env.rendering.renderer import DrawnCapsule, draw_still
from surgsim_env.reports.html_page import Picture
from surgsim_env.reports.output_folder import AnyFolder
from surgsim_env.reports.step_progress import StepProgress

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize

# Distinct for all kinds of colour blindness: viridis, which contains no grey, and Okabe & Ito's colours.
COLOUR_MAP = "viridis"
LEFT, RIGHT, BOTH, APART, NEITHER = "#0072b2", "#e69f00", "#009e73", "#cc79a7", "#bdbdbd"
# Colour of parts where no point was tried.
UNTRIED = "#f4e6de"
# Further from every point than this many of their usual distances, a part of the organ was not tried.
TRIED_WITHIN = 2.0
PORT_MARKS = {"left": ("L", LEFT), "right": ("R", RIGHT), "endoscope": ("E", INK)}
SPLITS = 2
NEIGHBOURS = 4
# Points whose normals differ by a right angle count as this much farther apart than they are, as a share of the
# organ's size: values of one side do not show on the other side of a thin lobe.
NORMAL_WEIGHT = 0.15
DPI = 100
# Share of a colour that the light does not change.
FLATNESS = 0.6

# Of a map: title, which points have a value, the values [SI], and a text about the other points.
Panel = tuple[str, NDArray[np.bool_], FloatArray, str]
SIZE = 960, 720
SCOPE, PORT, WALL = "#5c6470", "#f2bf33", (0.85, 0.65, 0.55, 0.18)
SCOPE_RADIUS, PORT_RADIUS = 0.005, 0.008
# The endoscope is drawn this far out of its port [m].
SCOPE_OUTSIDE = 0.18
# Fields of view of the camera beside the table and of the endoscope [degrees]; how far inside its port the latter's
# camera is [m].
BESIDE_FOV, SCOPE_FOV, SCOPE_TIP = 35.0, 70.0, 0.02
# Each tip is put this far from the middle of the common points, towards its own port [m].
ASIDE = 0.025


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
        """Write all maps into a folder: reach, each quantity, and the arms' distances; a step of `progress`."""
        # The two errors are checks of the method and the same everywhere: the table suffices.
        shown = [quantity for quantity in QUANTITIES if quantity.field not in ("position_error", "trocar_error")]
        quantities = [partial(self._write_quantity, quantity=quantity) for quantity in shown]
        written = []
        with (progress or StepProgress()).step("drawing the maps", len(quantities) + 2) as advance:
            for write in (self._write_reach, *quantities, self._write_distances):
                written.append(write(folder))
                advance(1)
        return written

    def _write_reach(self, folder: AnyFolder) -> Picture:
        from matplotlib.colors import to_rgb
        from matplotlib.figure import Figure
        from matplotlib.lines import Line2D

        one = self.evaluation
        left, right = one.left.reachable, one.right.reachable
        either = np.where(left, np.where(right, 2, 0), np.where(right, 1, 3))
        # Each arm reaches the point alone, but the arms would come too close.
        kind = np.where((either == 2) & ~one.both, 4, either)
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
        one = self.evaluation
        panels = [
            (f"{side} arm", arm.reachable, values_of(arm, quantity), _misses(reason_counts(arm)))
            for side, arm in sides(one)
        ]
        close = int((one.left.reachable & one.right.reachable & ~one.both).sum())
        missed = f"grey, points:\nnot reached by each arm: {int((~one.both).sum()) - close}\narms too close: {close}"
        panels.append(("both at once, the worse arm", one.both, worse_of_both(one, quantity), missed))
        name = f"map_{quantity.field}.png"
        sense = "more is better" if quantity.more_is_better else "less is better"
        label = f"{quantity.label}\n{sense}"
        self._write_panels(folder / name, quantity.title, label, quantity.scale, panels)
        text = "; ".join(
            f"{title}: {_spread(values, quantity)} over {share_text(mask[self._surface])} of the surface's points"
            for title, mask, values, _ in panels
        )
        title = quantity.title[0].upper() + quantity.title[1:]
        return Picture.of_file(folder / name, title, f"{text}. Grey: not reached. In the colours, {sense}.")

    def _write_distances(self, folder: AnyFolder) -> Picture:
        panels = []
        for field, title, _ in DISTANCES:
            values = getattr(self.evaluation, field)
            known = np.isfinite(values)
            place = title.removeprefix("distance between the arms ")
            panels.append((place, known, values, f"not reached by each arm: {int((~known).sum())}"))
        name, title = "map_arm_distance.png", "distance between the arms"
        self._write_panels(folder / name, title, "distance [mm]\nmore is better", 1e3, panels, shared=False)
        quantity = Quantity("", title, "mm", 1e3, 1, "_m", True, "")
        text = "; ".join(f"{panel[0]}: {_spread(panel[2], quantity)}" for panel in panels)
        return Picture.of_file(folder / name, "Distance between the arms", f"{text}. Grey: not reached by each arm.")

    def _write_panels(
        self, path: Path, heading: str, label: str, scale: float, panels: list[Panel], shared: bool = True
    ) -> None:
        """The organ as the camera sees it, once for each panel; a colour bar for all or for each."""
        from matplotlib import colormaps
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import to_rgb
        from matplotlib.figure import Figure

        groups = [panels] if shared else [[panel] for panel in panels]
        norms = [_norm(group, scale) for group in groups for _ in group]
        figure = Figure(
            figsize=(0.6 + 3.7 * len(panels), 4.15),
            dpi=DPI,
            facecolor=PAPER,
            layout="constrained",
        )
        row = figure.subplots(1, len(panels), squeeze=False)[0]
        grey = np.array(to_rgb(NEITHER))
        for axes, norm, (title, mask, values, missed) in zip(row, norms, panels, strict=True):
            tint = colormaps[COLOUR_MAP](norm(np.nan_to_num(values * scale)))[:, :3]
            dots = np.where(mask[:, None], tint, grey)
            colours = np.where(mask[self._nearest[:, :1]], self._painted(values * scale, mask, norm), grey)
            self._draw(axes, colours, dots, title)
            axes.text(0.5, -0.02, missed, transform=axes.transAxes, ha="center", va="top", fontsize=8, color=INK)
            if not shared:
                figure.colorbar(ScalarMappable(norm, COLOUR_MAP), ax=axes, shrink=0.6, pad=0.02, label=label)
        if shared:
            figure.colorbar(ScalarMappable(norms[0], COLOUR_MAP), ax=row, shrink=0.7, pad=0.02, label=label)
        if not any(np.isfinite(values).any() for _, _, values, _ in panels):
            heading = f"{heading}: nothing is reached"
        figure.suptitle(heading, fontsize=12, color=INK)
        save_png(figure, path)

    def _painted(self, values: FloatArray, mask: NDArray[np.bool_], norm: Normalize) -> FloatArray:
        """Colours of the patches: the points around each, those that are reached, weighted by nearness."""
        from matplotlib import colormaps

        weight = mask[self._nearest] / np.maximum(self._distance, 1e-6) ** 2
        total = weight.sum(axis=1)
        mean = (weight * np.nan_to_num(values)[self._nearest]).sum(axis=1) / np.where(total > 0.0, total, 1.0)
        return colormaps[COLOUR_MAP](norm(mean))[:, :3]

    def _draw(self, axes: Axes, colours: FloatArray, dots: FloatArray, title: str) -> None:
        """The organ painted, its points as dots, inner targets as diamonds, and the ports."""
        one, view = self.evaluation, self._view
        from matplotlib.colors import to_rgb

        painted = np.where(self._tried[:, None], colours, to_rgb(UNTRIED))
        # No gloss and little shading, which would look like values.
        draw_patches(axes, [(self._patches, painted, 0.0)], view, flatness=FLATNESS)
        facing = ~one.inner & (one.normals @ view.towards > 0.1)
        axes.scatter(*view.flat(one.points[facing]).T, s=3.0, color=INK, alpha=0.45, linewidths=0, zorder=2)
        if one.inner.any():
            places = view.flat(one.points[one.inner])
            axes.scatter(*places.T, s=26, marker="D", c=dots[one.inner], edgecolors=INK, linewidths=0.8, zorder=3)
        _mark_ports(axes, one, view)
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
    """Each port as a letter in a disc, and the way into the body from it as far as the organ's middle."""
    from matplotlib.patheffects import withStroke

    middle = evaluation.surface_points.mean(axis=0)
    for name, port in evaluation.ports.items():
        letter, colour = PORT_MARKS[name]
        start, into = np.array(port.point), np.array(port.into) / np.linalg.norm(port.into)
        path = view.flat(np.stack([start, start + max(0.0, float((middle - start) @ into)) * into]))
        halo = [withStroke(linewidth=3.2, foreground="white")]
        axes.plot(*path.T, color=colour, lw=1.4, ls=(0, (4, 2)), zorder=4, path_effects=halo)
        axes.plot(*path[0], "o", ms=12, color=colour, mec="white", mew=1.2, zorder=5)
        axes.text(
            path[0, 0], path[0, 1], letter, color="white", fontsize=8, weight="bold", ha="center", va="center", zorder=6
        )


def _norm(panels: list[Panel], scale: float) -> Normalize:
    """From the least to the greatest value of the panels."""
    from matplotlib.colors import Normalize

    known = np.concatenate([values[np.isfinite(values)] for _, _, values, _ in panels]) * scale
    least, most = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    return Normalize(least, most if most > least else least + 1.0)


def _misses(counts: list[tuple[str, int]]) -> str:
    if not counts:
        return "every point is reached"
    return "grey, points:\n" + "\n".join(f"{reason}: {count}" for reason, count in counts)


def _spread(values: FloatArray, quantity: Quantity) -> str:
    least, _, greatest = spread(values)
    if math.isnan(least):
        return "no value"
    return f"{quantity.text(least, with_unit=False)} to {quantity.text(greatest)}"


def poses(evaluation: ArmsEvaluation) -> dict[str, int]:
    """The point at which each arm is drawn: of those that both reach, beside their middle towards its own port."""
    found = {}
    for (side, arm), other in zip(sides(evaluation), SIDES[::-1], strict=True):
        mask = evaluation.both if evaluation.both.any() else arm.reachable
        known = np.flatnonzero(mask)
        if not len(known):
            continue
        middle = evaluation.points[known].mean(axis=0)
        apart = np.array(evaluation.ports[side].point) - np.array(evaluation.ports[other].point)
        middle = middle + ASIDE * apart / np.linalg.norm(apart)
        found[side] = int(known[np.argmin(np.linalg.norm(evaluation.points[known] - middle, axis=1))])
    return found


def draw_arms(evaluation: ArmsEvaluation, arms: tuple[Arm, Arm], ports: Ports) -> dict[str, NDArray[np.uint8]]:
    """Pictures (height, width, 3) by caption: from beside the table and through the endoscope's port.

    Raises:
        NoGLError: there is no OpenGL; names what is missing.
    """
    from matplotlib.colors import to_rgba

    places = poses(evaluation)
    joints = [
        reach.joints[places[side]] if side in places else arm.home
        for (side, reach), arm in zip(sides(evaluation), arms, strict=True)
    ]
    capsules = [DrawnCapsule(ends, radius, to_rgba(colour)) for ends, radius, colour in _fittings(evaluation)]
    if not ports.wall.plate:
        # Not seen by the endoscope's camera, which stands inside the dome: OpenGL leaves out the backs of surfaces.
        capsules.append(DrawnCapsule(np.stack([ports.dome_centre] * 2), ports.wall.radius, WALL))
    line = np.array(ports.right.point) - np.array(ports.left.point)
    point, target = np.array(ports.endoscope.point), np.array(ports.endoscope.target)
    ahead = (target - point) / np.linalg.norm(target - point)
    position, centre = _beside(evaluation, arms, joints, ports)
    cameras = {
        "The arms at their ports": Camera.looking(position, centre, ports.wall_normal, BESIDE_FOV),
        # The right arm comes from the right.
        "Through the endoscope": Camera.looking(point + SCOPE_TIP * ahead, target, np.cross(line, ahead), SCOPE_FOV),
    }
    posed = [(arm.model, mujoco.MjData(arm.model)) for arm in arms]
    for arm, (model, data), values in zip(arms, posed, joints, strict=True):
        arm.write(data, values)
        mujoco.mj_kinematics(model, data)
    surface = evaluation.surface_points, evaluation.surface_triangles
    frames = draw_still(surface, posed, capsules, list(cameras.values()), SIZE)
    return dict(zip(cameras, frames, strict=True))


def _beside(
    evaluation: ArmsEvaluation, arms: tuple[Arm, Arm], joints: list[FloatArray], ports: Ports
) -> tuple[FloatArray, FloatArray]:
    """A camera's position and target [m]: on the side away from the arms' bases, so far that it sees all shapes."""
    ends = np.concatenate([arm.shape_ends(one).reshape(-1, 3) for arm, one in zip(arms, joints, strict=True)])
    middle = evaluation.points[~evaluation.inner].mean(axis=0)
    line = np.array(ports.right.point) - np.array(ports.left.point)
    away = np.cross(line, ports.wall_normal)
    away /= np.linalg.norm(away)
    if (ends.mean(axis=0) - middle) @ away > 0.0:
        away = -away
    everything = np.concatenate([ends, middle[None]])
    centre = 0.5 * (everything.min(axis=0) + everything.max(axis=0))
    radius = float(np.linalg.norm(everything - centre, axis=1).max())
    direction = 0.88 * away + 0.48 * ports.wall_normal + 0.15 * line / np.linalg.norm(line)
    direction /= np.linalg.norm(direction)
    return centre + 1.05 * radius / np.sin(np.radians(0.5 * BESIDE_FOV)) * direction, centre


def _fittings(evaluation: ArmsEvaluation) -> list[tuple[FloatArray, float, str]]:
    """Ends [m] (2, 3), radius [m] and colour of the ports and the endoscope."""
    found = []
    for name, port in evaluation.ports.items():
        point, into = np.array(port.point), np.array(port.into) / np.linalg.norm(port.into)
        found.append((np.stack([point, point]), PORT_RADIUS, PORT))
        if name == "endoscope":
            found.append((np.stack([point - SCOPE_OUTSIDE * into, point]), SCOPE_RADIUS, SCOPE))
    return found


def write_images(pictures: Mapping[str, NDArray[np.uint8]], folder: AnyFolder) -> list[Picture]:
    """Write pictures of the arms, RGB images by caption, as PNG files, numbered from 1."""
    from matplotlib.image import imsave

    written = []
    for number, (title, image) in enumerate(pictures.items(), start=1):
        path = folder / f"arms_{number}.png"
        imsave(path, np.ascontiguousarray(image), format="png")
        shown = "Each tip is at a point that its arm reaches; an arm that reaches none stands at home."
        written.append(Picture.of_file(path, title, shown))
    return written
