"""Write agents/LEADERBOARD.md from the result files agents/results/*.json.

python -m agents.leaderboard
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import astuple
from pathlib import Path

from surgsim_apps.cli.main import exit_status
from surgsim_apps.reports.output_folder import output_folder
from surgsim_apps.scoring.figures import ScoreEstimate
from surgsim_apps.scoring.results import SITES, Result, load_results, seeds_text, shipped_results
from surgsim_env.scene import PHYSICS_VERSION

LEADERBOARD = Path(__file__).resolve().with_name("LEADERBOARD.md")

# Columns: heading, figure, decimals, factor.
Column = tuple[str, str, int, float]
LOAD: tuple[Column, ...] = (
    ("peak tissue pressure [kPa]", "pressure_peak", 1, 0.001),
    ("peak tissue strain", "strain_peak", 2, 1.0),
)
PLACES: tuple[Column, ...] = (
    ("presses to 5 mm, median", "presses_to_median", 0, 1.0),
    ("90th percentile", "presses_to_p90", 0, 1.0),
    ("success [%]", "success", 0, 100.0),
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
    *LOAD,
    ("presses over soft limit [%]", "soft_force_share", 1, 100.0),
    ("impulse [N s]", "impulse", 2, 1.0),
    ("time [s]", "seconds", 0, 1.0),
    ("path [m]", "path_length", 2, 1.0),
    ("hard limit, faults [%]", "violations", 0, 100.0),
)
TASKS: tuple[Column, ...] = (
    ("success [%]", "success", 0, 100.0),
    ("time to success [s]", "seconds", 1, 1.0),
    ("error [mm]", "error_mm", 1, 1.0),
    ("peak force [N]", "force_peak", 2, 1.0),
    *LOAD,
    ("under soft limit [%]", "under_soft_force", 0, 100.0),
    ("torn [%]", "torn", 0, 100.0),
    ("peak grip [N]", "grip_force_peak", 2, 1.0),
    ("peak pull [N]", "pull_force_peak", 2, 1.0),
    ("slips", "slips", 1, 1.0),
    ("hard limit, faults [%]", "violations", 0, 100.0),
    ("return", "return", 2, 1.0),
)


def write_leaderboard(folder: Path, path: Path) -> None:
    """Write the tables of all results of a folder."""
    results = load_results(folder)
    places = sorted(sorted({result.place for result in results}), key=_order)
    parts = [HEADER]
    for place in places:
        rows = [result for result in results if result.place == place]
        parts.append(_sites(rows) if rows[0].env_id == SITES else _tasks(rows))
    parts.append(_commands(results))
    with output_folder(path.parent) as files:
        (files / path.name).write_text("\n".join(parts), encoding="utf-8")


HEADER = f"""# Leaderboard

Written by `python -m agents.leaderboard` from `agents/results/*.json`; definitions in `docs/palpation.md`.
Each figure is a mean over the episodes of its seeds, in brackets the 95 % bootstrap interval over them; "never" is a
line that was not reached within the presses of an episode. Baselines and policies play the same organs. The rasters
shown are the best of those tried, by presses to 5 mm, then by the error over all presses. Methods marked
**sees truth** know what is hidden: `truth` reports it, the oracles press with that knowledge. Where the patient moves,
presses and oracles track the surface by markers; methods whose name ends in `untracked` press at the rest position.
How to score an agent of your own: `docs/own_agent.md`. Differences between two methods on the same organs:
`surgsim evaluate --compare A.json B.json`, for results of one version of the physics. The engine has physics
{PHYSICS_VERSION}; a method with "physics" and another number was played on an older one and not since.
"""


def _order(place: str) -> tuple[int, str]:
    levels = ("standard", "easy", "hard", "clinical")
    ranks = [index for index, level in enumerate(levels) if place.endswith(level)]
    return (0 if place.startswith("PalpateSites") else 1, f"{place.rsplit('_', 1)[0]}{ranks[0] if ranks else 9}")


def ranked(rows: Sequence[Result]) -> list[Result]:
    """The leaderboard's rows of one place, best first, with the best raster alone."""
    if rows[0].env_id == SITES:
        return sorted(best_raster_alone(rows), key=_merit)
    return sorted(rows, key=lambda result: -(result.figures["success"].value or 0.0))


def _sites(rows: list[Result]) -> str:
    rows = ranked(rows)
    first = max(rows, key=lambda row: row.budget)
    lesions = first.lesion_counts
    organs = (
        f"{len(lesions)} organs (seeds {seeds_text(first.seeds)}), {sum(lesions)} lesions, "
        f"{lesions.count(0)} organs without one; {first.budget} presses.\n"
    )
    parts = [f"\n## {_title(first)}\n", organs, _table(rows, PLACES), "", _table(rows, MAPS)]
    return "\n".join(parts)


def _tasks(rows: list[Result]) -> str:
    rows = ranked(rows)
    used = [column for column in TASKS if any(column[1] in _figures(row) for row in rows)]
    first = rows[0]
    seeds = f"{len(first.seeds)} episodes (seeds from {first.seeds[0]}), at most {first.budget} control steps.\n"
    return "\n".join([f"\n## {_title(rows[0])}\n", seeds, _table(rows, used)])


def _title(result: Result) -> str:
    scene, level = result.scene, result.env_kwargs.get("level")
    moves = f"motion {result.motion}" * bool(result.motion)
    details = ", ".join(part for part in (level, moves) if part)
    return " ".join(part for part in (f"`{result.env_id}`", scene, f"({details})" if details else "") if part)


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


def _figures(result: Result) -> dict[str, ScoreEstimate]:
    """The figures, with hard limits and faults summed."""
    both = [astuple(result.figures[name]) for name in ("hard_limit_share", "fault_share")]
    return {
        **result.figures,
        "violations": ScoreEstimate(*((a or 0.0) + (b or 0.0) for a, b in zip(*both, strict=True))),
    }


def _table(rows: Sequence[Result], columns: Sequence[Column]) -> str:
    head = ["method", *(column[0] for column in columns)]
    lines = [_line(head), _line(["---"] * len(head))]
    lines += [_line([_name(row), *(_cell(_figures(row), column) for column in columns)]) for row in rows]
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _name(result: Result) -> str:
    side = result.method.removeprefix("raster_")
    name = f"raster {side} x {side}" if side != result.method else result.method
    older = f" (physics {result.physics_version})" * (result.physics_version != PHYSICS_VERSION)
    return name + " **sees truth**" * result.sees_truth + " (own estimate)" * result.own_estimate + older


def _cell(figures: dict[str, ScoreEstimate], column: Column) -> str:
    _, name, decimals, factor = column
    figure = figures.get(name)
    if figure is None or figure.value is None:
        return ""
    value, low, high = (_number(number, decimals, factor) for number in (figure.value, figure.low, figure.high))
    return value if value == low == high else f"{value} ({low} to {high})"


def _number(value: float | None, decimals: int, factor: float) -> str:
    if value is None:
        return ""
    return "never" if math.isinf(value) else f"{value * factor:.{decimals}f}"


def _commands(results: Sequence[Result]) -> str:
    lines = ["\n## Commands\n", _line(["command", "wall time [s]", "date", "physics"]), _line(["---"] * 4)]
    lines += [
        _line([f"`{row.command}`", f"{row.wall_time:.0f}", row.date, str(row.physics_version)]) for row in results
    ]
    return "\n".join([*lines, "", "Wall times were measured on a 2-core machine under other load.", ""])


if __name__ == "__main__":
    sys.exit(exit_status(lambda: write_leaderboard(shipped_results(), LEADERBOARD)))
