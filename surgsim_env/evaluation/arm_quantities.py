"""What is told of an arm at a point: each quantity's name, unit and definition; shares, extremes, the verdict."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from surgsim_env.evaluation.arm_results import REASONS, ArmReach, ArmsEvaluation

SIDES = ("left", "right")


@dataclass(frozen=True)
class Quantity:
    """A figure that an arm has at each point that it reaches.

    Fields:
        field: of ArmReach
        title: in words
        unit: as the report shows it; empty for a pure number
        scale: from SI to that unit
        digits: after the point, in that unit; None for three significant ones
        si: the unit's suffix in points.csv
        more_is_better: which way is good
        definition: one sentence
    """

    field: str
    title: str
    unit: str
    scale: float
    digits: int | None
    si: str
    more_is_better: bool
    definition: str

    def text(self, value: float, with_unit: bool = True) -> str:
        """A value in SI as the report shows it; a dash where there is none."""
        return number_text(value, self.scale, self.digits, self.unit if with_unit else "")

    @property
    def label(self) -> str:
        """Title, and unit in brackets."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


QUANTITIES = (
    Quantity("tip_force", "tip force", "N", 1.0, 2, "_N", True,
             "Largest static force of the tip along the inward normal of the surface within the joints' torque and "
             "force limits, at the joints found, gravity compensated and the trocar bearing nothing."),
    Quantity("organ_clearance", "clearance from the organ", "mm", 1e3, 1, "_m", True,
             "Smallest distance between the arm's surface and the organ at rest; the tip's ball and 5 mm about it, "
             "which are to touch, are left out."),
    Quantity("wall_clearance", "clearance from the body wall", "mm", 1e3, 1, "_m", True,
             "Smallest distance between the arm's surface and the body wall, a dome or plate through the ports; "
             "what lies in the hole about the arm's own port is left out. Sizes of wall and hole stand in the "
             "inputs."),
    Quantity("approach_share", "approach directions", "%", 100.0, 0, "", True,
             "Share of 32 directions, spread evenly over the half space above the surface, from which the tip can "
             "come to the point within 10 degrees."),
    Quantity("limit_margin", "distance from joint limits", "", 1.0, 2, "", True,
             "Product over the joints of 4 (q - low)(high - q) / (high - low)²: 1 in the middle of every joint's "
             "range, 0 at any limit."),
    Quantity("manipulability", "manipulability", "", 1.0, None, "", True,
             "Yoshikawa's sqrt(det J Jᵀ), the product of the singular values of the tip's Jacobian in SI units, "
             "one radian of turning counted as 0.1 m; 0 where a direction is lost. It compares points and ports of "
             "one arm."),
    Quantity("isotropy", "isotropy", "", 1.0, 3, "", True,
             "Smallest over largest singular value of that Jacobian: 1 moves alike in every direction, 0 not at "
             "all in one."),
    Quantity("trocar_load", "sideways load on the trocar", "N", 1.0, 2, "_N", False,
             "Sideways force on the trocar while the tip presses with 1 N along the inward normal, the shaft taken "
             "as a lever whose outer end is held without a moment."),
    Quantity("camera_angle", "angle to the camera", "degrees", 180.0 / math.pi, 0, "_rad", True,
             "Angle between the instrument's shaft and the line of sight from the endoscope's port to the point: "
             "at a small angle the shaft hides what the tip does."),
    Quantity("position_error", "tip error", "mm", 1e3, 3, "_m", False,
             "Distance between the point and the tip at the joints found."),
    Quantity("trocar_error", "trocar error", "mm", 1e3, 3, "_m", False,
             "Distance between the shaft's axis and the trocar at the joints found."),
)  # fmt: skip
DISTANCES = (
    ("arm_distance_inside", "distance between the arms inside the body",
     "Smallest distance between the two arms' surfaces inside the body with both tips at the point, what lies within "
     "20 mm of it left out; only where each reaches it."),
    ("arm_distance_outside", "distance between the arms outside the body",
     "The same outside the body."),
)  # fmt: skip
SHARE_DEFINITIONS = (
    ("reachable", "A point is reachable by an arm when joints within their limits put the tip there, the shaft passes "
     "through the trocar, and neither shaft nor links touch the organ or the body wall."),
    ("both", "A point is reachable by both at once when each arm reaches it and the arms are at least 5 mm apart, "
     "inside the body and outside, but for the 20 mm about the point where the tips meet."),
)  # fmt: skip


class Extreme(NamedTuple):
    """A least value [SI] with the arm and the point it belongs to; NaN, "" and -1 where there is none."""

    value: float
    side: str
    point: int


def number_text(value: float, scale: float = 1.0, digits: int | None = 1, unit: str = "") -> str:
    """A number rounded for reading, with its unit; a dash for NaN."""
    if not math.isfinite(value):
        return "–"
    shown = f"{value * scale:.3g}" if digits is None else f"{value * scale:.{digits}f}"
    if digits is not None and float(shown) == 0.0:
        shown = shown.lstrip("-")
    return f"{shown} {unit}" if unit else shown


def share_text(mask: NDArray[np.bool_]) -> str:
    """A share of points in whole per cent; `<1 %` and `>99 %` where rounding would say none or all."""
    share = 100.0 * float(np.mean(mask)) if len(mask) else 0.0
    if 0.0 < share < 0.5:
        return "<1 %"
    return ">99 %" if 99.5 <= share < 100.0 else f"{share:.0f} %"


