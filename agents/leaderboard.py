"""Write agents/LEADERBOARD.md and a picture for each scene, docs/images/leaderboard_*.png, from agents/results/*.json.

python -m agents.leaderboard
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

from agents.leaderboard_tables import ranked, shown_name, write_leaderboard
from surgsim_env.palpation.scores import ScoreEstimate
from surgsim_env.scoring.results import SITES, Result, load_results, picture_name, shipped_results

matplotlib.use("Agg")
from matplotlib.figure import Figure

LEADERBOARD = Path(__file__).resolve().with_name("LEADERBOARD.md")
IMAGES = LEADERBOARD.parents[1] / "docs" / "images"
WIDTH, DPI = 8.4, 110  # [in], [1/in]
# Heights of a method, of a panel's title, and of what surrounds all panels [in].
ROW, HEADING, MARGINS = 0.23, 0.35, 1.1
# Where a number of presses that is never reached stands, over the budget.
NEVER = 1.13


class Quantity(NamedTuple):
    """A column of panels: a figure's name, what its axis says, and a factor."""

    name: str
    label: str
    factor: float = 1.0


# What a picture shows of press-by-press palpation, and of the other environments.
SITE_COLUMNS = (
    Quantity("presses_to_median", "median presses to the 5 mm line"),
    Quantity("success", "success after all presses [%]", 100.0),
)
TASK_COLUMNS = (Quantity("success", "success [%]", 100.0), Quantity("seconds", "time to success [s]"))
# Kinds of methods with their colours (Okabe & Ito 2008); a marker without filling sees the truth.
KINDS = {
    "learned": "#D55E00",
    "searches by belief": "#0072B2",
    "scripted": "#555555",
    "sees the truth": "#000000",
}


def draw_leaderboard(results: Sequence[Result], folder: Path) -> list[Path]:
    """Draw the picture of each environment and scene; returns the files.

    A row of panels for each level and motion, a line for each method in the order of the leaderboard: the value, and
    the interval of the leaderboard as a bar. Methods that are scored by an estimate of their own are left out.
    """
    pictures: dict[str, dict[str, list[Result]]] = {}
    for result in results:
        if not result.own_estimate:
            pictures.setdefault(picture_name(result), {}).setdefault(result.place, []).append(result)
    made = []
    for name, places in pictures.items():
        rows = {place: ranked(members) for place, members in sorted(places.items(), key=lambda one: _level(one[1][0]))}
        made.append(folder / name)
        _draw(rows, made[-1])
    return made


def kind(result: Result) -> str:
    """Which of KINDS a method is."""
    if result.sees_truth:
        return "sees the truth"
    if "--policy" in result.command:
        return "learned"
    return "searches by belief" if result.method.startswith("gp_") else "scripted"


def _level(result: Result) -> tuple[bool, int]:
    levels = ("easy", "standard", "hard", "clinical")
    level = result.env_kwargs.get("level")
    return bool(result.motion), levels.index(level) if level in levels else len(levels)


def _draw(places: dict[str, list[Result]], path: Path) -> None:
    heights = [len(rows) for rows in places.values()]
    figure = Figure((WIDTH, ROW * sum(heights) + HEADING * len(places) + MARGINS), dpi=DPI, layout="constrained")
    shown = [row for rows in places.values() for row in rows]
    columns = SITE_COLUMNS if shown[0].env_id == SITES else TASK_COLUMNS
    panels: Any = figure.subplots(len(places), 2, squeeze=False, sharex="col", sharey="row", height_ratios=heights)
    for line, rows in zip(panels, places.values(), strict=True):
        for axes, column in zip(line, columns, strict=True):
            _draw_panel(axes, rows, column, never=NEVER * max(row.budget for row in shown))
        line[0].set_yticks(range(len(rows)), [shown_name(row) for row in rows], fontsize=8)
        line[0].set_ylim(len(rows) - 0.5, -0.5)
        told = [rows[0].env_kwargs.get("level"), rows[0].motion and f"motion {rows[0].motion}"]
        line[0].set_title(", ".join(part for part in told if part), loc="left", fontsize=9)
    for axes, column in zip(panels[-1], columns, strict=True):
        axes.set_xlabel(column.label, fontsize=8)
        _set_scale(axes, column, max(row.budget for row in shown))
    used = [name for name in KINDS if any(kind(row) == name for row in shown)]
    handles = [panels[0, 0].plot([], [], "o", label=name, **_marker(name))[0] for name in used]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(used), frameon=False, fontsize=8)
    figure.suptitle(f"{shown[0].env_id} {shown[0].scene}".strip(), fontsize=10, fontweight="bold")
    figure.savefig(path)


def _draw_panel(axes: Any, rows: Sequence[Result], column: Quantity, never: float) -> None:
    """Values with their intervals, one line each; what is never reached stands at `never`."""
    for line, row in enumerate(rows):
        value, low, high = _scaled(row.figures.get(column.name), column.factor, never)
        if value is None:
            axes.text(0.02, line, "none succeeded", transform=axes.get_yaxis_transform(), va="center", fontsize=7)
            continue
        marker = _marker(kind(row))
        axes.plot([low, high], [line, line], color=marker["color"], linewidth=2.0, alpha=0.45, solid_capstyle="butt")
        axes.plot([value], [line], "o", **marker)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)


def _set_scale(axes: Any, column: Quantity, budget: int) -> None:
    """Limits and ticks of a column of panels."""
    if column.factor == 100.0:
        axes.set_xlim(-3.0, 103.0)
    elif column.name == "presses_to_median":
        ticks = range(0, budget + 1, 5 if budget <= 30 else 10)
        axes.set_xticks([*ticks, NEVER * budget], [*map(str, ticks), "never"])
        axes.set_xlim(0.0, 1.03 * NEVER * budget)
    else:
        axes.set_xlim(0.0, 1.06 * axes.get_xlim()[1])


def _marker(name: str) -> dict[str, Any]:
    hollow = {"markerfacecolor": "white"} if name == "sees the truth" else {}
    return {"color": KINDS[name], "markersize": 6.0, "markeredgewidth": 1.4, **hollow}


def _scaled(
    figure: ScoreEstimate | None, factor: float, never: float
) -> tuple[float | None, float | None, float | None]:
    """Value and interval for the axis; what is never reached at `never`."""
    if figure is None or figure.value is None:
        return None, None, None
    value, low, high = (
        never if one is not None and math.isinf(one) else factor * (figure.value if one is None else one)  # type: ignore[operator]
        for one in (figure.value, figure.low, figure.high)
    )
    return value, low, high


def main() -> None:
    """Write tables and pictures."""
    write_leaderboard(shipped_results(), LEADERBOARD)
    draw_leaderboard(load_results(shipped_results()), IMAGES)


if __name__ == "__main__":
    main()
