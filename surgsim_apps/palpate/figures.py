"""Pictures of a palpation: both contrast maps on the organ with force-depth curves; the organ with its probe."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_apps.palpate.contrast_map import ContrastMap
from surgsim_apps.palpate.palpation import PalpationResult
from surgsim_apps.palpate.truth import Truth
from surgsim_apps.reports.surface_drawing import (
    FADE_TO,
    INK,
    PAPER,
    OrthographicView,
    Patches,
    curved_patches,
    draw_patches,
    interpolated,
    nearness,
    organ_patches,
    save_png,
    tube,
)
from surgsim_env.scene import tangent_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TISSUE = np.array([0.80, 0.73, 0.68])
LIVER = np.array([0.56, 0.20, 0.16])
STEEL = np.array([0.80, 0.83, 0.88])
NIGHT = "#0e1117"
COLOUR_MAP = "magma"
# Reach of the glow beyond the last sites, in site spacings.
GLOW_REACH = 2.6
# Least upper end of the colour scale: a map without a lesion looks flat.
SMALLEST_TOP = 1.35


def write_stiffness_map(palpation: PalpationResult, path: Path) -> None:
    """Write the picture of both maps with the estimated lesions, and force over depth on and off a lesion."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16.5, 5.6), dpi=110, facecolor=PAPER, layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 0.72))
    scene = palpation.anatomy.scene
    figure.suptitle(
        f"{scene.name}: {len(palpation.presses)} presses of {scene.palpation.press_depth * 1e3:g} mm with a "
        f"{scene.instrument.tip_radius * 1e3:g} mm ball (dashed: the hidden lesions, crosses: where they were felt)",
        color=INK,
        fontsize=12,
    )
    view = OrthographicView.along(palpation.anatomy.face.approach)
    patches = organ_patches(palpation.anatomy)
    for axes, contrast_map in zip((left, middle), palpation.maps, strict=True):
        _draw_map(figure, axes, palpation, contrast_map, patches, view)
    _draw_curves(right, palpation)
    save_png(figure, path)


def write_organ_picture(palpation: PalpationResult, path: Path) -> None:
    """Write the organ with its contrast map as a glow and the probe on the strongest estimated lesion."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 6.2), dpi=120, facecolor=NIGHT)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    scene = palpation.anatomy.scene
    model_map = palpation.model_map
    place = model_map.estimates[0].point if model_map.estimates else palpation.sites[0]
    site, normal = palpation.anatomy.face.project(place)
    approach = palpation.anatomy.face.approach
    right, up = tangent_axes(approach)
    # From beside the approach, so that the probe's shaft is visible.
    view = OrthographicView.along(approach + 0.45 * up + 0.35 * right, up=-approach + 0.8 * up)
    organ = organ_patches(palpation.anatomy)
    colours = np.broadcast_to(LIVER, (len(organ.corners), 3)).copy()
    glow, weight = _map_over(palpation, model_map, organ, everywhere=True)
    painted = np.flatnonzero(weight > 0.0)
    strength = np.clip((glow[painted] - 1.0) / (max(SMALLEST_TOP, model_map.contrast.max()) - 1.0), 0.0, 1.0)
    heat = _colours("inferno", 0.42 + 0.55 * strength)
    share = (weight[painted] * np.clip(strength * 2.2, 0.0, 0.95))[:, None]
    colours[painted] = (1.0 - share) * colours[painted] + share * heat
    radius = scene.instrument.tip_radius
    ball = site + normal * (radius - scene.palpation.press_depth)
    handle = -approach
    draw_patches(axes, [(organ, colours, 0.30)], view)
    _mark_sites(axes, palpation, view, colour="white", alpha=0.35)
    parts = []
    for start, end, thickness in ((ball, ball, radius), (ball, ball + handle * 0.11, 0.004)):
        shape = curved_patches(*tube(start, end, thickness))
        parts.append((shape, np.broadcast_to(STEEL, (len(shape.corners), 3)), 0.55))
    draw_patches(axes, parts, view, zorder=3)
    axes.set_aspect("equal")
    axes.margins(0.04)
    save_png(figure, path, facecolor=NIGHT)


def _draw_map(
    figure: Figure,
    axes: Axes,
    palpation: PalpationResult,
    contrast_map: ContrastMap,
    patches: Patches,
    view: OrthographicView,
) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    norm = Normalize(
        min(0.85, float(contrast_map.contrast.min())), max(SMALLEST_TOP, float(contrast_map.contrast.max()))
    )
    field, weight = _map_over(palpation, contrast_map, patches)
    tint = _colours(COLOUR_MAP, norm(field))
    colours = (1.0 - weight[:, None]) * TISSUE + weight[:, None] * tint
    draw_patches(axes, [(patches, colours, 0.10)], view)
    _mark_sites(axes, palpation, view, colour="white", alpha=0.55)
    for score in contrast_map.scores:
        _outline(axes, score.truth, view)
    _mark_estimates(axes, contrast_map, view)
    figure.colorbar(
        ScalarMappable(norm, COLOUR_MAP),
        ax=axes,
        shrink=0.75,
        pad=0.02,
        label=f"stiffness / that of the {contrast_map.name}",
    )
    axes.set_title(f"against the {contrast_map.name}\n{_result(contrast_map)}", color=INK, fontsize=11)
    axes.set_aspect("equal")
    axes.set_axis_off()


def _result(contrast_map: ContrastMap) -> str:
    errors = ", ".join(f"{score.error * 1e3:.0f} mm" for score in contrast_map.scores if score.felt)
    text = f"felt {contrast_map.felt_count} of {len(contrast_map.scores)}" + (f", off by {errors}" if errors else "")
    alarms = f"; {contrast_map.false_alarms} false" if contrast_map.false_alarms else ""
    healthy = f"healthy sites 1 ± {contrast_map.healthy_std:.2f}"
    return f"{text if contrast_map.scores else 'no lesion hidden'}{alarms}; {healthy}"


def _map_over(
    palpation: PalpationResult, contrast_map: ContrastMap, patches: Patches, everywhere: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Value of a map on each patch and its weight, 0 off the palpable face unless `everywhere`."""
    anatomy = palpation.anatomy
    palpable = set(map(frozenset, anatomy.face.triangles.tolist()))
    chosen = np.array([frozenset(row) in palpable for row in anatomy.mesh.boundary_triangles.tolist()])
    on_face = everywhere | chosen[patches.origin]
    centres = patches.corners[on_face].mean(axis=1)
    sites = palpation.sites[palpation.used]
    field, weight = np.ones(len(on_face)), np.zeros(len(on_face))
    field[on_face] = interpolated(sites, contrast_map.contrast, centres)
    weight[on_face] = nearness(
        sites, centres, anatomy.scene.palpation.site_spacing, GLOW_REACH if everywhere else FADE_TO
    )
    return field, weight


