"""Result files agents/results/*.json, and agents/LEADERBOARD.md from them."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass, field
from pathlib import Path
from typing import Any

from surgsim_env.palpation.scores import ScoreEstimate
from surgsim_env.scene.motions import STILL

RESULTS = Path(__file__).resolve().parents[1] / "results"
LEADERBOARD = RESULTS.with_name("LEADERBOARD.md")
# JSON has no infinity.
NEVER = "never"


@dataclass(frozen=True)
class Result:
    """One method on one environment, with the command that reproduces its figures.

    Fields:
        method: name of an agent or of a policy's file
        env_id, env_kwargs: the environment
        seeds: first and last of the range
        budget: largest number of steps of an episode
        figures: by name, each a value with its interval
        errors_mm: OSPA after each press of each episode (PalpateSites only)
        lesion_counts: lesions of each episode (PalpateSites only)
        command: that produced it
        wall_time: of all episodes [s], on a machine with other load
        date: of its end
    """

    method: str
    env_id: str
    env_kwargs: dict[str, Any]
    seeds: tuple[int, int]
    budget: int
    figures: dict[str, ScoreEstimate]
    command: str
    wall_time: float
    date: str
    errors_mm: list[list[float]] = field(default_factory=list)
    lesion_counts: list[int] = field(default_factory=list)

    @property
    def place(self) -> str:
        """Environment, scene and level: the key that groups tables."""
        parts = [self.env_id.removeprefix("SurgSim/").removesuffix("-v0"), self.env_kwargs.get("scene", "")]
        parts += [self.env_kwargs.get("level") or "", self.motion]
        return "_".join(part for part in parts if part)

    @property
    def motion(self) -> str:
        """How the patient moves; "" for one who holds still."""
        motion = self.env_kwargs.get("motion") or STILL
        return "" if motion == STILL else motion

    def save(self, folder: Path = RESULTS) -> Path:
        """Write it; replaces an older result of the same method and place."""
        table = asdict(self)
        table["figures"] = {
            name: [_written(value) for value in astuple(figure)] for name, figure in self.figures.items()
        }
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.place}_{self.method}.json"
        lines = [f" {json.dumps(name)}: {json.dumps(value)}" for name, value in table.items()]
        path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
        return path


def load_result(path: Path) -> Result:
    """Read a file of `Result.save`."""
    table = json.loads(path.read_text(encoding="utf-8"))
    table["figures"] = {
        name: ScoreEstimate(*(math.inf if value == NEVER else value for value in values))
        for name, values in table["figures"].items()
    }
    return Result(**{**table, "seeds": tuple(table["seeds"])})


def load_results(folder: Path = RESULTS) -> list[Result]:
    """All results of a folder, by file name, without `reach_*.json`."""
    return [load_result(path) for path in sorted(folder.glob("*.json")) if not path.name.startswith("reach_")]


def _written(value: float | None) -> float | str | None:
    if value is None:
        return None
    return NEVER if math.isinf(value) else float(f"{value:.5g}")


# ---- the leaderboard ------------------------------------------------------------------------------------------------

# Columns: heading, figure, decimals, factor.
Column = tuple[str, str, int, float]
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
shown are the best of those tried, by presses to 5 mm, then by the error over all presses. An oracle knows the truth:
its rows bound what an environment allows. Where the patient moves, presses and oracles go with the surface that markers
show; a method whose name ends in `untracked` goes where places are at rest.
"""


def _order(place: str) -> tuple[int, str]:
    levels = ("standard", "easy", "hard")
    found = [index for index, level in enumerate(levels) if place.endswith(level)]
    return (0 if place.startswith("PalpateSites") else 1, f"{place.rsplit('_', 1)[0]}{found[0] if found else 9}")


def _sites(place: str, rows: list[Result], folder: Path) -> str:
    rows = sorted(best_raster_alone(rows), key=_merit)
    first = max(rows, key=lambda row: row.budget)
    lesions = first.lesion_counts
    organs = (
        f"{len(lesions)} organs (seeds {first.seeds[0]} to {first.seeds[1]}), {sum(lesions)} lesions, "
        f"{lesions.count(0)} organs without one; {first.budget} presses.{_reach(place, folder)}\n"
    )
    return "\n".join([f"\n## {_title(first)}\n", organs, _table(rows, PLACES), "", _table(rows, MAPS)])


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
    moves = f"motion {result.motion}" * bool(result.motion)
    told = ", ".join(part for part in (level, moves) if part)
    return " ".join(part for part in (f"`{result.env_id}`", scene, f"({told})" if told else "") if part)


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
    if result.method.startswith("raster_"):
        side = result.method.removeprefix("raster_")
        return f"raster {side} x {side}"
    return result.method


def _cell(figures: dict[str, ScoreEstimate], column: Column) -> str:
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
    return "\n".join([*lines, "", "Wall times were measured on a 2-core machine under other load.", ""])
