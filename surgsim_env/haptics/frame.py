"""The device's frame in the scene, and a target that follows the device with limited speed."""

import math
from dataclasses import dataclass

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.haptics.device import require_positive

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


class Follower:
    """The target of a coupling: it follows the device with limited speed.

    It starts at the tip and moves to the device at the approach speed; from then on it follows at up to the largest
    speed. A distant device at the start, a restored link or a jump of the pose therefore cannot throw the tip into an
    organ.
    """

    def __init__(
        self, place: FloatArray, approach_speed: float, speed_largest: float, smoothing: float, haptic_step: float
    ) -> None:
        """Wait at a position [m], (3,); speeds [m/s], time constant of the smoothing [s], `haptic_step` [s]."""
        self.place = place.copy()
        self.approaching = True
        self.limited = False
        self._share = haptic_step / (haptic_step + smoothing)
        self._approach, self._largest = approach_speed * haptic_step, speed_largest * haptic_step

    def follow(self, target: FloatArray) -> None:
        """Move towards the device's position [m], (3,); `limited` tells whether the speed limit acted."""
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
        """Stay, and approach the device again at the next pose."""
        self.approaching, self.limited = True, False

    def restart(self, place: FloatArray) -> None:
        """Wait at another position [m], (3,)."""
        self.place = place.copy()
        self.wait()
