"""Whether two arms reach a point at once: the pair of their candidates that keeps the arms apart."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from surgsim_env.evaluation.collisions import arm_distances
from surgsim_env.evaluation.dexterity import limit_margin
from surgsim_env.evaluation.reach import Reach

# Arms at once keep this apart [m].
ARM_DISTANCE = 0.005
# So many ways of standing of each arm are paired where the first pair does not keep it.
WAYS = 6


@dataclass(frozen=True)
class BothArms:
    """Which points both reach at once (n,), and the pair's smallest distances inside and outside the body [m] (n,)."""

    reachable: NDArray[np.bool_]
    inside: FloatArray
    outside: FloatArray


def evaluate_both(left: Reach, right: Reach, points: FloatArray) -> BothArms:
    """Pair the arms' reported ways of standing, and where these come closer than 5 mm the best of 6 x 6 others."""
    inside, outside = np.full(len(points), np.nan), np.full(len(points), np.nan)
    rows = np.flatnonzero(left.report.reachable & right.report.reachable)
    if rows.size:
        inside[rows], outside[rows] = _distances(
            left, right, left.report.joints[rows], right.report.joints[rows], points[rows]
        )
    close = rows[np.minimum(inside[rows], outside[rows]) < ARM_DISTANCE]
    if close.size:
        _improve(left, right, points, close, inside, outside)
    with np.errstate(invalid="ignore"):
        return BothArms(np.minimum(inside, outside) >= ARM_DISTANCE, inside, outside)


def _improve(
    left: Reach, right: Reach, points: FloatArray, rows: NDArray, inside: FloatArray, outside: FloatArray
) -> None:
    """Put the distances of the widest pair of ways at rows into inside and outside."""
    ways = [_ways(arm, rows) for arm in (left, right)]
    for first in range(WAYS):
        for second in range(WAYS):
            near, far = _distances(left, right, ways[0][:, first], ways[1][:, second], points[rows])
            wider = np.minimum(near, far) > np.minimum(inside[rows], outside[rows])
            inside[rows[wider]], outside[rows[wider]] = near[wider], far[wider]


def _ways(arm: Reach, rows: NDArray) -> FloatArray:
    """Joint values of usable candidates, the furthest from limits to the nearest, (len(rows), WAYS, n_joint)."""
    usable = arm.usable[rows]
    margin = np.where(usable, limit_margin(arm.kinematics, arm.candidates.joints[rows]), -np.inf)
    order = np.argsort(-margin, axis=1, kind="stable")
    count = usable.sum(axis=1)
    rank = (np.linspace(0.0, 1.0, WAYS) * (count[:, None] - 1)).astype(np.int64)
    chosen = np.take_along_axis(order, rank, axis=1)
    return arm.candidates.joints[rows[:, None], chosen]


def _distances(
    left: Reach, right: Reach, left_joints: FloatArray, right_joints: FloatArray, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    sides = [
        (arm.kinematics, arm.kinematics.at(joints)) for arm, joints in ((left, left_joints), (right, right_joints))
    ]
    return arm_distances(sides[0], sides[1], points)