def _mark_sites(axes: Axes, palpation: PalpationResult, view: OrthographicView, *, colour: str, alpha: float) -> None:
    places = view.flat(palpation.sites)
    used = palpation.used
    axes.scatter(*places[used].T, s=5, color=colour, alpha=alpha, linewidths=0, zorder=2)
    if not used.all():
        axes.scatter(*places[~used].T, s=22, marker="s", facecolors="none", edgecolors="#2f6fde", zorder=2)


def _outline(axes: Axes, truth: Truth, view: OrthographicView) -> None:
    """Draw a lesion's circle on the surface above it, around the estimates within its radius."""
    first, second = tangent_axes(truth.normal)
    angle = np.linspace(0.0, 2.0 * np.pi, 90)[:, None]
    circle = view.flat(truth.point + truth.radius * (np.cos(angle) * first + np.sin(angle) * second))
    for colour, width in ((INK, 2.6), ("white", 1.4)):
        axes.plot(*circle.T, color=colour, lw=width, ls=(0, (4, 2.5)), zorder=3)


def _mark_estimates(axes: Axes, contrast_map: ContrastMap, view: OrthographicView) -> None:
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=3.0, foreground=INK)]
    errors = {score.estimate: score.error for score in contrast_map.scores if score.felt}
    for index, estimate in enumerate(contrast_map.estimates):
        x, y = view.flat(estimate.point)
        colour = "#9cf6ff" if index in errors else "#ffb3a7"
        text = f"{errors[index] * 1e3:.1f} mm" if index in errors else "false"
        axes.plot(x, y, "+", ms=12, mew=4.2, color=INK, zorder=4)
        axes.plot(x, y, "+", ms=11, mew=2.0, color=colour, zorder=5)
        axes.annotate(
            text, (x, y), (8, 7), textcoords="offset points", color=colour, fontsize=10, path_effects=halo, zorder=6
        )


def _draw_curves(axes: Axes, palpation: PalpationResult) -> None:
    """Draw force over depth at the sites of `_typical_sites`."""
    numbers = np.flatnonzero(palpation.used)
    stiff, usual = _typical_sites(palpation)
    for index, colour, name in ((stiff, "#c8452f", "over a lesion"), (usual, "#3b6ea8", "over healthy tissue")):
        if index is None:
            continue
        number = int(numbers[index])
        curve, model = palpation.presses[number].curve, palpation.model_presses[number].curve
        axes.plot(curve[:, 0] * 1e3, curve[:, 1], color=colour, lw=2.2, label=f"{name} (site {number})")
        axes.plot(model[:, 0] * 1e3, model[:, 1], color=colour, lw=1.2, ls="--", label="there in the model")
    axes.set_xlabel("depth of the tip below the resting surface [mm]")
    axes.set_ylabel("force along the normal [N]")
    axes.set_title("force over depth, and the hold at the end", color=INK, fontsize=11)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlim(left=0.0)
    axes.set_ylim(bottom=0.0)
    axes.legend(frameon=False, fontsize=9, loc="upper left")


def _typical_sites(palpation: PalpationResult) -> tuple[int | None, int | None]:
    """Indices of the used sites with the largest contrast above a lesion and with the healthy one closest to 1."""
    contrast, sites = palpation.model_map.contrast, palpation.sites[palpation.used]
    distance = np.full(len(sites), np.inf)
    for truth in palpation.truths:
        distance = np.minimum(distance, np.linalg.norm(sites - truth.point, axis=1) / truth.radius)
    over, off = np.flatnonzero(distance <= 1.0), np.flatnonzero(distance > 2.0)
    stiff = int(over[np.argmax(contrast[over])]) if len(over) else None
    usual = int(off[np.argmin(np.abs(contrast[off] - 1.0))]) if len(off) else None
    return stiff, usual


def _colours(name: str, values: FloatArray) -> FloatArray:
    from matplotlib import colormaps

    return colormaps[name](np.asarray(values))[:, :3]
