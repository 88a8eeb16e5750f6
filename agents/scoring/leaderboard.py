"""agents/LEADERBOARD.md from the committed result files."""

import json
import math
from collections.abc import Sequence
from pathlib import Path

from agents.scoring.results_files import RESULTS, Result, load_results
from surgsim_env.palpation.scores import Figure

LEADERBOARD = Path(__file__).resolve().parents[1] / "LEADERBOARD.md"

# Columns: heading, figure, decimals, factor.
Column = tuple[str, str, int, float]
PLACES: tuple[Column, ...] = (
    ("presses to 5 mm, median", "presses_to_median", 0, 1.0),
    ("90th percentile", "presses_to_p90", 0, 1.0),
    ("error [mm]", "error_mm", 1, 1.0),
    ("over all presses [mm]", "error_of_presses_mm", 1, 1.0),
    ("centroid [mm]", "centroid_error_mm", 1, 1.0),
    ("recall [%]", "recall", 0, 100.0),
    ("precision [%]", "precision", 0, 100.0),
    ("number right [%]", "count_right", 0, 100.0),
)
MAPS: tuple[Column, ...] = (
    ("outline IoU", "outline_iou", 2, 1.0),
    ("difference [mm^2]", "outline_difference_mm2", 0, 1.0),
    ("AUROC", "auroc", 3, 1.0),
    ("AP", "average_precision", 2, 1.0),
    ("force mean [N]", "force_mean", 2, 1.0),
    ("p95 [N]", "force_p95", 2, 1.0),
    ("peak [N]", "force_peak", 2, 1.0),
    ("presses over soft limit [%]", "soft_force_share", 1, 100.0),
    ("impulse [N s]", "impulse", 2, 1.0),
    ("time [s]", "seconds", 0, 1.0),
    ("path [m]", "path_length", 2, 1.0),
    ("hard limit, faults [%]", "violations", 0, 100.0),
)
TASKS: tuple[Column, ...] = (
    ("success [%]", "success", 0, 100.0),
    ("time to it [s]", "seconds", 1, 1.0),
    ("error [mm]", "error_mm", 1, 1.0),
    ("peak force [N]", "force_peak", 2, 1.0),
    ("under soft limit [%]", "under_soft_force", 0, 100.0),
    ("torn [%]", "torn", 0, 100.0),
    ("peak grip [N]", "grip_force_peak", 2, 1.0),
    ("peak pull [N]", "pull_force_peak", 2, 1.0),
    ("slips", "slips", 1, 1.0),
    ("hard limit, faults [%]", "violations", 0, 100.0),
    ("return", "return", 2, 1.0),
)
SITES = "SurgSim/PalpateSites-v0"


def write_leaderboard(folder: Path = RESULTS, path: Path = LEADERBOARD) -> None:
    """Write the tables of all results of a folder."""
    results = load_results(folder)
    places = sorted({result.place for result in results}, key=_order)
    parts = [HEADER]
    for place in places:
        rows = [result for result in results if result.place == place]
        parts.append(_sites(place, rows, folder) if rows[0].env_id == SITES else _tasks(place, rows))
    parts.append(_commands(results))
    path.write_text("\n".join(parts), encoding="utf-8")


HEADER = """# Leaderboard

Written by `python -m agents.evaluate --leaderboard` from `agents/results/*.json`; definitions in `docs/palpation.md`.
Each figure is a mean over the episodes of its seeds, in brackets the 95 % bootstrap interval over them; "never" is a
line that was not reached within the presses of an episode. Baselines and policies play the same organs. The rasters
shown are the best of those tried, by presses to 5 mm, then by the error over all presses.
"""


def _order(place: str) -> tuple[int, str]:
    levels = ("standard", "easy", "hard")
    found = [index for index, level in enumerate(levels) if place.endswith(level)]
    return (0 if place.startswith("PalpateSites") else 1, f"{place.rsplit('_', 1)[0]}{found[0] if found else 9}")


