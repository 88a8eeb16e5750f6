"""What an evaluation of two arms found: arrays over points, quantities, statistics, verdict, points.csv and ranking."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray, IntArray
from surgsim_env.scene import Port

SIDES = ("left", "right")
# Reasons why an arm does not reach a point, in the order of the tests; 0 is reachable.
REASONS = ("reachable", "no joints put the tip there", "a joint limit", "the shaft misses its trocar",
           "the arm touches the organ", "the arm touches the wall")  # fmt: skip
RANKING_RULE = (
    "Ranked by the share of the surface's points that both arms reach at once, in whole per cent, largest first (for "
    "a patient who breathes: at every position); equal shares by the share that either reaches, then by the median "
    "clearance from organ and body wall in whole millimetres, then by the smallest tip force in tenths of a newton, "
    "always the largest first; then as given."
)


@dataclass(frozen=True)
class ArmReach:
    """One arm at every point; what needs joints is NaN where the point is not reachable.

    Fields:
        name: of the arm, as its description says
        reason: index into REASONS                                                           (n_point,)
        joints: the best found [m, rad]                                                      (n_point, n_joint)
        position_error: of the tip [m]                                                       (n_point,)
        approach_share: share of 32 approach directions reached within 10 degrees            (n_point,)
        manipulability: Yoshikawa's sqrt(det J J^T), rotations scaled by the stated length   (n_point,)
        isotropy: smallest over largest singular value of that J                             (n_point,)
        limit_margin: product over joints of 4 (q - low)(high - q) / (high - low)^2          (n_point,)
        tip_force: largest static force along the inward normal within joint torques [N]     (n_point,)
        trocar_load: sideways force on the trocar at 1 N at the tip [N]                      (n_point,)
        camera_angle: between instrument shaft and the endoscope's line of sight [rad]       (n_point,)
        organ_clearance: smallest distance of shaft and links from the organ [m]             (n_point,)
        wall_clearance: smallest distance of shaft and links from the body wall [m]          (n_point,)
        trocar_error: distance of the shaft's axis from the trocar [m]                       (n_point,)
    """

    name: str
    reason: IntArray
    joints: FloatArray
    position_error: FloatArray
    approach_share: FloatArray
    manipulability: FloatArray
    isotropy: FloatArray
    limit_margin: FloatArray
    tip_force: FloatArray
    trocar_load: FloatArray
    camera_angle: FloatArray
    organ_clearance: FloatArray
    wall_clearance: FloatArray
    trocar_error: FloatArray

    @property
    def reachable(self) -> NDArray[np.bool_]:
        """Which points the arm reaches, (n_point,)."""
        return self.reason == 0


@dataclass(frozen=True)
class ArmThroughCycle:
    """One arm while the organ moves, at every point and position.

    What is along a path is NaN where the arm has none: it begins at rest where the arm reaches the point, keeps joint
    limits and trocar at every position, and touches neither organ nor wall.

    Fields:
        reachable: at each position by itself, whatever the joints before      (n_position, n_point)
        joints: along the path [m, rad]                                        (n_position, n_point, n_joint)
        clearance: smallest distance from organ and wall along the path [m]    (n_position, n_point)
    """

    reachable: NDArray[np.bool_]
    joints: FloatArray
    clearance: FloatArray

    @property
    def always(self) -> NDArray[np.bool_]:
        """Which points the arm reaches at every position, (n_point,)."""
        return np.asarray(self.reachable.all(axis=0))

    @property
    def has_path(self) -> NDArray[np.bool_]:
        """Which points the arm has a path for, (n_point,)."""
        return np.isfinite(self.joints[0, :, 0])


@dataclass(frozen=True)
class ThroughCycle:
    """Both arms on an organ that moves with its ground, each motion in its largest and quickest cycle.

    Fields:
        motions: their names, the one that moves the organ most first
        travel: largest displacement of any point by each motion [m]                  (n_motion,)
        period: of each [s]                                                           (n_motion,)
        left, right: each arm
        both: reachable by both at once at each position                              (n_position, n_point)
    """

    motions: tuple[str, ...]
    travel: FloatArray
    period: FloatArray
    left: ArmThroughCycle
    right: ArmThroughCycle
    both: NDArray[np.bool_]

    @property
    def arms(self) -> tuple[tuple[str, ArmThroughCycle], tuple[str, ArmThroughCycle]]:
        """Both arms with the names of their sides."""
        return (SIDES[0], self.left), (SIDES[1], self.right)

    @property
    def both_always(self) -> NDArray[np.bool_]:
        """Which points both reach at once at every position, (n_point,)."""
        return np.asarray(self.both.all(axis=0))


@dataclass(frozen=True)
class ArmsEvaluation:
    """Both arms on one scene.

    Fields:
        points, normals: of the organ's surface, outward, then the inner targets [m]          (n_point, 3)
        inner: which points are inner targets                                                 (n_point,)
        left, right: each arm alone
        both: reachable by both at once, the arms at least 5 mm apart                         (n_point,)
        arm_distance_inside, arm_distance_outside: smallest distance between the arms inside and outside the body
            with both tips at the point's neighbourhood [m], NaN where not both reach it      (n_point,)
        scene: name of the scene
        surface_points, surface_triangles: the organ's outer surface, for pictures            (n, 3), (m, 3)
        ports: where the arms ("left", "right") and the camera ("endoscope") enter
        cycle: both arms while the patient breathes; None for one who holds still
        picture: of the arms in the patient, RGB, (height, width, 3) uint8; None without one
    """

    points: FloatArray
    normals: FloatArray
    inner: NDArray[np.bool_]
    left: ArmReach
    right: ArmReach
    both: NDArray[np.bool_]
    arm_distance_inside: FloatArray
    arm_distance_outside: FloatArray
    scene: str
    surface_points: FloatArray
    surface_triangles: IntArray
    ports: Mapping[str, Port]
    cycle: ThroughCycle | None = None
    picture: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class Quantity:
    """A quantity that an arm has at each point that it reaches.

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
             "force limits, at the joints found, with gravity compensated and no load on the trocar."),
    Quantity("organ_clearance", "clearance from the organ", "mm", 1e3, 1, "_m", True,
             "Smallest distance between the arm's surface and the organ at rest; the tip's ball and 5 mm about it "
             "are left out."),
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
    Quantity("position_error", "tip error", "mm", 1e3, 3, "_m", False,
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
SHARE_DEFINITIONS = (
    ("reachable", "A point is reachable by an arm when joints within their limits put the tip there, the shaft passes "
     "through the trocar, and neither shaft nor links touch the organ or the body wall."),
    ("both", "A point is reachable by both at once when each arm reaches it and the arms are at least 5 mm apart, "
     "inside the body and outside, except within 20 mm of the point, where the tips meet."),
)  # fmt: skip


class Spread(NamedTuple):
    """Least, median and greatest of the finite values of an array; NaN where there are none."""

    least: float
    median: float
    greatest: float

    def texts(self, scale: float, digits: int | None) -> tuple[str, str, str]:
        """All three rounded for reading, without a unit; see `number_text`."""
        least, median, greatest = (number_text(value, scale, digits) for value in self)
        return least, median, greatest


def number_text(value: float, scale: float = 1.0, digits: int | None = 1, unit: str = "") -> str:
    """A number rounded for reading, with its unit; a dash for NaN."""
    if not math.isfinite(value):
        return "–"
    shown = f"{value * scale:.3g}" if digits is None else f"{value * scale:.{digits}f}"
    if digits is not None and float(shown) == 0.0:
        shown = shown.lstrip("-")
    return f"{shown} {unit}" if unit else shown


def spread(values: FloatArray) -> Spread:
    """Least, median and greatest of the finite values."""
    known = values[np.isfinite(values)]
    if not known.size:
        return Spread(math.nan, math.nan, math.nan)
    return Spread(float(known.min()), float(np.median(known)), float(known.max()))


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


def clearances(evaluation: ArmsEvaluation) -> FloatArray:
    """The smaller of the distances from organ and wall of either arm at every point that it reaches [m], (n,)."""
    parts = [
        np.minimum(arm.organ_clearance, arm.wall_clearance)[arm.reachable & np.isfinite(arm.organ_clearance)]
        for _, arm in sides(evaluation)
    ]
    return np.concatenate(parts)


def verdict(evaluation: ArmsEvaluation) -> str:
    """The first paragraph of a report: the shares of points that each arm and both at once reach."""
    inner, outer = evaluation.inner, ~evaluation.inner
    left, right = (share_text(arm.reachable[outer]) for _, arm in sides(evaluation))
    said = (
        f"Of {int(outer.sum())} points on the surface of {evaluation.scene} that face the ports, the left arm reaches "
        f"{left}, the right arm {right}, and both at once {share_text(evaluation.both[outer])}."
    )
    if not inner.any():
        return said
    return f"{said} Of {int(inner.sum())} targets inside it both at once reach {int(evaluation.both[inner].sum())}."


@dataclass(frozen=True)
class Ranked:
    """A row of the ranking; shares 0 to 1, median clearance [m], smallest force [N], NaN where nothing is reached."""

    name: str
    what: str
    left: float
    right: float
    both: float
    either: float
    clearance: float
    force: float


# Columns of points.csv of each arm while the patient breathes.
CYCLE_COLUMNS = ("always", "has_path", "path_clearance_worst_m")


def columns(evaluation: ArmsEvaluation) -> list[str]:
    """The columns of points.csv; names of figures end with their SI unit."""
    listed = ["point", "x_m", "y_m", "z_m", "normal_x", "normal_y", "normal_z", "inner"]
    for side, arm in sides(evaluation):
        listed += [f"{side}_reachable", f"{side}_reason"]
        listed += [f"{side}_{quantity.field}{quantity.si}" for quantity in QUANTITIES]
        listed += [f"{side}_joint_{number}" for number in range(arm.joints.shape[1])]
    listed += ["both", *(f"{field}_m" for field, _, _ in DISTANCES)]
    if evaluation.cycle is not None:
        listed += [f"{side}_{name}" for side in SIDES for name in CYCLE_COLUMNS]
        listed.append("both_always")
    return listed


def write_points(evaluation: ArmsEvaluation, path: Path) -> None:
    """One line for each point, in SI units; empty where there is no value."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns(evaluation))
        for index in range(len(evaluation.points)):
            row = [str(index), *map(_cell, (*evaluation.points[index], *evaluation.normals[index]))]
            row.append(str(int(evaluation.inner[index])))
            for _, arm in sides(evaluation):
                reached = bool(arm.reachable[index])
                row += [str(int(reached)), "" if reached else REASONS[arm.reason[index]]]
                row += [_cell(getattr(arm, quantity.field)[index]) for quantity in QUANTITIES]
                row += map(_cell, arm.joints[index])
            row.append(str(int(evaluation.both[index])))
            row.extend(_cell(getattr(evaluation, field)[index]) for field, _, _ in DISTANCES)
            if evaluation.cycle is not None:
                row.extend(_cycle_cells(evaluation.cycle, index))
            writer.writerow(row)


def _cycle_cells(cycle: ThroughCycle, index: int) -> list[str]:
    """The cells of a point under CYCLE_COLUMNS for each arm, and whether both reach it at every position."""
    cells = []
    for _, arm in cycle.arms:
        cells += [str(int(arm.always[index])), str(int(arm.has_path[index])), _cell(arm.clearance[:, index].min())]
    return [*cells, str(int(cycle.both_always[index]))]


def rank(candidates: Sequence[tuple[str, str, ArmsEvaluation]]) -> list[Ranked]:
    """Placements or robots in the order of RANKING_RULE.

    Args:
        candidates: name, description in a few words, and evaluation of each.
    """
    return sorted((_row(*one) for one in candidates), key=_rank_key)


def _row(name: str, what: str, evaluation: ArmsEvaluation) -> Ranked:
    outer, by_left, by_right = ~evaluation.inner, evaluation.left.reachable, evaluation.right.reachable
    together = evaluation.both if evaluation.cycle is None else evaluation.cycle.both_always
    masks = (by_left, by_right, together, by_left | by_right)
    left, right, both, either = (float(mask[outer].mean()) if outer.any() else 0.0 for mask in masks)
    force = spread(np.concatenate([arm.tip_force[arm.reachable] for _, arm in sides(evaluation)])).least
    return Ranked(name, what, left, right, both, either, spread(clearances(evaluation)).median, force)


def _rank_key(row: Ranked) -> tuple[float, ...]:
    return -_per_cent(row.both), -_per_cent(row.either), -_whole(row.clearance, 1e3), -_whole(row.force, 10.0)


def _per_cent(share: float) -> int:
    return round(100.0 * share)


def _whole(value: float, scale: float) -> float:
    return round(value * scale) if math.isfinite(value) else -math.inf


def _cell(value: float) -> str:
    return "" if np.isnan(value) else f"{float(value):.9g}"
