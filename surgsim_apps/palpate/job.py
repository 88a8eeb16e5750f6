"""A palpation: press an organ site by site, map its contrast against two baselines, estimate lesions, report them."""

import csv
import json
import math
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from msdm_core.arithmetic import cos, exp, matmul, norm, sin
from msdm_core.material import Lesion
from msdm_core.mesh import FloatArray
from surgsim_apps.palpate.contrast_map import (
    ContrastMap,
    LesionScore,
    contrast_with_model,
    contrast_with_neighbours,
    feel_lesions,
    score_map,
)
from surgsim_apps.palpate.hold import Hold, hold_of
from surgsim_apps.palpate.misses import Miss, explain_misses
from surgsim_apps.palpate.truth import Truth, seen_from_surface
from surgsim_env.coupling import ForceReading
from surgsim_env.palpation import Press, scan
from surgsim_env.scene import (
    SUPPORT_TIP_RADII,
    Anatomy,
    Ball,
    ForceSensor,
    PalpableFace,
    contact_radius,
    hidden_share,
    tangent_axes,
)

# Errors of the pre-operative model: modulus by up to this share, place of each press by this distance [m].
MODEL_MODULUS_ERROR = 0.2
MODEL_SITE_ERROR = 0.002
# Decay length of the rim's influence on stiffness [m].
RIM_REACH = 0.015

NEIGHBOURS = "healthy neighbours"
MODEL = "pre-operative model"
CSV_NAME, SUMMARY_NAME, PICTURE_NAME = "palpation.csv", "summary.json", "stiffness_map.png"
COLUMNS = (
    *("site", "x", "y", "z", "normal_x", "normal_y", "normal_z", "depth", "force", "reading", "stiffness"),
    *("contrast_neighbours", "contrast_model", "ended_early"),
)


@dataclass(frozen=True, eq=False)
class PalpationResult:
    """Result of a palpation.

    Fields:
        anatomy, lesions, truths: the organ, its hidden lesions, and their places on the surface
        presses: of the organ, one per site
        model_presses: of the pre-operative model, at sites that are MODEL_SITE_ERROR off
        reading: of the force sensor along the normal at the end of each press [N]                 (n_site,)
        used: sites whose two presses both reached the set depth and read a force above 0           (n_site,)
        maps: against the healthy neighbours and against the model; they hold the used sites only
        misses: why lesions were not felt, for each map that does not show one
        hold: how the healthy model's presses were borne; None where none of them was complete
        model_modulus_factor: modulus of the model over the true one
        support_count: raster sites too near to a support, which were not pressed
        seed, wall_time [s]: of the run
    """

    anatomy: Anatomy
    lesions: tuple[Lesion, ...]
    truths: tuple[Truth, ...]
    presses: tuple[Press, ...]
    model_presses: tuple[Press, ...]
    reading: FloatArray
    used: np.ndarray
    maps: tuple[ContrastMap, ...]
    misses: tuple[Miss, ...]
    hold: Hold | None
    model_modulus_factor: float
    support_count: int
    seed: int
    wall_time: float

    @property
    def sites(self) -> FloatArray:
        """The pressed sites [m], shape (n_site, 3)."""
        return np.array([press.site for press in self.presses])

    @property
    def simulated_time(self) -> float:
        """Duration of the presses of the organ and of its model [s]."""
        return math.fsum(press.duration for press in (*self.presses, *self.model_presses))


