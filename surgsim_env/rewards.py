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


def weighted(terms: Mapping[str, float], weights: Mapping[str, float]) -> dict[str, float]:
    """Each term times its weight, in the table's order; a term that the table lacks is our own mistake."""
    assert set(terms) == set(weights), sorted(set(terms) ^ set(weights))
    # Adding 0.0 turns a product of -0.0 into 0.0.
    return {name: weights[name] * float(terms[name]) + 0.0 for name in weights}
