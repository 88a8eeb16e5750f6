"""Reward weights, one table a task; a task computes the named terms, here they are weighted and summed."""

from collections.abc import Mapping

# Weights of SurgSim/Palpate-v0. Every term lies in [0, 1] per control step but `forgone`, which counts steps.
PALPATE_WEIGHTS: Mapping[str, float] = {
    "time": -0.005,  # each control step
    "soft_force": -0.010,  # share of the way from the soft to the hard limit, largest of the step
    "found": 10.0,  # declared within the success distance
    "wrong": -5.0,  # declared elsewhere
    "hard_force": -5.0,  # the hard limit was passed: a safety stop
    "fault": -5.0,  # the simulation could not go on
    "forgone": -0.015,  # each step left when it ends without finding: the dearest step, so that ending pays less
}

# Weights of SurgSim/PalpateSites-v0. `error`, `soft_force` and `forgone` are in [0, 1] per press and count as shares of
# the budget of n presses: 0.04, 0.01 and 0.05 a press for n = 25.
#
# `found` is the CHANGE of a number in [0, 1] and sums to what it ends with less what it begins with (1 where there is
# nothing to find and nothing is claimed, else 0): it cannot be farmed. The worst full episode returns at least
# error + soft_force - f, one that fails after k presses at most (1 - f) found + failure + (n - k) / n forgone, where
# f is what `found` begins with. As forgone = error + soft_force, the first is larger by
#   -f + k / n (error + soft_force) - (1 - f) - failure  >=  -1 - 1.25 + 2.5  =  0.25  at least:
# a failed, faulted or aborted episode never returns more than the worst full one.
PALPATE_SITES_WEIGHTS: Mapping[str, float] = {
    "error": -1.0,  # distance of estimates from the truth (OSPA) after a press, over its cutoff and the budget
    "found": 1.0,  # change of the share of lesions that an estimate is near to
    "soft_force": -0.25,  # share of the way from the soft to the hard limit, largest of the press, over the budget
    "hard_force": -2.5,  # the hard limit was passed: a safety stop
    "fault": -2.5,  # the simulation could not go on
    "forgone": -1.25,  # share of the budget that is left when it ends early
}

# Weights of SurgSim/Retract-v0.
#
# `visible` and `grasped` are CHANGES of numbers in [0, 1]: over an episode they sum to what is reached at its end less
# what it began with (at most 0.1 seen, nothing grasped), however often it is won and lost again: they cannot be farmed.
# The worst full episode of n steps returns at least n (time + soft_force) - 0.1 visible; one that fails after k steps
# at most k time + visible + grasped + failure + (n - k) forgone. As forgone = time + soft_force, the first is larger by
#   -0.1 visible + k soft_force - visible - grasped - failure  >=  -0.4 - 600 x 0.01 - 4 - 1 + 12  =  0.6  at least:
# a failed, faulted or aborted episode never returns more than the worst full one.
RETRACT_WEIGHTS: Mapping[str, float] = {
    "time": -0.005,  # each control step
    "soft_force": -0.010,  # share of the way from the soft to the hard limit, largest of the step
    "visible": 4.0,  # change of the target's visible share
    "grasped": 1.0,  # 1 where tissue comes between the pads, -1 where it is lost
    "success": 10.0,  # seen for long enough
    "torn": -12.0,  # a jaw pulled more than the tissue bears
    "hard_force": -12.0,  # the hard limit was passed: a safety stop
    "fault": -12.0,  # the simulation could not go on
    "forgone": -0.015,  # each step left when it ends without success
}

# Weights of SurgSim/BimanualRetract-v0, by the same reckoning: `near` may begin as high as 1, so that the margin is
#   -0.4 - 1 - 6 - 4 - 1 - 1 - 1 + 15  =  0.6  at least.
BIMANUAL_WEIGHTS: Mapping[str, float] = {
    "time": -0.005,  # each control step
    "soft_force": -0.010,  # share of the way from the soft to the hard limit, largest of the step
    "visible": 4.0,  # change of the share of the target that the organ leaves uncovered
    "grasped": 1.0,  # 1 where tissue comes between the pads, -1 where it is lost
    "near": 1.0,  # change of the right tip's nearness to the target: 1 on it, 0 from 0.1 m on
    "touched": 1.0,  # 1 where the right tip begins to touch the target as it shall, -1 where it ends
    "success": 10.0,  # touched, while exposed, for long enough
    "torn": -15.0,  # a jaw pulled more than the tissue bears
    "hard_force": -15.0,  # the hard limit was passed: a safety stop
    "collided": -15.0,  # the arms pressed each other
    "fault": -15.0,  # the simulation could not go on
    "forgone": -0.015,  # each step left when it ends without success
}


def weighted(terms: Mapping[str, float], weights: Mapping[str, float]) -> dict[str, float]:
    """Each term times its weight, in the table's order; a term that the table lacks is our own mistake."""
    assert set(terms) == set(weights), sorted(set(terms) ^ set(weights))
    # Adding 0.0 turns a product of -0.0 into 0.0.
    return {name: weights[name] * float(terms[name]) + 0.0 for name in weights}
