"""What a validation case gives: rows of the table and curves for its plots."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

Verdict = Literal["met", "not met", "skipped"]


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Args:
        case: its name, one of a kind.
        source: where the expected value comes from.
        expected, measured: in `unit`.
        error: of the measured value, relative unless `absolute`.
        tolerance: largest size of the error.
        verdict: "met", "not met" or "skipped".
        unit: SI, empty for a ratio.
        absolute: whether error and tolerance are in `unit` instead of shares of the expected value.
        note: what a reader should know.
    """

    case: str
    source: str
    expected: float
    measured: float
    error: float
    tolerance: float
    verdict: Verdict
    unit: str = ""
    absolute: bool = False
    note: str = ""


@dataclass(frozen=True)
class Curve:
    """A line of a plot: `figure` is the plot's name, `label` the line's."""

    figure: str
    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    x_label: str = "cell [mm]"
    y_label: str = "size of the error"
    logarithmic: bool = True


@dataclass(frozen=True)
class Picture:
    """A picture of its own: file name without ending, what it shows, and what draws it to a path."""

    name: str
    caption: str
    draw: Callable[[Path], None]


@dataclass(frozen=True)
class Outcome:
    """All that one case found."""

    rows: tuple[Row, ...]
    curves: tuple[Curve, ...] = ()
    pictures: tuple[Picture, ...] = ()


@dataclass(frozen=True)
class Case:
    """A named computation; `slow` ones are left out of a quick run."""

    name: str
    run: Callable[[], Outcome]
    slow: bool = False
    needs_fem: bool = False


def compare(
    case: str,
    source: str,
    *,
    expected: float,
    measured: float,
    tolerance: float,
    unit: str = "",
    absolute: bool = False,
    note: str = "",
) -> Row:
    """A row whose verdict follows from its error and tolerance; a number that is not finite is not met."""
    error = measured - expected if absolute else measured / expected - 1.0
    verdict: Verdict = "met" if math.isfinite(error) and abs(error) <= tolerance else "not met"
    return Row(case, source, expected, measured, error, tolerance, verdict, unit, absolute, note)


def bounded(
    case: str,
    source: str,
    *,
    measured: float,
    least: float = -math.inf,
    most: float = math.inf,
    unit: str = "",
    note: str = "",
) -> Row:
    """A row whose measured value has a bound on one side, shown as what is expected."""
    bound = least if math.isfinite(least) else most
    verdict: Verdict = "met" if least <= measured <= most else "not met"
    side = "verdict: at least that" if math.isfinite(least) else "verdict: at most that"
    text = f"{side}; {note}" if note else side
    return Row(case, source, bound, measured, measured / bound - 1.0, math.inf, verdict, unit, note=text)


def convergence_order(sizes: list[float], errors: list[float]) -> float:
    """The p of |error| = C size^p, by least squares of the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(np.abs(errors)), 1)[0])


def falling(case: str, sizes: list[float], errors: list[float], *, note: str = "") -> Row:
    """Whether the error's size falls with every finer mesh, and with what order (sizes from coarse to fine)."""
    order = convergence_order(sizes, errors)
    falls = bool(np.all(np.diff(np.abs(errors)) < 0.0))
    verdict: Verdict = "met" if falls else "not met"
    text = "verdict: the error falls on every finer mesh"
    return Row(
        case,
        "springs cut at a surface: O(cell)",
        1.0,
        order,
        order - 1.0,
        math.inf,
        verdict,
        absolute=True,
        note=f"{text}; {note}" if note else text,
    )


def skipped(case: str, source: str, reason: str) -> Row:
    """A row that could not be worked out here, and why."""
    return Row(case, source, math.nan, math.nan, math.nan, math.nan, "skipped", note=reason)
