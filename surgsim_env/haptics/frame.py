"""Where a device's frame lies in the scene, and the place that follows a device within its speed."""

import math
from dataclasses import dataclass

import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.haptics.device import require_positive

IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class DeviceFrame:
    """x = origin + scale R x_device, and F_device = scale R^T F: power is the same on both sides.

    Args:
        origin: where the device's zero lies in the scene [m].
        rotation: R, rows of three, a rotation.
        scale: metres of the scene a metre of the device.

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
            raise ValueError(f"frame.rotation is {self.rotation!r}; that is a reflection: turn one axis round")


class Follower:
    """The place in the scene that a coupling pulls towards: the device's, but never faster than a speed.

    It starts where the tip is and comes to the device at the approach speed; once there it may follow at the largest
    speed. So neither a device that is far away at the start, nor one that comes back, nor a pose that jumps throws the
    tip into an organ.
    """

    def __init__(
        self, place: FloatArray, approach_speed: float, speed_largest: float, smoothing: float, haptic_step: float
    ) -> None:
        """Wait at a place [m]; speeds in [m/s], smoothing with a time constant [s], steps of `haptic_step` [s]."""
        self.place = place.copy()
        self.approaching = True
        self.limited = False
        self._share = haptic_step / (haptic_step + smoothing)
        self._approach, self._largest = approach_speed * haptic_step, speed_largest * haptic_step

    def follow(self, target: FloatArray) -> None:
        """Go on towards the device's place [m], (3,); `limited` says whether the speed kept it from getting there."""
        x, y, z = (target - self.place).tolist()
        distance, most = math.hypot(x, y, z), self._approach if self.approaching else self._largest
        wanted = self._share * distance
        self.limited = wanted > most
        if self.limited:
            self.place = self.place + np.array((x, y, z)) * (most / distance)
            return
        self.place = target if self._share == 1.0 else self.place + self._share * (target - self.place)
        self.approaching = False

    def wait(self) -> None:
        """Stay; the next device is approached anew."""
        self.approaching, self.limited = True, False

    def restart(self, place: FloatArray) -> None:
        """Wait at another place [m]."""
        self.place = place.copy()
        self.wait()
