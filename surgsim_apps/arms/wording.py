"""Numbers, shares and verdict of an evaluation in words."""

import math

import numpy as np
from numpy.typing import NDArray

from surgsim_apps.arms.results import ArmsEvaluation


def number_text(value: float, scale: float = 1.0, digits: int | None = 1, unit: str = "") -> str:
    """A number rounded for reading, with its unit; a dash for NaN."""
    if not math.isfinite(value):
        return "–"
    shown = f"{value * scale:.3g}" if digits is None else f"{value * scale:.{digits}f}"
    if digits is not None and float(shown) == 0.0:
        shown = shown.lstrip("-")
    return f"{shown} {unit}" if unit else shown


def share_text(mask: NDArray[np.bool_]) -> str:
    """A share of points in whole per cent; `<1 %` and `>99 %` instead of none or all by rounding alone."""
    share = 100.0 * float(np.mean(mask)) if len(mask) else 0.0
    if 0.0 < share < 0.5:
        return "<1 %"
    return ">99 %" if 99.5 <= share < 100.0 else f"{share:.0f} %"


def verdict(evaluation: ArmsEvaluation) -> str:
    """The first paragraph of a report: the shares of points in reach of each arm and of both at once."""
    inner, outer = evaluation.inner, ~evaluation.inner
    left, right = (share_text(arm.reachable[outer]) for arm in evaluation.arms.values())
    shares = (
        f"Of {int(outer.sum())} points on the surface of {evaluation.scene} that face the ports, the left arm reaches "
        f"{left}, the right arm {right}, and both at once {share_text(evaluation.both[outer])}."
    )
    if not inner.any():
        return shares
    return f"{shares} Of {int(inner.sum())} targets inside it both at once reach {int(evaluation.both[inner].sum())}."
