"""Whole numbers of steps: a control step is a whole number of haptic steps, a haptic step of organ substeps."""

import math

# How close to the largest stable step a scene may go: the step is that of the organ at rest, a pressed one is stiffer.
STABLE_STEP_SHARE = 0.9


def whole_steps(duration: float, step: float, *, what: str) -> int:
    """How many steps make a duration [s]; ValueError with both numbers where it is not a whole number."""
    count = round(duration / step)
    if count < 1 or abs(duration - count * step) > 1e-9 * duration:
        raise ValueError(f"{what}: {duration} s is not a whole number of {step} s steps; choose a multiple")
    return count


def substeps_needed(haptic_step: float, stable_step: float) -> int:
    """Fewest organ substeps of a haptic step that keep each below STABLE_STEP_SHARE of the stable step."""
    return math.ceil(haptic_step / (STABLE_STEP_SHARE * stable_step))
