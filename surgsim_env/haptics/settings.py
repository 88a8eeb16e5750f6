"""Configuration of a haptic loop: coupling, frame, force limits, watchdog."""

import math
from dataclasses import dataclass, field

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.haptics.coupling import VirtualCoupling
from surgsim_env.haptics.device import require_positive
from surgsim_env.haptics.frame import DeviceFrame
from surgsim_env.haptics.watchdog import WatchdogTimes


@dataclass(frozen=True)
class ForceLimits:
    """Limits of a force.

    Args:
        force_largest: of the coupling [N], on tip and device. Chosen below the 3.3 N of small desktop devices.
        slew_largest: of the device's force [N/s]. Chosen: a coupling of 800 N/m moved at 0.6 m/s.

    Raises:
        ValueError: names the entry, its value and the rule.
    """

    force_largest: float = 3.0
    slew_largest: float = 500.0

    def __post_init__(self) -> None:
        require_positive("limits.force_largest", self.force_largest, "N")
        require_positive("limits.slew_largest", self.slew_largest, "N/s")


def held_within(vector: FloatArray, largest: float) -> tuple[FloatArray, bool]:
    """The vector limited to a length, in the same direction, and whether it was longer."""
    x, y, z = vector.tolist()
    size = math.sqrt(x * x + y * y + z * z)
    if size <= largest:
        return vector, False
    return vector * (largest / size), True


class SlewLimit:
    """Limits the change of a device's force from step to step."""

    def __init__(self, slew_largest: float, haptic_step: float) -> None:
        """Start at zero force; `slew_largest` [N/s] for steps of `haptic_step` [s]."""
        self._most = slew_largest * haptic_step
        self._force = np.zeros(3)

    def follow(self, force: FloatArray) -> tuple[FloatArray, bool]:
        """The next force [N], (3,), and whether the limit changed it."""
        change, held = held_within(force - self._force, self._most)
        self._force = self._force + change if held else force
        return self._force, held

    def reset(self) -> None:
        """Set the force to zero at once."""
        self._force = np.zeros(3)


@dataclass(frozen=True)
class HapticSettings:
    """Configuration of the coupling of one device to one tip.

    Args:
        coupling: None: the one that `coupling_for` computes for the device.
        limits: of force and of its change.
        watchdog: times of the force's fading when poses are missing.
        frame: position, rotation and scale of the device's frame in the scene.
        relative: whether the device's first pose after a reset corresponds to the tip's position, regardless of
            frame.origin.
        smoothing: time constant of a filter on the poses [s]; None: 0 for a device that exerts forces, where it counts
            as lag, and 20 ms for one that does not, whose poses may arrive only 30 times a second.
        approach_speed: speed of the tip on its way to a distant device [m/s].
        speed_largest: speed limit of the tip [m/s]; chosen above careful hand motions.
        jaw_button: bit of `DevicePose.buttons` that closes a jaw while it is pressed; None: none.

    Raises:
        ValueError: names the entry, its value and the rule.
    """

    coupling: VirtualCoupling | None = None
    limits: ForceLimits = field(default_factory=ForceLimits)
    watchdog: WatchdogTimes = field(default_factory=WatchdogTimes)
    frame: DeviceFrame = field(default_factory=DeviceFrame)
    relative: bool = False
    smoothing: float | None = None
    approach_speed: float = 0.05
    speed_largest: float = 1.0
    jaw_button: int | None = 0

    def __post_init__(self) -> None:
        if self.smoothing is not None and not (math.isfinite(self.smoothing) and self.smoothing >= 0.0):
            raise ValueError(f"haptic smoothing is {self.smoothing!r} s; it must be finite and not negative")
        require_positive("haptic approach_speed", self.approach_speed, "m/s")
        require_positive("haptic speed_largest", self.speed_largest, "m/s")
        if self.jaw_button is not None and self.jaw_button not in range(32):
            raise ValueError(f"haptic jaw_button is {self.jaw_button!r}; it must be a bit from 0 to 31, or None")