def sides(evaluation: ArmsEvaluation) -> tuple[tuple[str, ArmReach], tuple[str, ArmReach]]:
    """Both arms with the names of their sides."""
    return (SIDES[0], evaluation.left), (SIDES[1], evaluation.right)


def values_of(arm: ArmReach, quantity: Quantity) -> FloatArray:
    """A quantity at every point [SI], NaN where the arm does not reach."""
    return np.where(arm.reachable, getattr(arm, quantity.field), np.nan)


def worse_of_both(evaluation: ArmsEvaluation, quantity: Quantity) -> FloatArray:
    """The worse of both arms' values at the points that both reach at once, NaN elsewhere."""
    pair = np.stack([getattr(arm, quantity.field) for _, arm in sides(evaluation)])
    return np.where(evaluation.both, pair.min(axis=0) if quantity.more_is_better else pair.max(axis=0), np.nan)


def extreme(evaluation: ArmsEvaluation, field: str) -> Extreme:
    """The least finite value of a field of ArmReach over both arms and all points that they reach."""
    found = Extreme(math.nan, "", -1)
    for side, arm in sides(evaluation):
        values = np.where(arm.reachable & np.isfinite(getattr(arm, field)), getattr(arm, field), np.nan)
        if np.isnan(values).all():
            continue
        index = int(np.nanargmin(values))
        value = float(values[index])
        if not found.side or value < found.value:
            found = Extreme(value, side, index)
    return found


def worst_clearance(evaluation: ArmsEvaluation) -> tuple[Extreme, str]:
    """The smallest clearance of either arm from organ or wall, and from which of them."""
    organ, wall = extreme(evaluation, "organ_clearance"), extreme(evaluation, "wall_clearance")
    return (wall, "the body wall") if organ.side == "" or wall.value < organ.value else (organ, "the organ")


def median(values: FloatArray) -> float:
    """The median of what is finite; NaN if nothing is."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan


def reason_counts(arm: ArmReach) -> list[tuple[str, int]]:
    """Why points are out of reach and how many for each reason, the commonest first."""
    counts = np.bincount(arm.reason, minlength=len(REASONS))[1:]
    order = sorted(range(len(counts)), key=lambda index: (-counts[index], index))
    return [(REASONS[index + 1], int(counts[index])) for index in order if counts[index]]


def clearances(evaluation: ArmsEvaluation) -> FloatArray:
    """The smaller of the distances from organ and wall of either arm at every point that it reaches [m], (n,)."""
    parts = [
        np.minimum(arm.organ_clearance, arm.wall_clearance)[arm.reachable & np.isfinite(arm.organ_clearance)]
        for _, arm in sides(evaluation)
    ]
    return np.concatenate(parts)


def surface_shares(evaluation: ArmsEvaluation) -> tuple[float, float, float]:
    """Shares of the points of the surface that the left arm, the right arm and both at once reach, 0 to 1."""
    outer = ~evaluation.inner
    masks = (evaluation.left.reachable, evaluation.right.reachable, evaluation.both)
    left, right, both = (float(mask[outer].mean()) if outer.any() else 0.0 for mask in masks)
    return left, right, both


def verdict(evaluation: ArmsEvaluation) -> str:
    """The first paragraph of a report: shares, worst clearance, smallest tip force, the commonest obstacles."""
    inner, outer = evaluation.inner, ~evaluation.inner
    left, right = (share_text(arm.reachable[outer]) for _, arm in sides(evaluation))
    said = [
        f"Of {int(outer.sum())} points on the surface of {evaluation.scene} that face the ports, the left arm reaches "
        f"{left}, the right arm {right}, and both at once {share_text(evaluation.both[outer])}."
    ]
    if inner.any():
        reached = int(evaluation.both[inner].sum())
        if inner.sum() == 1:
            said.append(f"{'Both' if reached else 'Not both'} reach the target inside it at once.")
        else:
            said.append(f"Of {int(inner.sum())} targets inside it both at once reach {reached}.")
    if not (evaluation.left.reachable.any() or evaluation.right.reachable.any()):
        said.append("There is nothing to tell of clearances and forces.")
    else:
        clearance, what = worst_clearance(evaluation)
        if clearance.side:
            distance = number_text(clearance.value, 1e3, 1, "mm")
            usual = number_text(median(clearances(evaluation)), 1e3, 1, "mm")
            said.append(
                f"The worst clearance is {distance}, between the {clearance.side} arm and {what}; the median is "
                f"{usual}."
            )
        force = extreme(evaluation, "tip_force")
        if force.side:
            said.append(
                f"The smallest tip force is {number_text(force.value, 1.0, 2, 'N')} ({force.side} arm): at least that "
                "can be pressed with wherever an arm reaches."
            )
    obstacles = [
        f"the {side} arm most often because {_because(counts[0][0])} ({counts[0][1]} points)"
        for side, arm in sides(evaluation)
        if (counts := reason_counts(arm))
    ]
    if obstacles:
        said.append(f"Points are missed by {', by '.join(obstacles)}.")
    return " ".join(said)


def _because(reason: str) -> str:
    return f"of {reason}" if reason == REASONS[2] else reason
