"""Reports of a palpation: palpation.csv, summary.json and the short table on the terminal."""

import csv
import json
import math
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from surgsim_env.palpation.contrast_map import ContrastMap, LesionScore
from surgsim_env.palpation.job import MODEL, MODEL_MODULUS_ERROR, MODEL_SITE_ERROR, PalpationResult
from surgsim_env.scene.palpable_surface import contact_radius, share_text

CSV_NAME, SUMMARY_NAME, PICTURE_NAME = "palpation.csv", "summary.json", "stiffness_map.png"
COLUMNS = (
    *("site", "x", "y", "z", "normal_x", "normal_y", "normal_z", "depth", "force", "reading", "stiffness"),
    *("contrast_neighbours", "contrast_model", "ended_early"),
)


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


def write_summary(palpation: PalpationResult, path: Path, inputs: Mapping[str, Any]) -> dict[str, Any]:
    """Write and return the summary; undefined numbers, such as the error of a missed lesion, are null."""
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
        "maps": {one.name: _map_entry(one) for one in palpation.maps},
        "force_peak_N": max(forces),
        "volume_ratio_smallest": min(
            press.volume_ratio_smallest for press in (*palpation.presses, *palpation.model_presses)
        ),
        "simulated_time_s": palpation.simulated_time,
        "wall_time_s": palpation.wall_time,
        "real_time_factor": palpation.simulated_time / palpation.wall_time,
    }
    plain = plain_json(summary)
    path.write_text(json.dumps(plain, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return plain


def _map_entry(one: ContrastMap) -> dict[str, Any]:
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
            }
            for score in one.scores
        ],
        "felt": one.felt_count,
        "false_alarms": one.false_alarms,
        "healthy_std": one.healthy_std,
        "healthy_robust_std": one.healthy_robust_std,
    }


def _healthy(one: ContrastMap) -> str:
    return "-" if math.isnan(one.healthy_std) else f"1 ± {one.healthy_std:.2f}"


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
    early = int((~palpation.used).sum())
    every = (*palpation.presses, *palpation.model_presses)
    console.print(
        f"{len(palpation.presses)} sites pressed, {early} ended early and left out, {palpation.support_count} not "
        f"pressed near supports; peak force {max(press.force_peak for press in palpation.presses):.2f} N, "
        f"smallest volume ratio {min(press.volume_ratio_smallest for press in every):.2f}"
    )
    scene = palpation.anatomy.scene
    share = share_text(palpation.anatomy.palpable_cell, scene.instrument.tip_radius, scene.palpation.press_depth)
    console.print(f"cell / contact radius {share}")
    console.print(
        f"simulated {palpation.simulated_time:.1f} s in {palpation.wall_time:.1f} s: "
        f"{palpation.simulated_time / palpation.wall_time:.2f} times real time"
    )
    for index in np.flatnonzero(~palpation.used).tolist():
        console.print(f"  site {index} ended early: {early_end(palpation, index)}")


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
