"""Quantities of an evaluation of two arms: definitions, values at the points, statistics."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_apps.arms.results import ArmReach, ArmsEvaluation


@dataclass(frozen=True)
class Quantity:
    """A quantity of an arm at each point in its reach.

    Fields:
        field: of ArmReach
        title: in words
        unit: in the report; empty for a pure number
        scale: from SI to that unit
        digits: after the point, in that unit; None for three significant ones
        si: the unit's suffix in points.csv
        more_is_better: True if a larger value is the better one
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

    @property
    def label(self) -> str:
        """Title, and unit in brackets."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    def values(self, arm: ArmReach) -> FloatArray:
        """Values of an arm at every point [SI], NaN out of reach."""
        return np.where(arm.reachable, getattr(arm, self.field), np.nan)

    def worse_of_both(self, evaluation: ArmsEvaluation) -> FloatArray:
        """The worse of both arms' values at points that both reach at once [SI], NaN elsewhere."""
        pair = np.stack([getattr(arm, self.field) for arm in evaluation.arms.values()])
        return np.where(evaluation.both, pair.min(axis=0) if self.more_is_better else pair.max(axis=0), np.nan)


QUANTITIES = (
    Quantity("tip_force", "tip force", "N", 1.0, 2, "_N", True,
             "Largest static force of the tip along the inward normal of the surface within the joints' torque and "
             "force limits, at the joints found, with gravity compensated and no load on the trocar."),
    Quantity("organ_clearance", "clearance of shaft and links from the organ", "mm", 1e3, 1, "_m", True,
             "Smallest distance between the arm's surface and the organ at rest, without the contact on purpose: the "
             "tip's ball and 20 mm about it, where the tool works, are left out."),
    Quantity("wall_clearance", "clearance from the body wall", "mm", 1e3, 1, "_m", True,
             "Smallest distance between the arm's surface and the body wall, a dome or plate through the ports; "
             "parts in the hole about the arm's own port are left out."),
    Quantity("approach_share", "approach directions", "%", 100.0, 0, "", True,
             "Share of 32 directions, spread evenly over the half space above the surface, from which the tip can "
             "come to the point within 10 degrees."),
    Quantity("limit_margin", "distance from joint limits", "", 1.0, 2, "", True,
             "Product over the joints of 4 (q - low)(high - q) / (high - low)²: 1 in the middle of every joint's "
             "range, 0 at any limit."),
    Quantity("manipulability", "manipulability", "", 1.0, None, "", True,
             "Yoshikawa's sqrt(det J Jᵀ), the product of the singular values of the tip's Jacobian in SI units, "
             "one radian of rotation counted as 0.1 m; 0 at a singularity. It compares points and ports of one "
             "arm."),
    Quantity("isotropy", "isotropy", "", 1.0, 3, "", True,
             "Smallest over largest singular value of that Jacobian: 1 where the tip moves alike in all "
             "directions, 0 at a singularity."),
    Quantity("trocar_load", "sideways load on the trocar", "N", 1.0, 2, "_N", False,
             "Sideways force on the trocar while the tip presses with 1 N along the inward normal, the shaft taken "
             "as a lever whose outer end is held without a moment."),
    Quantity("camera_angle", "angle to the camera", "degrees", 180.0 / math.pi, 0, "_rad", True,
             "Angle between the instrument's shaft and the line of sight from the endoscope's port to the point: "
             "at a small angle the shaft hides what the tip does."),
    Quantity("position_error", "contact on purpose: tip from its point", "mm", 1e3, 3, "_m", False,
             "Distance between the point and the tip at the joints found."),
    Quantity("trocar_error", "trocar error", "mm", 1e3, 3, "_m", False,
             "Distance between the shaft's axis and the trocar at the joints found."),
)  # fmt: skip
DISTANCES = (
    ("arm_distance_inside", "distance between the arms inside the body",
     "Smallest distance between the two arms' surfaces inside the body with both tips at the point; parts within "
     "20 mm of it are left out; only where each arm reaches it."),
    ("arm_distance_outside", "distance between the arms outside the body",
     "The same outside the body."),
)  # fmt: skip


class Spread(NamedTuple):
    """Least, median and greatest of the finite values of an array; NaN if there are none."""

    least: float
    median: float
    greatest: float


def spread(values: FloatArray) -> Spread:
    """Least, median and greatest of the finite values."""
    known = values[np.isfinite(values)]
    if not known.size:
        return Spread(math.nan, math.nan, math.nan)
    return Spread(float(known.min()), float(np.median(known)), float(known.max()))
