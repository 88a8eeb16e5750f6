"""Two methods on the same episodes: their difference, with its interval from a paired bootstrap."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from surgsim_env.palpation.scores import RESAMPLES, ScoreEstimate, figure_with_interval, presses_to_line
from surgsim_env.scoring.results import SITES, Result, seeds_text


@dataclass(frozen=True)
class Difference:
    """One figure of two methods on the same episodes.

    Fields:
        figure: "presses_to_median" (presses to 5 mm), "error_mm" or "success"
        lesion_count: of the organs that the figure is of; None where it is of all
        one, other: the figure of each, means over their training seeds
        difference: one - other, with its interval
        ratio: one / other, with its interval; None where `other` may be 0
        undefined: share of the draws in which neither reaches the line, so that there is no difference
    """

    figure: str
    lesion_count: int | None
    one: float
    other: float
    difference: ScoreEstimate
    ratio: ScoreEstimate | None
    undefined: float


def compare(one: Sequence[Result], other: Sequence[Result], rng: np.random.Generator) -> list[Difference]:
    """Differences of two methods, each one result or one for each seed of its training.

    A draw takes the same episodes, with replacement, for both (Efron & Tibshirani 1993, ch. 8), and of a method with
    several training seeds as many of those, with replacement. Presses are also counted on organs with one lesion, two
    and so on, where EPISODES_LEAST episodes have as many.

    Raises:
        ValueError: results of other seeds, environments or physics, or without single episodes (names both).
    """
    _check([*one, *other])
    groups = [[_Episodes.of(result) for result in group] for group in (one, other)]
    figures: dict[tuple[str, int | None], Figure] = {("success", None): _success}
    if one[0].env_id == SITES:
        presses = {("presses_to_median", count): partial(_presses, lesion_count=count) for count in _counts(one[0])}
        figures = {**presses, ("error_mm", None): _error, **figures}
    count = len(one[0].seeds)
    everyone = np.arange(count)
    whole = {name: (_mean(of, groups[0], everyone), _mean(of, groups[1], everyone)) for name, of in figures.items()}
    draws: dict[tuple[str, int | None], list[tuple[float, float]]] = {name: [] for name in figures}
    for _ in range(RESAMPLES):
        chosen = rng.integers(count, size=count)
        members = [[group[index] for index in rng.integers(len(group), size=len(group))] for group in groups]
        for name, of in figures.items():
            draws[name].append((_mean(of, members[0], chosen), _mean(of, members[1], chosen)))
    return [_difference(*name, *whole[name], np.array(draws[name])) for name in figures]


def _counts(result: Result) -> list[int | None]:
    """Which organs presses are counted on: all (None), then those with so many lesions, if they differ in that."""
    counts, episodes = np.unique([count for count in result.lesion_counts if count > 0], return_counts=True)
    if len(counts) < 2:
        return [None]
    return [None, *counts[episodes >= EPISODES_LEAST].tolist()]


def _difference(
    name: str, lesion_count: int | None, one: float, other: float, draws: NDArray[np.float64]
) -> Difference:
    with np.errstate(invalid="ignore"):
        # Never less never, and never over never, is undefined: NaN.
        differences, ratios = draws[:, 0] - draws[:, 1], None
        if name == "presses_to_median":
            ratios = figure_with_interval(float(np.float64(one) / other), draws[:, 0] / draws[:, 1])
        whole = float(np.float64(one) - other)
    interval = figure_with_interval(whole, differences)
    return Difference(name, lesion_count, one, other, interval, ratios, float(np.isnan(differences).mean()))


def describe(difference: Difference, one: str, other: str) -> str:
    """One line: both figures, their difference, and the ratio where there is one."""
    heading, digits, factor, unit = SHOWN[difference.figure]
    if difference.lesion_count is not None:
        heading += f" with {difference.lesion_count} lesion{'s' * (difference.lesion_count > 1)}"

    def shown(value: float | None, form: str = "") -> str:
        if value is None or math.isnan(value):
            return "undefined"
        if math.isinf(value):
            return "never" if value > 0.0 and not form else "without bound" + " below" * (value < 0.0)
        return f"{value * factor:{form}.{digits}f}"

    def interval(estimate: ScoreEstimate, form: str = "") -> str:
        return f"{shown(estimate.value, form)} ({shown(estimate.low, form)} to {shown(estimate.high, form)})"

    line = f"{heading}: {one} {shown(difference.one)}, {other} {shown(difference.other)}{unit}"
    line += f"; difference {interval(difference.difference, '+')}{unit}"
    if difference.ratio is not None:
        parts = (difference.ratio.value, difference.ratio.low, difference.ratio.high)
        value, low, high = ("undefined" if part is None else f"{part:.2f}" for part in parts)
        line += f"; ratio {value} ({low} to {high})"
    if difference.undefined > 0.0:
        line += f"; neither reaches the line in {difference.undefined:.0%} of the draws, which are left out"
    return line


# Organs with so many lesions are compared by themselves where so many episodes have them.
EPISODES_LEAST = 10
# Heading, digits, factor and unit of each figure.
SHOWN = {
    "presses_to_median": ("presses to 5 mm", 1, 1.0, ""),
    "error_mm": ("error", 2, 1.0, " mm"),
    "success": ("success", 0, 100.0, " %"),
}


def _check(results: Sequence[Result]) -> None:
    first = results[0]
    for result in results:
        if not result.successes:
            raise ValueError(f"the result of {result.method} does not list its episodes: evaluate it again")
        for fault in _faults(first, result):
            raise ValueError(f"{first.method} and {result.method} cannot be compared: {fault}: evaluate both again")


def _faults(one: Result, other: Result) -> Iterator[str]:
    if one.seeds != other.seeds:
        yield f"their seeds are {seeds_text(one.seeds)} and {seeds_text(other.seeds)}"
    if (one.env_id, one.place) != (other.env_id, other.place) or one.budget != other.budget:
        yield f"they played {one.place} with {one.budget} steps and {other.place} with {other.budget}"
    if one.physics_version != other.physics_version:
        yield f"their physics versions are {one.physics_version} and {other.physics_version}"


@dataclass(frozen=True, eq=False)
class _Episodes:
    """Errors after each press [m] (n, n_press), how many lesions episodes hide (n,) and which succeeded (n,)."""

    errors: NDArray[np.float64]
    lesion_counts: NDArray[np.intp]
    succeeded: NDArray[np.bool_]

    @classmethod
    def of(cls, result: Result) -> "_Episodes":
        errors = 0.001 * np.array(result.errors_mm, dtype=np.float64)
        return cls(errors, np.array(result.lesion_counts, dtype=np.intp), np.array(result.successes))


# A figure of one result over the episodes that a draw has taken.
Figure = Callable[[_Episodes, NDArray[np.intp]], float]


def _mean(of: Figure, group: Sequence[_Episodes], chosen: NDArray[np.intp]) -> float:
    return float(np.mean([of(one, chosen) for one in group]))


def _presses(episodes: _Episodes, chosen: NDArray[np.intp], lesion_count: int | None) -> float:
    """Presses until the median error over the organs with (so many) lesions is and stays at most 5 mm."""
    counts = episodes.lesion_counts[chosen]
    counted = chosen[counts > 0 if lesion_count is None else counts == lesion_count]
    return presses_to_line(episodes.errors[counted], 50.0) if len(counted) else math.nan


def _error(episodes: _Episodes, chosen: NDArray[np.intp]) -> float:
    return 1000.0 * float(episodes.errors[chosen, -1].mean())


def _success(episodes: _Episodes, chosen: NDArray[np.intp]) -> float:
    return float(episodes.succeeded[chosen].mean())
