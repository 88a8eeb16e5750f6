"""What a haptic loop may be told: the coupling, its limits, its watchdog, where the device's frame lies."""

import math
from dataclasses import dataclass, field

from surgsim_env.haptics.coupling import VirtualCoupling
from surgsim_env.haptics.device import require_positive
from surgsim_env.haptics.frame import DeviceFrame
from surgsim_env.haptics.limits import ForceLimits
from surgsim_env.haptics.watchdog import WatchdogTimes


@dataclass(frozen=True)
class HapticSettings:
    """How one device is coupled to one tip.

    Args:
        coupling: None: what `coupling_for` chooses for the device.
        limits: of force and of its change.
        watchdog: how long a device may be silent.
        frame: where the device's frame lies in the scene.
        relative: whether the device's first pose after a reset means where the tip is, whatever frame.origin says.
        smoothing: time constant of the device's way [s]; None: 0 for a device that pushes, where it counts as lag, and
            20 ms for one that does not, whose poses may come thirty times a second.
        approach_speed: of the tip towards a device that it is not with yet [m/s].
        speed_largest: at which the tip is told to follow [m/s]; chosen above what a hand does with care.
        jaw_button: bit of `DevicePose.buttons` that closes a jaw while it is pressed; None: none does.

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
