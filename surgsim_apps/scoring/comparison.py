"""Two methods on the same episodes: their difference, with its interval from a paired bootstrap."""

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgsim_apps.scoring.figures import ScoreEstimate, figure_with_interval, median_presses, resamples
from surgsim_apps.scoring.results import SITES, SLIDE, Result, seeds_text

# Heading, digits, factor and unit of each figure.
SHOWN = {
    "map_score": ("map score over the time", 3, 1.0, ""),
    "error_of_presses_mm": ("error over all presses", 2, 1.0, " mm"),
    "presses_to_median": ("presses to 5 mm", 1, 1.0, ""),
    "error_mm": ("error after the last", 2, 1.0, " mm"),
    "success": ("success", 0, 100.0, " %"),
}
# Figures of each environment, the one by which methods are ranked first.
COMPARED = {
    SITES: ("error_of_presses_mm", "presses_to_median", "error_mm", "success"),
    SLIDE: ("map_score", "error_mm", "success"),
}
# Standard errors between a difference and 0 for a power of 80 % at 5 %, two-sided: normal quantiles 1.96 + 0.84.
POWER = 2.8


@dataclass(frozen=True)
class Difference:
    """One figure of two methods on the same episodes.

    Fields:
        figure: a name of SHOWN
        first, second: the figure of each
        difference: first - second, with its interval; draws in which neither reaches the line are left out
        episode_count: of the same organs, that would show a difference of this size with a power of 80 % at 5 %;
            infinity without a difference, None of presses
    """

    figure: str
    first: float
    second: float
    difference: ScoreEstimate
    episode_count: float | None = None


def compare(
    first: Result, second: Result, rng: np.random.Generator, figures: Collection[str] = tuple(SHOWN)
) -> list[Difference]:
    """Differences of two results by a paired bootstrap (Efron & Tibshirani 1993, ch. 8).

    A draw (`resamples`) takes the same episodes for both. It compares the figures of COMPARED, else `success`.

    Raises:
        ValueError: results of other seeds, environments or physics, or without single episodes (names both).
    """
    for result in (first, second):
        if not result.episodes:
            raise ValueError(f"the result of {result.method} does not list its episodes: evaluate it again")
    for fault in _faults(first, second):
        raise ValueError(f"{first.method} and {second.method} cannot be compared: {fault}: evaluate both again")
    draws = resamples(len(first.seeds), first.members, rng)
    names = [name for name in COMPARED.get(first.env_id, ("success",)) if name in figures]
    return [(_presses if name == "presses_to_median" else _means)(name, first, second, draws) for name in names]


def _means(name: str, first: Result, second: Result, draws: list[NDArray[np.intp]]) -> Difference:
    """Means of one number per episode; the count of episodes is n (POWER se / difference)^2."""
    values = np.array([first.episodes[name], second.episodes[name]], dtype=np.float64)
    paired = values[0] - values[1]
    drawn = np.array([paired[draw].mean() for draw in draws])
    difference, error = float(paired.mean()), float(drawn.std())
    steps = POWER * error / difference if difference else math.inf
    estimate, (one, other) = figure_with_interval(difference, drawn), values.mean(axis=1).tolist()
    return Difference(name, one, other, estimate, len(paired) * steps * steps)


def _presses(name: str, first: Result, second: Result, draws: list[NDArray[np.intp]]) -> Difference:
    samples = [np.arange(len(first.seeds)), *draws]
    values = np.array(
        [[median_presses(each.errors_mm, each.lesion_counts, sample) for sample in samples] for each in (first, second)]
    )
    # Never less never is undefined: NaN.
    with np.errstate(invalid="ignore"):
        differences = values[0] - values[1]
    one, other = values[:, 0].tolist()
    return Difference(name, one, other, figure_with_interval(float(differences[0]), differences[1:]))


def describe(difference: Difference, first: str, second: str) -> str:
    """One line: the figures of two methods, their difference, and the episodes that tell them apart."""
    heading, digits, factor, unit = SHOWN[difference.figure]

    def shown(value: float | None, form: str = "") -> str:
        return "undefined" if value is None else f"{value * factor:{form}.{digits}f}"

    estimate = difference.difference
    interval = f"{shown(estimate.value, '+')} ({shown(estimate.low, '+')} to {shown(estimate.high, '+')})"
    values = f"{first} {shown(difference.first)}, {second} {shown(difference.second)}{unit}"
    line = f"{heading}: {values}; difference {interval}{unit}"
    if difference.figure in ("map_score", "error_of_presses_mm") and math.isfinite(difference.episode_count or 0.0):
        line += f"; {difference.episode_count:.0f} episodes tell them apart (power 80 %, level 5 %)"
    return line


def _faults(first: Result, second: Result) -> Iterator[str]:
    if first.seeds != second.seeds:
        yield f"their seeds are {seeds_text(first.seeds)} and {seeds_text(second.seeds)}"
    if (first.env_id, first.place, first.budget) != (second.env_id, second.place, second.budget):
        yield f"they played {first.place} with {first.budget} steps and {second.place} with {second.budget}"
    if first.physics_version != second.physics_version:
        yield f"their physics versions are {first.physics_version} and {second.physics_version}"
