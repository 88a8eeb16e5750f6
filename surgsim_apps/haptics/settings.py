"""Configuration of a haptic loop: coupling, force limits, watchdog."""

from dataclasses import dataclass

from surgsim_apps.haptics.coupling import VirtualCoupling
from surgsim_apps.haptics.device import require_positive

# Bits of a device's buttons: close a jaw; hold the breath (in `surgsim haptics` and `surgsim view`).
JAW_BIT, BREATH_BIT = 0, 1


@dataclass(frozen=True)
class HapticSettings:
    """Configuration of the coupling of one device to one tip.

    Args:
        coupling: None: that of `coupling_for` for the device.
        force_largest: of the coupling [N], on tip and device; chosen below the 3.3 N of small desktop devices.
        slew_largest: of the device's force [N/s]; chosen: a coupling of 800 N/m moved at 0.6 m/s.
        timeout: time without a fresh pose until the force fades [s].
        fade: time from full force to none, linearly [s].
        resume: time from none to full force when poses return, linearly [s].
        relative: True if the device's first pose after a reset corresponds to the tip's position; otherwise its poses
            are positions in the scene.
        smoothing: time constant of a filter on the poses [s]; None: 0 for a device with force feedback, for which it
            counts as lag, else 20 ms, since poses may arrive only 30 times a second.
        approach_speed: speed of the tip on its way to a distant device [m/s].
        speed_largest: speed limit of the tip [m/s]; chosen above careful hand motions.
        breath_button: bit of `DevicePose.buttons` for holding a patient's breath; None: none, and the breath follows
            `Simulation.hold_breath` alone.

    Raises:
        ValueError: names the entry, its value and the rule.
    """

    coupling: VirtualCoupling | None = None
    force_largest: float = 3.0
    slew_largest: float = 500.0
    timeout: float = 0.05
    fade: float = 0.1
    resume: float = 0.5
    relative: bool = False
    smoothing: float | None = None
    approach_speed: float = 0.05
    speed_largest: float = 1.0
    breath_button: int | None = None

    def __post_init__(self) -> None:
        require_positive("haptic smoothing", self.smoothing or 0.0, "s", or_zero=True)
        for name, unit in (
            *(("force_largest", "N"), ("slew_largest", "N/s"), ("timeout", "s"), ("fade", "s"), ("resume", "s")),
            *(("approach_speed", "m/s"), ("speed_largest", "m/s")),
        ):
            require_positive(f"haptic {name}", getattr(self, name), unit)
