"""Reach and presses of an arm whose joints have the errors of its file."""

import numpy as np

from surgsim_apps.arms.clearance import Obstacles
from surgsim_apps.arms.kinematics import dot
from surgsim_apps.arms.reach import Reach, Sites
from surgsim_apps.arms.results import ArmWithErrors

# Draws of the joints' offsets.
DRAWS = 16


def evaluate_errors(reach: Reach, sites: Sites, around: Obstacles, seed: int) -> ArmWithErrors | None:
    """Deviations of the tip at the reported joints and clearance there; None for an arm that states no errors.

    Offsets are drawn once for all points, a place within the play at each point, both uniform; drift is left out.
    """
    kinematics, rows = reach.kinematics, np.flatnonzero(reach.report.reachable)
    errors = kinematics.arm.description.joint_errors
    if errors is None or not rows.size:
        return None
    joints, rng = reach.report.joints[rows], np.random.default_rng(seed)
    count = joints.shape[1]
    offset = errors.offset * rng.uniform(-1.0, 1.0, (DRAWS, 1, count))
    play = errors.play * rng.uniform(-1.0, 1.0, (DRAWS, *joints.shape))
    chain = kinematics.at((joints + offset + play).reshape(-1, count))
    shift = chain.tip.reshape(DRAWS, -1, 3) - kinematics.at(joints, shapes=False).tip
    clear = around.clears_organ(kinematics, chain) | np.tile(sites.inner[rows], DRAWS)
    clear &= (around.wall_clearance(kinematics, chain) >= 0.0) & around.clears_others(kinematics, chain.shape_ends)
    return ArmWithErrors(
        tip_error=np.linalg.norm(shift, axis=2),
        depth_error=np.abs(dot(shift, sites.normals[rows])),
        kept=float(clear.mean()),
    )