def _sites(place: str, rows: list[Result], folder: Path) -> str:
    rows = sorted(best_raster_alone(rows), key=_merit)
    first = max(rows, key=lambda row: row.budget)
    parts = [f"\n## {_title(first)}\n"]
    lesions = first.lesion_counts
    parts.append(
        f"{len(lesions)} organs (seeds {first.seeds[0]} to {first.seeds[1]}), {sum(lesions)} lesions, "
        f"{lesions.count(0)} organs without one; {first.budget} presses.{_reach(place, folder)}\n"
    )
    return "\n".join([*parts, _table(rows, PLACES), "", _table(rows, MAPS)])


def _tasks(place: str, rows: list[Result]) -> str:
    rows = sorted(rows, key=lambda result: -(result.figures["success"].value or 0.0))
    used = [column for column in TASKS if any(column[1] in _figures(row) for row in rows)]
    counts = {row.method: row.seeds[1] - row.seeds[0] + 1 for row in rows}
    most = max(counts.values())
    fewer = "".join(f", {count} of {method}" for method, count in counts.items() if count < most)
    seeds = f"{most} episodes{fewer} (seeds from {rows[0].seeds[0]}), at most {rows[0].budget} control steps.\n"
    return "\n".join([f"\n## {_title(rows[0])}\n", seeds, _table(rows, used)])


def _title(result: Result) -> str:
    scene, level = result.env_kwargs.get("scene", ""), result.env_kwargs.get("level")
    return " ".join(part for part in (f"`{result.env_id}`", scene, f"({level})" if level else "") if part)


def best_raster_alone(rows: Sequence[Result]) -> list[Result]:
    """The rows with the best raster only."""
    rasters = [row for row in rows if row.method.startswith("raster_")]
    if not rasters:
        return list(rows)
    best = min(rasters, key=_merit)
    return [row for row in rows if row not in rasters or row is best]


def _merit(result: Result) -> tuple[float, float]:
    presses, error = result.figures["presses_to_median"].value, result.figures["error_of_presses_mm"].value
    return (math.inf if presses is None else presses, math.inf if error is None else error)


def _reach(place: str, folder: Path) -> str:
    path = folder / f"reach_{place}.json"
    if not path.is_file():
        return ""
    table = json.loads(path.read_text(encoding="utf-8"))
    below, lesions = table["below"], table["lesions"]
    return f" Below the sensor's reach: {below} of {lesions} lesions ({below / lesions:.0%})."


def _figures(result: Result) -> dict[str, Figure]:
    """The figures, with hard limits and faults summed."""
    figures = dict(result.figures)
    hard, fault = figures["hard_limit_share"], figures["fault_share"]
    figures["violations"] = Figure(
        *(
            (a or 0.0) + (b or 0.0)
            for a, b in ((hard.value, fault.value), (hard.low, fault.low), (hard.high, fault.high))
        )
    )
    return figures


def _table(rows: Sequence[Result], columns: Sequence[Column]) -> str:
    head = ["method", *(column[0] for column in columns)]
    lines = [_line(head), _line(["---"] * len(head))]
    lines += [_line([_name(row), *(_cell(_figures(row), column) for column in columns)]) for row in rows]
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _name(result: Result) -> str:
    if result.method.startswith("raster_"):
        side = result.method.removeprefix("raster_")
        return f"raster {side} x {side}"
    return result.method


def _cell(figures: dict[str, Figure], column: Column) -> str:
    _, name, decimals, factor = column
    figure = figures.get(name)
    if figure is None or figure.value is None:
        return ""
    value, low, high = (_number(one, decimals, factor) for one in (figure.value, figure.low, figure.high))
    return value if value == low == high else f"{value} ({low} to {high})"


def _number(value: float | None, decimals: int, factor: float) -> str:
    if value is None:
        return ""
    return "never" if math.isinf(value) else f"{value * factor:.{decimals}f}"


def _commands(results: Sequence[Result]) -> str:
    lines = ["\n## Commands\n", _line(["command", "wall time [s]", "date"]), _line(["---"] * 3)]
    lines += [_line([f"`{row.command}`", f"{row.wall_time:.0f}", row.date]) for row in results]
    return "\n".join([*lines, "", "Wall times are of a 2-core machine that did other work beside.", ""])
