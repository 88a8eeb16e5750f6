"""Numbers, shares and verdict of an evaluation in words."""

import math

import numpy as np
from numpy.typing import NDArray

from surgsim_apps.arms.quantities import spread
from surgsim_apps.arms.results import REASONS, ArmsEvaluation

# Least shares of the points that both arms reach at once: chosen.
GRADES = (("Good", 0.9), ("Fair", 0.7))


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
    if 0.0 < share <= 0.5:
        return "<1 %"
    return ">99 %" if 99.5 <= share < 100.0 else f"{share:.0f} %"


def verdict(evaluation: ArmsEvaluation) -> str:
    """The first paragraph of a report: is the placement good, what limits it, and the next change."""
    return " ".join(filter(None, (_shares(evaluation), _limit(evaluation), _clearance(evaluation), _next(evaluation))))


def _shares(evaluation: ArmsEvaluation) -> str:
    inner, outer = evaluation.inner, ~evaluation.inner
    left, right = (share_text(arm.reachable[outer]) for arm in evaluation.arms.values())
    both = evaluation.both[outer]
    grade = next((grade for grade, least in GRADES if both.mean() >= least), "Poor")
    shares = (
        f"{grade} placement: of {int(outer.sum())} points on the surface of {evaluation.scene} that face the ports, "
        f"the left arm reaches {left}, the right arm {right}, and both at once {share_text(both)}."
    )
    if not inner.any():
        return shares
    return f"{shares} Of {int(inner.sum())} targets inside it both at once reach {int(evaluation.both[inner].sum())}."


def _limit(evaluation: ArmsEvaluation) -> str:
    """The obstacle of most points on the surface that both do not reach at once."""
    lost = ~evaluation.both & ~evaluation.inner
    apart = lost & evaluation.left.reachable & evaluation.right.reachable
    obstacles = [(apart, "the arms come too close to each other")]
    for side, arm in evaluation.arms.items():
        obstacles += [
            (lost & (arm.reason == index), f"{REASONS[index]} ({side} arm)") for index in range(1, len(REASONS))
        ]
    mask, words = max(obstacles, key=lambda obstacle: obstacle[0].sum())
    return f"What limits most, at {share_text(mask[~evaluation.inner])} of them: {words}." if mask.any() else ""


def _clearance(evaluation: ArmsEvaluation) -> str:
    """The least clearances of all that is not to touch."""
    together = np.minimum(evaluation.arm_distance_inside, evaluation.arm_distance_outside)[evaluation.both]
    arms = evaluation.arms.values()
    distances = [
        ("from the organ", np.concatenate([arm.organ_clearance for arm in arms])),
        ("from the body wall", np.concatenate([arm.wall_clearance for arm in arms])),
        ("from each other", together),
    ]
    shown = [f"{number_text(spread(values).least, 1e3, 1)} mm {where}" for where, values in distances if values.size]
    return f"The tips touch on purpose; shafts and links stay at least {', '.join(shown)}."


def _next(evaluation: ArmsEvaluation) -> str:
    move = evaluation.move
    if move is None:
        return (
            "No move of one port by 2 cm along the body wall lets both reach 1 % more."
            if evaluation.moves_tried
            else ""
        )
    before, after = (number_text(share, 100.0, 0) for share in (move.before, move.after))
    return (
        f"Best next change: move the {move.side} port {move.words} in the camera's picture, along the body wall; then "
        f"both reach {after} % instead of {before} % (estimated by a quick search)."
    )
