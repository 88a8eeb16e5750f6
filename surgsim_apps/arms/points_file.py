"""The files points.csv, a line for each point of an evaluation, and placements.csv, one for each of a search."""

import csv
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surgsim_apps.arms.quantities import DISTANCES, QUANTITIES
from surgsim_apps.arms.results import REASONS, ArmsEvaluation, PortsFound
from surgsim_env.instruments import SIDES


def columns(evaluation: ArmsEvaluation) -> dict[str, list[str]]:
    """Cells of each column, one a point; names of figures end with their SI unit, cells without a value are empty."""
    cells = {"point": [str(index) for index in range(len(evaluation.points))]}
    cells |= {f"{axis}_m": _numbers(values) for axis, values in zip("xyz", evaluation.points.T, strict=True)}
    cells |= {f"normal_{axis}": _numbers(values) for axis, values in zip("xyz", evaluation.normals.T, strict=True)}
    cells["inner"] = _flags(evaluation.inner)
    for side, arm in evaluation.arms.items():
        cells[f"{side}_reachable"] = _flags(arm.reachable)
        cells[f"{side}_reason"] = [REASONS[reason] if reason else "" for reason in arm.reason]
        cells |= {f"{side}_{item.field}{item.si}": _numbers(getattr(arm, item.field)) for item in QUANTITIES}
        cells |= {f"{side}_joint_{number}": _numbers(values) for number, values in enumerate(arm.joints.T)}
    cells["both"] = _flags(evaluation.both)
    cells |= {f"{field}_m": _numbers(getattr(evaluation, field)) for field, _, _ in DISTANCES}
    if evaluation.cycle is not None:
        for side, arm in evaluation.cycle.arms.items():
            cells[f"{side}_always"] = _flags(arm.always)
            cells[f"{side}_has_path"] = _flags(arm.has_path)
            cells[f"{side}_path_clearance_worst_m"] = _numbers(arm.clearance.min(axis=0))
        cells["both_always"] = _flags(evaluation.cycle.both_always)
    return cells


def write_points(evaluation: ArmsEvaluation, path: Path) -> None:
    """Write points.csv."""
    _write(columns(evaluation), path)


def write_placements(search: PortsFound, path: Path) -> None:
    """Write placements.csv: the best placement, then the Pareto front."""
    placements = (search.best, *search.front)
    cells = {"placement": ["best", *map(str, range(1, len(placements)))]}
    for name, unit in (("share", ""), ("clearance", "_m"), ("dexterity", "")):
        cells[f"{name}{unit}"] = _numbers(getattr(each, name) for each in placements)
    for name in (*SIDES, "endoscope"):
        places = [getattr(each.ports, name) for each in placements]
        cells |= {f"{name}_{axis}_m": _numbers(place.point[row] for place in places) for row, axis in enumerate("xyz")}
        if name in SIDES:
            cells[f"{name}_roll_rad"] = _numbers(place.roll for place in places)
    _write(cells, path)


def _write(cells: dict[str, list[str]], path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(cells)
        writer.writerows(zip(*cells.values(), strict=True))


def _numbers(values: Iterable[float]) -> list[str]:
    return ["" if np.isnan(value) else f"{float(value):.9g}" for value in values]


def _flags(mask: NDArray[np.bool_]) -> list[str]:
    return [str(int(flag)) for flag in mask]
