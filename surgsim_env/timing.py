"""How many organ substeps a haptic step needs."""

import math

# How close to the largest stable step a scene may go: the step is that of the organ at rest, a pressed one is stiffer.
STABLE_STEP_SHARE = 0.9


def step_needed(haptic_step: float, substep_count: int) -> float:
    """The stable step [s] that so many substeps of a haptic step ask for; `substeps_needed` the other way round."""
    # A hair more, so that rounding does not ask for one substep more.
    return haptic_step / (STABLE_STEP_SHARE * substep_count) * (1.0 + 1e-9)


def substeps_needed(haptic_step: float, stable_step: float) -> int:
    """Fewest organ substeps of a haptic step that keep each below STABLE_STEP_SHARE of the stable step."""
    return math.ceil(haptic_step / (STABLE_STEP_SHARE * stable_step))
