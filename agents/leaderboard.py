"""Write docs/leaderboard.md from the result files agents/results/*.json.

python -m agents.leaderboard
"""

import math
import sys
from collections.abc import Iterator, Sequence
from itertools import combinations, groupby
from pathlib import Path

import numpy as np

from surgsim_apps.cli.main import exit_status
from surgsim_apps.reports.output_folder import output_folder
from surgsim_apps.scoring.comparison import compare
from surgsim_apps.scoring.evaluate import BOOTSTRAP_SEED
from surgsim_apps.scoring.figures import ScoreEstimate
from surgsim_apps.scoring.results import SITES, SLIDE, Result, load_results, shipped_results
from surgsim_apps.scoring.site_search import BOUNDS
from surgsim_env.scene import PHYSICS_VERSION

LEADERBOARD = Path(__file__).resolve().parents[1] / "docs" / "leaderboard.md"
# The figure that orders methods of PalpateSites.
AREA = "error_of_presses_mm"

# Columns: heading, figure, decimals, factor. The first has its interval.
Column = tuple[str, str, int, float]
LOAD: tuple[Column, ...] = (
    ("peak force [N]", "force_peak", 2, 1.0),
    ("peak tissue pressure [kPa]", "pressure_peak", 1, 0.001),
)
PRESSES: tuple[Column, ...] = (
    ("area under the error curve [mm]", AREA, 2, 1.0),
    ("presses to 5 mm", "presses_to_median", 0, 1.0),
    ("success [%]", "success", 0, 100.0),
    ("error [mm]", "error_mm", 1, 1.0),
    *LOAD,
)
MAPS: tuple[Column, ...] = (
    ("map score over the time", "map_score", 3, 1.0),
    ("success [%]", "success", 0, 100.0),
    ("last error [mm]", "error_mm", 1, 1.0),
    *LOAD,
)
STEPS: tuple[Column, ...] = (("success [%]", "success", 0, 100.0), ("time to success [s]", "seconds", 1, 1.0), *LOAD)
NOTES = {
    "random": "what the common estimator gives without a search",
    "sites_evolved": "learned acquisition function: 13 numbers in JSON",
    "oracle_near": "presses lesions first, then around them",
    "middle": "blind guess",
    "slide_random": "declares no lesion",
    "slide_learned": "imitation of `slide_oracle`, network of 184 000 numbers",
    "slide_oracle": "declares each lesion once it is touched",
}

HEADER = """# Leaderboard

In `SurgSim/PalpateSites-v0` an agent chooses where to press an organ, and one common estimator locates the lesions; in
`SurgSim/Slide-v0` it slides over an organ without a map of the healthy one, and declares the map of lesions itself.
All methods of a table play the same episodes; organs of a "test split" served for no method's training.

## Best methods

"""
BLOCKS = """
Random presses with the common estimator close most of the way from the blind guess here: a block shows that a method
works, not that it is better. Rank methods on organs.
"""
SUBMISSION = """
## How to submit

Write a class with two methods and run `surgsim evaluate --agent my_agent:Mine --scene liver_family --submit`
(`docs/own_agent.md`). The seeds follow from the digest of the agent's file: nobody can choose an agent by its score on
them. `surgsim evaluate --compare A.json B.json` prints how two methods differ on the same episodes, and how many
episodes would tell them apart.

## What a score does not exclude

* An agent's code runs beside the environment's: nothing stops code that reads the simulation. Read the agent's file.
* The reward of a press is its true error, and `info` contains the truth. Agents that are scored get neither, but one
  that was trained on rewards has learned from the truth.
* An agent may report its own estimate instead of the common estimator's: the row says **own estimate**.
* The seeds of the rows on this page are public.
"""
DEFINITIONS = f"""
## Definitions

Methods of PalpateSites are ordered by the **area under the error curve**: the error (OSPA) of the estimated lesions
after each press, averaged over presses and episodes; those of Slide by the **map score**, averaged over the time
(`docs/environments/slide.md`). In brackets: the 95 % bootstrap interval, over organs where there are several. Further
figures: `docs/palpation.md`. Of the rasters the best is shown.

"never": not within the presses of an episode. **sees truth**: the method knows the lesions. The engine has physics
{PHYSICS_VERSION}; "physics" with another number: played on an older version and not since. `openhelp_...` are organs of
one CT scan (`docs/patient.md`). `python -m agents.leaderboard` writes this page from `agents/results/*.json`, which
have the numbers of each episode, the intervals of all figures and the command of each row.
"""


def write_leaderboard(folder: Path, path: Path) -> None:
    """Write the page of all results of a folder."""
    results = sorted(load_results(folder), key=_order)
    places = [best_raster_alone(list(rows)) for _, rows in groupby(results, key=lambda row: row.place)]
    best = ["where", "best method", "next", "figure"]
    lines = [_line(best), _line(["---"] * len(best)), *(_line(cells) for cells in map(_best, places) if cells)]
    parts = [HEADER, "\n".join(lines), "\n\n## All methods\n", *map(_folded, places), SUBMISSION, DEFINITIONS]
    with output_folder(path.parent) as files:
        (files / path.name).write_text("".join(parts), encoding="utf-8")


def _best(rows: Sequence[Result]) -> list[str]:
    """Cells of the best two methods of a place; none where all see the truth."""
    honest = [row for row in rows if not (row.sees_truth or row.own_estimate)][:2]
    if not honest:
        return []
    column = _columns(rows[0])[0]
    cells = [f"{_name(row)}: {_cell(row.figures.get(column[1]), column, True)}" for row in honest]
    return [_place(rows[0]), *cells, *[""] * (2 - len(cells)), column[0]]


