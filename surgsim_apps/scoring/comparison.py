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
# A figure of one result over drawn episodes.
Figure = Callable[[Result, NDArray[np.intp]], float]


@dataclass(frozen=True)
class Difference:
    """One figure of two methods on the same episodes.

    Fields:
        figure: a name of SHOWN
        first, second: the figure of each
        difference: first - second, with its interval; draws in which neither reaches the line are left out
        ratio: first / second of presses, with its interval; None of other figures
    """

    figure: str
    first: float
    second: float
    difference: ScoreEstimate
    ratio: ScoreEstimate | None


def compare(first: Result, second: Result, rng: np.random.Generator) -> list[Difference]:
    """Differences of two results by a paired bootstrap (Efron & Tibshirani 1993, ch. 8).

    A draw takes the same episodes, with replacement, for both.

    Raises:
        ValueError: results of other seeds, environments or physics, or without single episodes (names both).
    """
    for result in (first, second):
        if not result.successes:
            raise ValueError(f"the result of {result.method} does not list its episodes: evaluate it again")
    for fault in _faults(first, second):
        raise ValueError(f"{first.method} and {second.method} cannot be compared: {fault}: evaluate both again")
    figures: dict[str, Figure] = {"success": _success}
    if first.env_id == SITES:
        figures = {"presses_to_median": _presses, "error_mm": _error, **figures}
    count = len(first.seeds)
    draws = [rng.integers(count, size=count) for _ in range(RESAMPLES)]
    return [_difference(name, figure, first, second, draws) for name, figure in figures.items()]


def _difference(name: str, figure: Figure, first: Result, second: Result, draws: list[NDArray[np.intp]]) -> Difference:
    episodes = np.arange(len(first.seeds))
    value, other = figure(first, episodes), figure(second, episodes)
    values = np.array([(figure(first, draw), figure(second, draw)) for draw in draws])
    ratio = None
    # Never less never, and never over never, is undefined: NaN.
    with np.errstate(invalid="ignore"):
        difference = figure_with_interval(value - other, values[:, 0] - values[:, 1])
        if name == "presses_to_median":
            ratio = figure_with_interval(float(np.divide(value, other)), values[:, 0] / values[:, 1])
    return Difference(name, value, other, difference, ratio)


def describe(difference: Difference, first: str, second: str) -> str:
    """One line: the figures of two methods, their difference, and a ratio of presses."""
    heading, digits, factor, unit = SHOWN[difference.figure]

    def shown(value: float | None, form: str = "") -> str:
        return "undefined" if value is None else f"{value * factor:{form}.{digits}f}"

    estimate = difference.difference
    interval = f"{shown(estimate.value, '+')} ({shown(estimate.low, '+')} to {shown(estimate.high, '+')})"
    values = f"{first} {shown(difference.first)}, {second} {shown(difference.second)}{unit}"
    line = f"{heading}: {values}; difference {interval}{unit}"
    if difference.ratio is None or difference.ratio.value is None:
        return line
    return f"{line}; ratio {difference.ratio.value:.2f} ({difference.ratio.low:.2f} to {difference.ratio.high:.2f})"


def _faults(first: Result, second: Result) -> Iterator[str]:
    if first.seeds != second.seeds:
        yield f"their seeds are {seeds_text(first.seeds)} and {seeds_text(second.seeds)}"
    if (first.env_id, first.place, first.budget) != (second.env_id, second.place, second.budget):
        yield f"they played {first.place} with {first.budget} steps and {second.place} with {second.budget}"
    if first.physics_version != second.physics_version:
        yield f"their physics versions are {first.physics_version} and {second.physics_version}"


def _presses(result: Result, episodes: NDArray[np.intp]) -> float:
    """Presses until the median error over the organs with lesions is and stays at most 5 mm."""
    counted = episodes[np.array(result.lesion_counts)[episodes] > 0]
    return presses_to_line(0.001 * np.array(result.errors_mm)[counted], 50.0) if len(counted) else math.nan


def _error(result: Result, episodes: NDArray[np.intp]) -> float:
    return float(np.array(result.errors_mm)[episodes, -1].mean())


def _success(result: Result, episodes: NDArray[np.intp]) -> float:
    return float(np.array(result.successes)[episodes].mean())
