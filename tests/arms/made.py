"""An evaluation of two arms made up for tests: an ellipsoid with points on it and in it, every figure drawn."""

import math

import numpy as np

from surgsim_apps.arms.results import ArmReach, ArmsEvaluation, ArmThroughCycle, ArmWithErrors, ThroughCycle
from surgsim_apps.reports.surface_drawing import tube
from surgsim_env.scene.model import Port

HALF_AXES = np.array([0.09, 0.06, 0.04])
PORTS = {
    "left": Port((0.08, -0.09, 0.09), (-0.55, 0.6, -0.6)),
    "right": Port((-0.08, -0.09, 0.09), (0.55, 0.6, -0.6)),
    "endoscope": Port((0.0, -0.12, 0.11), (0.0, 0.74, -0.67)),
}


def made_reach(name, points, reachable, generator, *, joint_count=6, force=(2.0, 9.0), clearance=(0.004, 0.05)):
    count = len(points)

    def drawn(low, high):
        smooth = 0.5 + 0.5 * np.sin(points @ generator.normal(size=3) * 25.0)
        return np.where(reachable, low + (high - low) * smooth, np.nan)

    reason = np.where(reachable, 0, 1 + (generator.random(count) ** 2 * 5).astype(np.int32)).astype(np.int32)
    joints = np.where(reachable[:, None], generator.uniform(-1.0, 1.0, (count, joint_count)), np.nan)
    return ArmReach(
        name=name,
        reason=reason,
        joints=joints,
        position_error=drawn(0.0, 2e-5),
        approach_share=drawn(0.05, 0.9),
        manipulability=drawn(1e-4, 3e-3),
        isotropy=drawn(0.02, 0.4),
        limit_margin=drawn(0.01, 0.95),
        tip_force=drawn(*force),
        trocar_load=drawn(0.1, 0.8),
        camera_angle=drawn(math.radians(15), math.radians(80)),
        organ_clearance=drawn(*clearance),
        wall_clearance=drawn(clearance[0] + 0.004, clearance[1] + 0.004),
        trocar_error=drawn(0.0, 1e-6),
    )


def made_evaluation(*, count=120, inner_count=10, seed=0, left_to=0.3, right_to=0.3, joint_counts=(6, 6), **reach):
    """Two arms, the left one reaching what lies at x > -left_to of the half axis, the right one at x < right_to."""
    generator = np.random.default_rng(seed)
    sphere, triangles = tube(np.zeros(3), np.zeros(3), 1.0)
    directions = generator.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    normals = directions / HALF_AXES
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    points = directions * HALF_AXES
    points[count - inner_count :] *= 0.4
    inner = np.arange(count) >= count - inner_count
    front = points @ np.array([0.0, -0.74, 0.67]) > -0.015
    left = front & (points[:, 0] > -left_to * HALF_AXES[0])
    right = front & (points[:, 0] < right_to * HALF_AXES[0])
    arms = [
        made_reach(name, points, reachable, generator, joint_count=joints, **reach)
        for name, reachable, joints in zip(("psm_grasper", "psm_palpator"), (left, right), joint_counts, strict=True)
    ]
    together = left & right
    both = together & (generator.random(count) > 0.1)
    inside = np.where(together, np.where(both, 0.012, 0.002), np.nan)
    outside = np.where(together, 0.08 + points[:, 0], np.nan)
    return ArmsEvaluation(
        points=points,
        normals=normals,
        inner=inner,
        left=arms[0],
        right=arms[1],
        both=both,
        arm_distance_inside=inside,
        arm_distance_outside=outside,
        scene="ellipsoid",
        surface_points=sphere * HALF_AXES,
        surface_triangles=triangles,
        ports=PORTS,
        with_errors={"left": ArmWithErrors(np.full((2, 3), 0.003), np.full((2, 3), 0.001), 0.9)},
    )


def made_follower(generator, reachable):
    """An arm at three positions: it loses a tenth of its points at the top, and has a path for the others."""
    count = len(reachable)
    each = np.stack([reachable, reachable, reachable & (generator.random(count) > 0.1)])
    path = np.asarray(each.all(axis=0))
    return ArmThroughCycle(
        reachable=each,
        joints=np.where(path[:, None], generator.uniform(-1.0, 1.0, (3, count, 3)), np.nan),
        clearance=np.where(path, generator.uniform(0.001, 0.01, (3, count)), np.nan),
    )


def made_cycle(evaluation, *, seed=0):
    """A breath at rest, half way and at the top, for the points of an evaluation."""
    generator = np.random.default_rng(seed)
    left, right = (made_follower(generator, arm.reachable) for arm in (evaluation.left, evaluation.right))
    return ThroughCycle(
        motions=("breathing",),
        travel=np.array([0.0096]),
        period=np.array([4.0]),
        left=left,
        right=right,
        both=evaluation.both & left.reachable & right.reachable,
    )