def _place(result: Result) -> str:
    environment = result.env_id.removeprefix("SurgSim/").removesuffix("-v0")
    return f"{environment} {'on ' * bool(result.scene)}{_title(result)}".strip()


def _columns(result: Result) -> Sequence[Column]:
    return {SITES: PRESSES, SLIDE: MAPS}.get(result.env_id, STEPS)


def _folded(rows: list[Result]) -> str:
    """A table under its title, opened by a click."""
    first = rows[0]
    text = (_presses if first.env_id == SITES else _steps)(rows)
    return f"\n<details markdown><summary>{_place(first).replace('`', '')}</summary>\n{text}\n</details>\n"


def _is_block(result: Result) -> bool:
    return result.scene.startswith("phantom")


def _order(result: Result) -> tuple:
    """Families, then single organs, then blocks; the best first."""
    if result.env_id != SITES:
        merit = "map_score" if result.env_id == SLIDE else "success"
        return (True, result.env_id != SLIDE, result.env_id, result.place, -_value(result, merit))
    return (False, _is_block(result), not result.members, result.place, _value(result, AREA))


def _value(result: Result, figure: str) -> float:
    value = result.figures[figure].value
    return math.inf if value is None else value


def best_raster_alone(rows: Sequence[Result]) -> list[Result]:
    """The rows with the best raster only."""
    rasters = [row for row in rows if row.method.startswith("raster_")]
    best = min(rasters, key=lambda row: _value(row, AREA), default=None)
    return [row for row in rows if row not in rasters or row is best]


def _presses(rows: list[Result]) -> str:
    first = max(rows, key=lambda row: row.budget)
    lesions = first.lesion_counts
    text = (
        f"\n{_episodes(first)}, {sum(lesions)} lesions, {lesions.count(0)} episodes without one, {first.budget} "
        f"presses.\n\n{_table(rows)}\n"
    )
    return BLOCKS + text if _is_block(first) else text + "".join(f"\n{line}\n" for line in _head_room(rows))


def _steps(rows: list[Result]) -> str:
    return f"\n{_episodes(rows[0])}.\n\n{_table(rows)}\n"


def _episodes(result: Result) -> str:
    organs = f"of {len(set(result.members))} organs" if result.members else "on one organ"
    return f"{len(result.seeds)} episodes {organs}"


def _head_room(rows: Sequence[Result]) -> Iterator[str]:
    """Sentences on what would beat the methods of a place, and which of them are not separated."""
    by_name = {row.method: row for row in rows}
    searches = [row for row in rows if row.method not in BOUNDS]
    near = by_name.get("oracle_near")
    if near is not None and searches and near.physics_version == searches[0].physics_version:
        gap = _value(searches[0], AREA) - _value(near, AREA)
        exact = min((row for row in rows if not row.own_estimate), key=lambda row: _value(row, "error_mm"))
        yield (
            f"**Head room**: {gap:.2f} mm of area between {searches[0].method} and oracle_near, which presses the "
            f"lesions first. No method has come below {_value(exact, 'error_mm'):.1f} mm after the last press "
            f"({exact.method}): what the estimator leaves."
        )
    alike = []
    for first, second in combinations(searches, 2):
        if (first.seeds, first.budget, first.physics_version) != (second.seeds, second.budget, second.physics_version):
            continue
        (area,) = compare(first, second, np.random.default_rng(BOOTSTRAP_SEED), [AREA])
        low, high = area.difference.low, area.difference.high
        if low is not None and high is not None and low <= 0.0 <= high:
            alike.append(f"{first.method} and {second.method} ({area.difference.value:+.2f} mm)")
    if alike:
        yield f"**Not separated** by the area (95 % interval of the paired difference with 0): {', '.join(alike)}."


def _title(result: Result) -> str:
    split, motion = result.env_kwargs.get("split"), result.motion
    details = (result.env_kwargs.get("level"), split and f"{split} split", motion and f"motion {motion}")
    in_brackets = ", ".join(filter(None, details))
    return f"`{result.scene}` ({in_brackets})".removesuffix(" ()").removeprefix("``").strip()


def _table(rows: Sequence[Result]) -> str:
    columns = _columns(rows[0])
    head = ["method", *(column[0] for column in columns), "note"]
    lines = [_line(head), _line(["---"] * len(head))]
    for row in rows:
        cells = [_cell(row.figures.get(column[1]), column, index == 0) for index, column in enumerate(columns)]
        lines.append(_line([_name(row), *cells, _note(row)]))
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _name(result: Result) -> str:
    side = result.method.removeprefix("raster_")
    return f"raster {side} x {side}" if side != result.method else result.method


def _note(result: Result) -> str:
    marks = ("**sees truth**" * result.sees_truth, "**own estimate**" * result.own_estimate)
    older = f"physics {result.physics_version}" if result.physics_version != PHYSICS_VERSION else ""
    return ", ".join(note for note in (NOTES.get(result.method), *marks, older) if note)


def _cell(figure: ScoreEstimate | None, column: Column, interval: bool) -> str:
    if figure is None or figure.value is None:
        return ""
    value, low, high = (_number(number, column) for number in (figure.value, figure.low, figure.high))
    return f"{value} ({low} to {high})" if interval else value


def _number(value: float | None, column: Column) -> str:
    if value is None:
        return ""
    return "never" if math.isinf(value) else f"{value * column[3]:.{column[2]}f}"


if __name__ == "__main__":
    sys.exit(exit_status(lambda: write_leaderboard(shipped_results(), LEADERBOARD)))
