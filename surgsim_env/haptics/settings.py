"""Configuration of a haptic loop: coupling, frame, force limits, watchdog."""

from dataclasses import dataclass, field

import numpy as np

from surgsim_env.haptics.coupling import VirtualCoupling
from surgsim_env.haptics.device import require_positive

# The bit of a device's second button, which holds the breath in `surgsim haptics` and `surgsim view`.
BREATH_BIT = 1
IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class DeviceFrame:
    """x = origin + scale R x_device, and F_device = scale R^T F: power is the same on both sides.

    Args:
        origin: of the device's frame in the scene [m].
        rotation: R, three rows.
        scale: scene metres per device metre.

    Raises:
        ValueError: names the entry, its value and the rule.
    """

    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[tuple[float, float, float], ...] = IDENTITY
    scale: float = 1.0

    def __post_init__(self) -> None:
        require_positive("frame.scale", self.scale, "")
        origin, turn = np.asarray(self.origin, dtype=np.float64), np.asarray(self.rotation, dtype=np.float64)
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise ValueError(f"frame.origin is {self.origin!r}; it must be three finite numbers in metres")
        if turn.shape != (3, 3) or not np.isfinite(turn).all() or np.abs(turn @ turn.T - np.eye(3)).max() > 1e-6:
            raise ValueError(f"frame.rotation is {self.rotation!r}; its rows must be three perpendicular unit vectors")
        if np.linalg.det(turn) < 0.0:
            raise ValueError(f"frame.rotation is {self.rotation!r}; this is a reflection: reverse one axis")


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


@dataclass(frozen=True)
class WatchdogTimes:
    """Times of the watchdog.

    Args:
        timeout: time without a fresh pose after which the force fades [s].
        fade: time from full force to none, linearly [s].
        resume: time from none to full force when poses return, linearly [s].

    Raises:
        ValueError: names the entry, its value and the rule.
    """

    timeout: float = 0.05
    fade: float = 0.1
    resume: float = 0.5

    def __post_init__(self) -> None:
        for name in ("timeout", "fade", "resume"):
            require_positive(f"watchdog.{name}", getattr(self, name), "s")


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
        breath_button: bit that holds the breath of a patient who breathes while it is pressed; None: none, and the
            breath stays as `Simulation.hold_breath` has it.

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
    breath_button: int | None = None

    def __post_init__(self) -> None:
        require_positive("haptic smoothing", self.smoothing or 0.0, "s", or_zero=True)
        require_positive("haptic approach_speed", self.approach_speed, "m/s")
        require_positive("haptic speed_largest", self.speed_largest, "m/s")
        for name in ("jaw_button", "breath_button"):
            bit = getattr(self, name)
            if bit is not None and bit not in range(32):
                raise ValueError(f"haptic {name} is {bit!r}; it must be a bit from 0 to 31, or None")
        if self.jaw_button is not None and self.jaw_button == self.breath_button:
            raise ValueError(f"haptic jaw_button and breath_button are both {self.jaw_button}; set one to another bit")
