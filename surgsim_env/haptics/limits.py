"""The most that a coupling may push, and how fast its push may change; each says when it acts."""

import math
from dataclasses import dataclass

import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.haptics.device import require_positive


@dataclass(frozen=True)
class ForceLimits:
    """Limits of a force.

    Args:
        force_largest: of the coupling [N], on the tip and so on the device too. Chosen below the 3.3 N of small desktop
            devices.
        slew_largest: how fast the device's force may change [N/s]. Chosen: a coupling of 800 N/m moved at 0.6 m/s.

    Raises:
        ValueError: names the entry, its value and the rule.
    """

    force_largest: float = 3.0
    slew_largest: float = 500.0

    def __post_init__(self) -> None:
        require_positive("limits.force_largest", self.force_largest, "N")
        require_positive("limits.slew_largest", self.slew_largest, "N/s")


def held_within(vector: FloatArray, largest: float) -> tuple[FloatArray, bool]:
    """A vector shortened to a length, its direction kept, and whether that was needed."""
    x, y, z = vector.tolist()
    size = math.sqrt(x * x + y * y + z * z)
    if size <= largest:
        return vector, False
    return vector * (largest / size), True


class SlewLimit:
    """The force that a device has got so far, and how far the next may be from it."""

    def __init__(self, slew_largest: float, haptic_step: float) -> None:
        """Start at zero force; `slew_largest` [N/s] for steps of `haptic_step` [s]."""
        self._most = slew_largest * haptic_step
        self._force = np.zeros(3)

    def follow(self, force: FloatArray) -> tuple[FloatArray, bool]:
        """The force to give next [N], (3,), and whether it is held back from what was asked for."""
        change, held = held_within(force - self._force, self._most)
        self._force = self._force + change if held else force
        return self._force, held

    def reset(self) -> None:
        """Zero force, at once."""
        self._force = np.zeros(3)
