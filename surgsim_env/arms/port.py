"""Ports: where an instrument passes through the body wall."""

import math
from dataclasses import dataclass

import numpy as np

from msdm_core.mesh import FloatArray


@dataclass(frozen=True)
class Port:
    """The frame of a port: its origin is the trocar, its -z points into the body.

    Args:
        point: the trocar [m], world frame.
        into: direction into the body, any length.
        roll: turn of the frame about its z axis [rad]; 0 has x as near to world x (else y) as can be.
    """

    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    into: tuple[float, float, float] = (0.0, 0.0, -1.0)
    roll: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite([*self.point, *self.into, self.roll]).all() or not math.hypot(*self.into) > 0.0:
            raise ValueError(
                f"port at {self.point} into {self.into}, roll {self.roll}: every number must be finite, and `into` a "
                "direction such as [0, 0, -1]"
            )

    @property
    def rotation(self) -> FloatArray:
        """Axes of the port's frame as columns, world frame, (3, 3)."""
        return frame_into(np.array(self.into), self.roll)


def frame_into(into: FloatArray, roll: float = 0.0) -> FloatArray:
    """A right-handed frame whose -z is a direction, its x near world x (else y), turned by roll [rad]; (3, 3)."""
    z = -into / np.linalg.norm(into)
    near = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = near - (near @ z) * z
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    c, s = math.cos(roll), math.sin(roll)
    return np.stack([c * x + s * y, c * y - s * x, z], axis=1)
