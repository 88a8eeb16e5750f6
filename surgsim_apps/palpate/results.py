"""Files of a palpation's results: a table of the sites as CSV, a summary as JSON."""

import csv
import json
import math
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from surgsim_apps.palpate.contrast_map import ContrastMap
from surgsim_apps.palpate.hold import Hold
from surgsim_apps.palpate.misses import Miss
from surgsim_apps.palpate.palpation import MODEL_MODULUS_ERROR, MODEL_SITE_ERROR, PalpationResult
from surgsim_env.scene import contact_radius, mesh_bias

CSV_NAME, SUMMARY_NAME, REPORT_NAME = "palpation.csv", "summary.json", "report.html"
PICTURE_NAME, ORGAN_NAME = "stiffness_map.png", "organ.png"
COLUMNS = (
    *("site", "x", "y", "z", "normal_x", "normal_y", "normal_z", "depth", "force", "reading", "stiffness"),
    *("contrast_neighbours", "contrast_model", "ended_early"),
)
# Decimals of numbers in the summary.
DECIMALS = 7


def write_csv(palpation: PalpationResult, path: Path) -> None:
    """Write a row per site; lengths [m], forces [N], stiffness [N/m]; no contrasts for a press that ended early."""
    order = np.cumsum(palpation.used) - 1
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        for index, press in enumerate(palpation.presses):
            used = bool(palpation.used[index])
            contrasts = [f"{entry.contrast[order[index]]:.5f}" if used else "" for entry in palpation.maps]
            reading = float(palpation.reading[index])
            numbers = [*press.site, *press.normal, press.depth, press.force, reading, reading / press.depth]
            writer.writerow([index, *(f"{value:.6g}" for value in numbers), *contrasts, _early_end(palpation, index)])


def _early_end(palpation: PalpationResult, index: int) -> str:
    """Reason for a site's absence from the maps; empty for a site in the maps."""
    if palpation.presses[index].end:
        return palpation.presses[index].end
    model_end = palpation.model_presses[index].end
    if model_end:
        return f"pre-operative model: {model_end}"
    return "" if palpation.used[index] else "force reading not above 0"


def write_summary(palpation: PalpationResult, path: Path, inputs: Mapping[str, Any]) -> None:
    """Write the summary; undefined numbers, such as the error of a missed lesion, are null."""
    scene, mesh = palpation.anatomy.scene, palpation.anatomy.mesh
    tip, depth, cell = scene.instrument.tip_radius, scene.palpation.press_depth, palpation.anatomy.palpable_cell
    both = (*palpation.presses, *palpation.model_presses)
    summary = {
        "inputs": dict(inputs),
        "versions": {"surgsim": surgsim_version(), "python": platform.python_version(), "numpy": np.__version__},
        "seed": palpation.seed,
        "organ": {"nodes": mesh.node_count, "tets": mesh.tet_count, "anchored_nodes": len(palpation.anatomy.anchors)},
        "press": {
            "depth_m": depth,
            "tip_radius_m": tip,
            "cell_m": cell,
            "cell_over_contact_radius": cell / contact_radius(tip, depth),
            "force_added_by_mesh": mesh_bias(cell, tip, depth),
            "contact_stiffness_N_per_m3": scene.contact.stiffness,
            "contrast_hidden_by_contact": palpation.hidden_share,
            "spacing_m": scene.palpation.site_spacing,
            "substeps_per_haptic_step": scene.timing.substep_count,
            "haptic_step_s": scene.timing.haptic_step,
        },
        "sites": {
            "pressed": len(palpation.presses),
            "in_maps": int(palpation.used.sum()),
            "left_out_near_supports": palpation.support_count,
            "ended_early": {i: _early_end(palpation, i) for i in np.flatnonzero(~palpation.used).tolist()},
        },
        "model": {
            "modulus_factor": palpation.model_modulus_factor,
            "modulus_error_largest": MODEL_MODULUS_ERROR,
            "site_error_m": MODEL_SITE_ERROR,
        },
        "truth": [
            {"name": truth.name, "centre_m": truth.centre, "surface_point_m": truth.point, "radius_m": truth.radius}
            for truth in palpation.truths
        ],
        "maps": {entry.name: _map_entry(entry, palpation.misses) for entry in palpation.maps},
        "held": _held_entry(palpation.hold),
        "force_peak_N": max(press.force_peak for press in palpation.presses),
        "tissue_pressure_largest_Pa": max(press.load.pressure for press in palpation.presses),
        "tissue_strain_largest": max(press.load.strain for press in palpation.presses),
        "tissue_equivalent_strain_largest": max(press.load.equivalent_strain for press in palpation.presses),
        "tissue_equivalent_strain_supported": scene.material.strain_supported,
        "volume_ratio_smallest": min(press.volume_ratio_smallest for press in both),
        "simulated_time_s": palpation.simulated_time,
        "wall_time_s": palpation.wall_time,
        "real_time_factor": palpation.simulated_time / palpation.wall_time,
    }
    path.write_text(json.dumps(_plain(summary), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _held_entry(hold: Hold | None) -> dict[str, Any] | None:
    if hold is None:
        return None
    return {
        "healthy_force_over_hertz": hold.force_share,
        "far_travel_over_depth": hold.far_share,
        "faults": list(hold.faults),
    }


def _map_entry(contrast_map: ContrastMap, misses: Sequence[Miss]) -> dict[str, Any]:
    reasons = {miss.lesion: miss for miss in misses if miss.map_name == contrast_map.name}
    return {
        "estimates": [
            {"point_m": estimate.point, "contrast": estimate.contrast, "excess": estimate.excess}
            for estimate in contrast_map.estimates
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
            for score in contrast_map.scores
        ],
        "felt": contrast_map.felt_count,
        "false_alarms": contrast_map.false_alarms,
        "healthy_sites": contrast_map.healthy_count,
        "healthy_std": contrast_map.healthy_std,
    }


def surgsim_version() -> str:
    """Version of the installed package, or "checkout"."""
    try:
        return version("surgsim")
    except PackageNotFoundError:
        return "checkout"


def _plain(value: Any) -> Any:
    """JSON types: arrays as lists, numbers rounded, None for a number that is not finite."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, float | np.floating):
        return round(float(value), DECIMALS) if math.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return str(value) if isinstance(value, Path) else value
