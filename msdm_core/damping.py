"""Rayleigh damping D = alpha M + beta K (Sala et al. 2011, section II-C)."""

import math
from dataclasses import dataclass

from msdm_core.errors import OrganError


@dataclass(frozen=True)
class Damping:
    """Rayleigh damping: a mode of angular frequency w decays with the ratio alpha / (2 w) + beta w / 2.

    Args:
        alpha: mass-proportional rate [1/s], at least 0; it drags against the fixed world.
        beta: stiffness-proportional time [s], at least 0; it acts along each spring and on each tet's volume.
    """

    alpha: float
    beta: float = 0.0

    def __post_init__(self) -> None:
        for name, unit in (("alpha", "1/s"), ("beta", "s")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise OrganError(f"damping: {name} is {value} {unit}; it must be finite and at least 0")

    def ratio(self, frequency: float) -> float:
        """Damping ratio zeta = alpha / (2 w) + beta w / 2 of a mode of the given frequency [Hz], w = 2 pi f."""
        omega = 2.0 * math.pi * frequency
        return self.alpha / (2.0 * omega) + self.beta * omega / 2.0

    def compressed(self, frequency: float) -> "Damping":
        """The paper's form, all in one inertial term: alpha' = alpha + beta w^2 damps that mode [Hz] alike."""
        return Damping(alpha=self.alpha + self.beta * (2.0 * math.pi * frequency) ** 2)
