"""How many organ substeps a haptic step needs."""

import math

# How close to the largest stable step a scene may go: the step is that of the organ at rest, a pressed one is stiffer.
STABLE_STEP_SHARE = 0.9


def substeps_needed(haptic_step: float, stable_step: float) -> int:
    """Fewest organ substeps of a haptic step that keep each below STABLE_STEP_SHARE of the stable step."""
    return math.ceil(haptic_step / (STABLE_STEP_SHARE * stable_step))
