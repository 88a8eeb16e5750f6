"""Results of a validation case: rows of the table, curves of plots, drawings."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, SupportsFloat

import numpy as np
from numpy.typing import NDArray

Verdict = Literal["met", "not met", "skipped"]


@dataclass(frozen=True)
class Row:
    """Line of the table.

    Args:
        case: its name, unique.
        source: of the expected value.
        expected, measured: in `unit`.
        error: of the measured value, relative unless `absolute`.
        tolerance: largest size of the error.
        verdict: "met", "not met" or "skipped".
        unit: SI, empty for a ratio.
        absolute: true for error and tolerance in `unit` instead of shares of the expected value.
        note: remark for the reader of the table.
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


@dataclass(frozen=True, eq=False)
class Curve:
    """Line of a plot; `figure` is the plot's name."""

    figure: str
    label: str
    x: Sequence[float] | NDArray[np.floating]
    y: Sequence[float] | NDArray[np.floating]
    x_label: str = "cell [mm]"
    y_label: str = "size of the error"
    logarithmic: bool = True


@dataclass(frozen=True)
class Drawing:
    """Picture of a case: file name without suffix, caption, and a function to draw it to a path."""

    name: str
    caption: str
    draw: Callable[[Path], None]


Result = Row | Curve | Drawing


@dataclass(frozen=True)
class Case:
    """Named computation; `slow` ones are left out of a quick run, `needs_fem` ones need scikit-fem."""

    name: str
    run: Callable[[], Iterable[Result]]
    slow: bool = False
    needs_fem: bool = False


def compare(
    case: str,
    source: str,
    *,
    expected: SupportsFloat,
    measured: SupportsFloat,
    tolerance: float,
    unit: str = "",
    absolute: bool = False,
    note: str = "",
) -> Row:
    """Row with the verdict by error and tolerance; a number that is not finite is not met.

    The error is absolute if asked for, or if the expected value is 0.
    """
    expected, measured = float(expected), float(measured)
    absolute = absolute or expected == 0.0
    error = measured - expected if absolute else measured / expected - 1.0
    verdict: Verdict = "met" if math.isfinite(error) and abs(error) <= tolerance else "not met"
    return Row(case, source, expected, measured, error, tolerance, verdict, unit, absolute, note)


def bounded(
    case: str,
    source: str,
    *,
    measured: SupportsFloat,
    least: float = -math.inf,
    most: float = math.inf,
    unit: str = "",
    note: str = "",
) -> Row:
    """Row with a bound of the measured value on one side, shown as expected."""
    measured, bound = float(measured), least if math.isfinite(least) else most
    verdict: Verdict = "met" if least <= measured <= most else "not met"
    side = "verdict: at least that" if math.isfinite(least) else "verdict: at most that"
    text = f"{side}; {note}" if note else side
    return Row(case, source, bound, measured, measured / bound - 1.0, math.inf, verdict, unit, note=text)


def with_order(name: str, sizes: list[float], rows: list[Row]) -> Iterator[Result]:
    """Rows of meshes from coarse to fine, the curve of their errors, and a row for their order.

    It shows p of |error| = C size^p, by least squares of the logarithms, and is met if every finer mesh has less error.
    """
    errors = np.array([abs(row.error) for row in rows])
    order = float(np.polyfit(np.log(sizes), np.log(errors), 1)[0])
    verdict: Verdict = "met" if (np.diff(errors) < 0.0).all() else "not met"
    yield from rows
    yield Row(
        f"{name}, order of the error", "springs cut at a surface: O(cell)", 1.0, order, order - 1.0, math.inf, verdict,
        absolute=True, note="verdict: the error falls on every finer mesh",
    )  # fmt: skip
    yield Curve("convergence", name, 1e3 * np.array(sizes), errors)