def run_palpation(
    anatomy: Anatomy,
    *,
    lesions: Sequence[Lesion] | None = None,
    around: Ball | None = None,
    seed: int = 0,
    console: Console | None = None,
) -> PalpationResult:
    """Palpate a scene's organ; the same scene, lesions and seed give the same result.

    Args:
        anatomy: the organ; its scene defines the press (see load_anatomy).
        lesions: hidden in the organ; the scene's demonstration lesions by default.
        around: press only the raster sites inside this ball.
        seed: of sensor noise and of the errors of the pre-operative model.
        console: where the progress bar is shown; nowhere by default.

    Raises:
        ValueError: the palpable face has no site to press, or no press reached the set depth.
        OrganError: a lesion or a material that is impossible, or a step that is too long.
    """
    begin = time.perf_counter()
    scene = anatomy.scene
    hidden = tuple(anatomy.demonstration_lesions() if lesions is None else lesions)
    rng = np.random.default_rng(seed)
    sites, normals, support_count = plan_sites(anatomy, around)
    factor = float(rng.uniform(1.0 - MODEL_MODULUS_ERROR, 1.0 + MODEL_MODULUS_ERROR))
    organ, model = anatomy.organ(hidden), anatomy.organ(modulus_factor=factor)
    model_sites, model_normals = _displaced(anatomy.face, sites, normals, rng)
    with press_progress(console) as bar:
        presses = scan(anatomy, organ, sites, normals, progress=progress_task(bar, "organ", len(sites)))
        step = progress_task(bar, "its pre-operative model", len(sites))
        model_presses = scan(anatomy, model, model_sites, model_normals, progress=step)
        reading = _read(presses, scene.sensor, rng)
        model_reading = _read(model_presses, scene.sensor, rng)
        complete = np.array([not (one.end or two.end) for one, two in zip(presses, model_presses, strict=True)])
        # Bias and noise may exceed the force of a weak press; such a site has no stiffness.
        used = complete & (reading > 0.0) & (model_reading > 0.0)
        if not used.any():
            why = presses[0].end or model_presses[0].end or "a force reading that is not above 0"
            depth = scene.palpation.press_depth * 1e3
            raise ValueError(
                f"no press gave a stiffness at the set depth of {depth:g} mm; the first ended by: {why}: change the "
                "press depth, limits.hard_force or the sensor"
            )
        truths = tuple(seen_from_surface(hidden, anatomy))
        maps = _maps(anatomy, presses, model_presses, (reading, model_reading), used, truths)
        misses = explain_misses(
            anatomy,
            organ,
            hidden,
            truths,
            maps,
            sites[used],
            sites[~used],
            progress=lambda count: progress_task(bar, "over missed lesions", count),
        )
    return PalpationResult(
        anatomy=anatomy,
        lesions=hidden,
        truths=truths,
        presses=tuple(presses),
        model_presses=tuple(model_presses),
        reading=reading,
        used=used,
        maps=maps,
        misses=misses,
        hold=hold_of(anatomy, model_presses, modulus_factor=factor),
        model_modulus_factor=factor,
        support_count=support_count,
        seed=seed,
        wall_time=time.perf_counter() - begin,
    )


def _read(presses: Sequence[Press], sensor: ForceSensor, rng: np.random.Generator) -> FloatArray:
    """Readings of a scan along the normals [N], shape (n_site,): one bias for all, noise for each."""
    reading = ForceReading(sensor)
    reading.reset(rng)
    force, normals = np.array([press.force for press in presses]), np.array([press.normal for press in presses])
    return reading.read_along(force, normals, rng)


def plan_sites(anatomy: Anatomy, around: Ball | None = None) -> tuple[FloatArray, FloatArray, int]:
    """Raster sites [m] and normals, each (n_site, 3), without those near a support, and the number of those.

    Raises:
        ValueError: no site is left.
    """
    scene = anatomy.scene
    sites, normals = anatomy.face.raster(scene.palpation.site_spacing)
    if around is not None:
        inside = norm(sites - np.asarray(around.centre), axis=1) <= around.radius
        sites, normals = sites[inside], normals[inside]
    free = anatomy.clear_of_supports(sites)
    if not free.any():
        tip = scene.instrument.tip_radius * 1e3
        raise ValueError(
            f"scene {scene.name!r}: no site to press: {len(sites)} raster sites lie on the palpable face (inside the "
            f"ball asked for, if any), all within {SUPPORT_TIP_RADII * tip:g} mm of a fixed support or {tip:g} mm of "
            "an elastic one: use a smaller site_spacing or "
            "face_margin, turn the approach, or move the anchors"
        )
    return sites[free], normals[free], int((~free).sum())


