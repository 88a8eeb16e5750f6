"""Two methods on the same episodes: their difference, with its interval from a paired bootstrap."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgsim_apps.scoring.figures import RESAMPLES, ScoreEstimate, figure_with_interval, presses_to_line
from surgsim_apps.scoring.results import SITES, Result, seeds_text

# Heading, digits, factor and unit of each figure.
SHOWN = {
    "presses_to_median": ("presses to 5 mm", 1, 1.0, ""),
    "error_mm": ("error", 2, 1.0, " mm"),
    "success": ("success", 0, 100.0, " %"),
}
# A figure of one result over the episodes that a draw has taken.
Figure = Callable[[Result, NDArray[np.intp]], float]


@dataclass(frozen=True)
class Difference:
    """One figure of two methods on the same episodes.

    Fields:
        figure: a name of SHOWN
        one, other: the figure of each
        difference: one - other, with its interval; draws in which neither reaches the line are left out
        ratio: one / other of presses, with its interval; None of other figures
    """

    figure: str
    one: float
    other: float
    difference: ScoreEstimate
    ratio: ScoreEstimate | None


def compare(one: Result, other: Result, rng: np.random.Generator) -> list[Difference]:
    """Differences of two results; a draw takes the same episodes, with replacement, for both.

    (Efron & Tibshirani 1993, ch. 8.)

    Raises:
        ValueError: results of other seeds, environments or physics, or without single episodes (names both).
    """
    for result in (one, other):
        if not result.successes:
            raise ValueError(f"the result of {result.method} does not list its episodes: evaluate it again")
    for fault in _faults(one, other):
        raise ValueError(f"{one.method} and {other.method} cannot be compared: {fault}: evaluate both again")
    figures: dict[str, Figure] = {"success": _success}
    if one.env_id == SITES:
        figures = {"presses_to_median": _presses, "error_mm": _error, **figures}
    count = len(one.seeds)
    draws = [rng.integers(count, size=count) for _ in range(RESAMPLES)]
    return [_difference(name, of, one, other, draws) for name, of in figures.items()]


def _difference(name: str, of: Figure, one: Result, other: Result, draws: list[NDArray[np.intp]]) -> Difference:
    everyone = np.arange(len(one.seeds))
    value, other_value = of(one, everyone), of(other, everyone)
    values = np.array([(of(one, chosen), of(other, chosen)) for chosen in draws])
    ratio = None
    # Never less never, and never over never, is undefined: NaN.
    with np.errstate(invalid="ignore"):
        difference = figure_with_interval(value - other_value, values[:, 0] - values[:, 1])
        if name == "presses_to_median":
            ratio = figure_with_interval(float(np.divide(value, other_value)), values[:, 0] / values[:, 1])
    return Difference(name, value, other_value, difference, ratio)


def describe(difference: Difference, one: str, other: str) -> str:
    """One line: both figures, their difference, and the ratio where there is one."""
    heading, digits, factor, unit = SHOWN[difference.figure]

    def shown(value: float | None, form: str = "") -> str:
        return "undefined" if value is None else f"{value * factor:{form}.{digits}f}"

    of = difference.difference
    interval = f"{shown(of.value, '+')} ({shown(of.low, '+')} to {shown(of.high, '+')})"
    values = f"{one} {shown(difference.one)}, {other} {shown(difference.other)}{unit}"
    line = f"{heading}: {values}; difference {interval}{unit}"
    if difference.ratio is None or difference.ratio.value is None:
        return line
    return f"{line}; ratio {difference.ratio.value:.2f} ({difference.ratio.low:.2f} to {difference.ratio.high:.2f})"


def _faults(one: Result, other: Result) -> Iterator[str]:
    if one.seeds != other.seeds:
        yield f"their seeds are {seeds_text(one.seeds)} and {seeds_text(other.seeds)}"
    if (one.env_id, one.place) != (other.env_id, other.place) or one.budget != other.budget:
        yield f"they played {one.place} with {one.budget} steps and {other.place} with {other.budget}"
    if one.physics_version != other.physics_version:
        yield f"their physics versions are {one.physics_version} and {other.physics_version}"


def _presses(result: Result, chosen: NDArray[np.intp]) -> float:
    """Presses until the median error over the organs with lesions is and stays at most 5 mm."""
    counted = chosen[np.array(result.lesion_counts)[chosen] > 0]
    return presses_to_line(0.001 * np.array(result.errors_mm)[counted], 50.0) if len(counted) else math.nan


def _error(result: Result, chosen: NDArray[np.intp]) -> float:
    return float(np.array(result.errors_mm)[chosen, -1].mean())


def _success(result: Result, chosen: NDArray[np.intp]) -> float:
    return float(np.array(result.successes)[chosen].mean())
