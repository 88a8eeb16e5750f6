"""Joint values spread over an arm's limits."""

import numpy as np


def random_joints(arm, count, seed=0, margin=0.0):
    """Joint values (count, n) within the limits, a margin (share of the range) away from them."""
    share = np.random.default_rng(seed).uniform(margin, 1.0 - margin, (count, arm.joint_count))
    return arm.lower + share * (arm.upper - arm.lower)