def _displaced(
    face: PalpableFace, sites: FloatArray, normals: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Each site moved along the surface in a random direction, and the normals there."""
    moved = []
    for site, normal in zip(sites, normals, strict=True):
        first, second = tangent_axes(normal)
        angle = rng.uniform(0.0, 2.0 * np.pi)
        moved.append(face.project(site + MODEL_SITE_ERROR * (cos(angle) * first + sin(angle) * second)))
    return np.array([point for point, _ in moved]), np.array([normal for _, normal in moved])


def _maps(
    anatomy: Anatomy,
    presses: Sequence[Press],
    model_presses: Sequence[Press],
    readings: tuple[FloatArray, FloatArray],
    used: np.ndarray,
    truths: Sequence[Truth],
) -> tuple[ContrastMap, ContrastMap]:
    """Both contrast maps over the used sites; readings of the organ and of its model [N], each (n_site,)."""
    spacing = anatomy.scene.palpation.site_spacing
    sites = np.array([press.site for press in presses])[used]
    stiffness, model_stiffness = (
        reading[used] / np.array([press.depth for press in pressed])[used]
        for reading, pressed in zip(readings, (presses, model_presses), strict=True)
    )
    plane = matmul(sites, np.column_stack(tangent_axes(anatomy.face.approach)))
    contrasts = {
        NEIGHBOURS: contrast_with_neighbours(stiffness, plane, _geometry(anatomy.face, sites)),
        MODEL: contrast_with_model(stiffness, model_stiffness),
    }
    first, second = (
        score_map(
            name,
            sites,
            contrast,
            feel_lesions(sites, contrast, spacing=spacing),
            truths,
            anatomy.along_surface,
            spacing=spacing,
        )
        for name, contrast in contrasts.items()
    )
    return first, second


def _geometry(face: PalpableFace, sites: FloatArray) -> FloatArray | None:
    """Geometric regressors of healthy stiffness: reciprocal thickness [1/m] and nearness of the rim, (n_site, 2)."""
    if not np.isfinite(face.thickness).any():
        return None
    centres = face.points[face.triangles].mean(axis=1)
    thickness = np.array([face.thickness[np.argmin(np.square(centres - site).sum(axis=1))] for site in sites])
    rim = np.array([face.rim_distance(site) for site in sites])
    return np.column_stack([1.0 / thickness, exp(-rim / RIM_REACH)])


def press_progress(console: Console | None) -> Progress:
    """A bar of presses; hidden without a console."""
    return Progress(
        TextColumn("pressing {task.description:<24}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console or Console(quiet=True),
    )


def progress_task(bar: Progress, name: str, count: int) -> Callable[[], None]:
    """A line of a bar for a number of presses of an organ; the function that advances it by one."""
    task = bar.add_task(name, total=count)
    return lambda: bar.advance(task)


def write_csv(palpation: PalpationResult, path: Path) -> None:
    """One row per site; lengths [m], forces [N], stiffness [N/m]; no contrasts where a press ended early."""
    order = np.cumsum(palpation.used) - 1
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        for index, press in enumerate(palpation.presses):
            used = bool(palpation.used[index])
            contrasts = [f"{one.contrast[order[index]]:.5f}" if used else "" for one in palpation.maps]
            reading = float(palpation.reading[index])
            numbers = [*press.site, *press.normal, press.depth, press.force, reading, reading / press.depth]
            writer.writerow([index, *(f"{value:.6g}" for value in numbers), *contrasts, early_end(palpation, index)])


def early_end(palpation: PalpationResult, index: int) -> str:
    """Why a site is in no map: the reason that its press or its model's press ended early; empty for a complete one."""
    if palpation.presses[index].end:
        return palpation.presses[index].end
    model_end = palpation.model_presses[index].end
    if model_end:
        return f"pre-operative model: {model_end}"
    return "" if palpation.used[index] else "force reading not above 0"


def write_summary(palpation: PalpationResult, path: Path, inputs: Mapping[str, Any]) -> None:
    """Write the summary; undefined numbers, such as the error of a missed lesion, are null."""
    scene, mesh = palpation.anatomy.scene, palpation.anatomy.mesh
    forces = [press.force_peak for press in palpation.presses]
    summary = {
        "inputs": dict(inputs),
        "versions": {"surgsim": package_version(), "python": platform.python_version(), "numpy": np.__version__},
        "seed": palpation.seed,
        "organ": {"nodes": mesh.node_count, "tets": mesh.tet_count, "anchored_nodes": len(palpation.anatomy.anchors)},
        "press": {
            "depth_m": scene.palpation.press_depth,
            "tip_radius_m": scene.instrument.tip_radius,
            "cell_m": palpation.anatomy.palpable_cell,
            "cell_over_contact_radius": palpation.anatomy.palpable_cell
            / contact_radius(scene.instrument.tip_radius, scene.palpation.press_depth),
            "contact_stiffness_N_per_m3": scene.contact.stiffness,
            "contrast_hidden_by_contact": hidden_share(*_touch(palpation)),
            "spacing_m": scene.palpation.site_spacing,
            "substeps_per_haptic_step": scene.timing.substep_count,
            "haptic_step_s": scene.timing.haptic_step,
        },
        "sites": {
            "pressed": len(palpation.presses),
            "in_maps": int(palpation.used.sum()),
            "left_out_near_supports": palpation.support_count,
            "ended_early": {i: early_end(palpation, i) for i in np.flatnonzero(~palpation.used).tolist()},
        },
        "model": {
            "modulus_factor": palpation.model_modulus_factor,
            "modulus_error_largest": MODEL_MODULUS_ERROR,
            "site_error_m": MODEL_SITE_ERROR,
        },
        "truth": [
            {"name": one.name, "centre_m": one.centre, "surface_point_m": one.point, "radius_m": one.radius}
            for one in palpation.truths
        ],
        "maps": {one.name: _map_entry(one, palpation.misses) for one in palpation.maps},
        "held": _held_entry(palpation.hold),
        "force_peak_N": max(forces),
        "tissue_pressure_largest_Pa": max(press.load.pressure for press in palpation.presses),
        "tissue_strain_largest": max(press.load.strain for press in palpation.presses),
        "volume_ratio_smallest": min(
            press.volume_ratio_smallest for press in (*palpation.presses, *palpation.model_presses)
        ),
        "simulated_time_s": palpation.simulated_time,
        "wall_time_s": palpation.wall_time,
        "real_time_factor": palpation.simulated_time / palpation.wall_time,
    }
    path.write_text(json.dumps(plain_json(summary), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _held_entry(hold: Hold | None) -> dict[str, Any] | None:
    if hold is None:
        return None
    return {
        "healthy_force_over_hertz": hold.force_share,
        "far_travel_over_depth": hold.far_share,
        "faults": list(hold.faults),
    }


def _map_entry(one: ContrastMap, misses: Sequence[Miss]) -> dict[str, Any]:
    reasons = {miss.lesion: miss for miss in misses if miss.map_name == one.name}
    return {
        "estimates": [
            {"point_m": item.point, "contrast": item.contrast, "excess": item.excess} for item in one.estimates
        ],
        "lesions": [
            {
                "name": score.truth.name,
                "felt": score.felt,
                "error_mm": score.error * 1e3,
                "estimate": score.estimate,
                "contrast": score.contrast,
                "miss": reasons[score.truth.name].reason if score.truth.name in reasons else None,
                "why": reasons[score.truth.name].text if score.truth.name in reasons else None,
            }
            for score in one.scores
        ],
        "felt": one.felt_count,
        "false_alarms": one.false_alarms,
        "healthy_sites": one.healthy_count,
        "healthy_std": one.healthy_std,
    }


def _healthy(one: ContrastMap) -> str:
    return "-" if math.isnan(one.healthy_std) else f"1 ± {one.healthy_std:.2f} ({one.healthy_count})"


def print_report(palpation: PalpationResult, console: Console) -> None:
    """The short table: place, error and contrast of each lesion, and the spread of healthy sites."""
    table = Table(title=f"stiffness of {palpation.anatomy.scene.name}, felt against two baselines")
    table.add_column("against", no_wrap=True)
    table.add_column("lesion")
    for heading in ("felt at\nx, y, z [mm]", "error\n[mm]", "contrast", "healthy\nsites"):
        table.add_column(heading, justify="right", no_wrap=True)
    for one in palpation.maps:
        for score in one.scores:
            table.add_row(_short(one), score.truth.name, *_felt_cells(one, score), _healthy(one))
        if not one.scores:
            table.add_row(_short(one), "none hidden", f"{len(one.estimates)} felt", "", "", _healthy(one))
        table.add_section()
    console.print(table)
    for one in palpation.maps:
        console.print(verdict(one))
        for miss in palpation.misses:
            if miss.map_name == one.name:
                console.print(f"  {miss.lesion}: {miss.text}", highlight=False, markup=False)
    if palpation.hold is not None:
        console.print(f"held: {palpation.hold.text}", highlight=False)
        for fault in palpation.hold.faults:
            # Markup would take [[anchors]] for a style.
            console.print(f"not held well: {fault}", highlight=False, markup=False)
    early = int((~palpation.used).sum())
    console.print(
        f"{len(palpation.presses)} sites pressed, {early} ended early and left out, {palpation.support_count} not "
        f"pressed near supports; peak force {max(press.force_peak for press in palpation.presses):.2f} N"
    )


def _touch(palpation: PalpationResult) -> tuple[float, float, float, float]:
    """Largest force of a complete press [N], tip radius [m], press depth [m] and contact stiffness [N/m^3]."""
    scene = palpation.anatomy.scene
    force = max((one.force for one, used in zip(palpation.presses, palpation.used) if used), default=0.0)
    return force, scene.instrument.tip_radius, scene.palpation.press_depth, scene.contact.stiffness


def verdict(one: ContrastMap) -> str:
    """One sentence: how many lesions were felt, how many not, and how many false alarms there were."""
    count, missed = len(one.scores), len(one.scores) - one.felt_count
    alarms = f", {one.false_alarms} false alarm{'s' if one.false_alarms != 1 else ''}"
    if count == 0:
        return f"{one.name}: no lesion was hidden{alarms}"
    if missed:
        return f"{one.name}: {missed} of {count} not felt{alarms}"
    return f"{one.name}: {'the lesion' if count == 1 else f'all {count} lesions'} felt{alarms}"


def _short(one: ContrastMap) -> str:
    """The map's name, short enough for a terminal of 80 columns."""
    return "model" if one.name == MODEL else "neighbours"


def _felt_cells(one: ContrastMap, score: LesionScore) -> tuple[str, str, str]:
    contrast = "" if math.isnan(score.contrast) else f"{score.contrast:.2f}"
    if score.estimate is None:
        return "not felt", "-", contrast
    x, y, z = one.estimates[score.estimate].point * 1e3
    mark = "" if score.felt else " miss"
    return f"{x:.1f}, {y:.1f}, {z:.1f}", f"{score.error * 1e3:.1f}{mark}", contrast


def package_version() -> str:
    """Version of this package, or "checkout" if it is not installed."""
    try:
        return version("surgsim")
    except PackageNotFoundError:
        return "checkout"


def plain_json(value: Any, digits: int = 7) -> Any:
    """JSON types: arrays as lists, numbers rounded to `digits` decimals, None if not finite."""
    if isinstance(value, Mapping):
        return {str(key): plain_json(item, digits) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain_json(item, digits) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, float | np.floating):
        return round(float(value), digits) if math.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return str(value) if isinstance(value, Path) else value
