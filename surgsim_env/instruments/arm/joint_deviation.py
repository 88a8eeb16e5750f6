"""Deviation of an arm's joints from their encoders: cables stretch, and encoders sit at the motors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.scene.arm_description import JointErrors


class JointDeviation:
    """Joint values of an arm with errors, q = held + offset + drift t; held follows the encoder e with a play.

    The play operator (Visintin 1994, Differential Models of Hysteresis, III.2) clips held to e +- play. Without errors
    q = e, to the bit.

    Fields:
        value: q - e at the last target [rad or m]                        (n,)
    """

    def __init__(self, errors: JointErrors | None, hinges: NDArray[np.bool_]) -> None:
        """Take the errors of a description, and a mask of the hinges among the joints (n,)."""
        self._largest_offset, self._play, self._largest_drift = (errors or JointErrors()).of(hinges)
        self.exact = errors is None
        self._offset, self._drift, self._held, self.value = np.zeros((4, len(hinges)))
        self._time = 0.0

    def draw(self, rng: np.random.Generator) -> None:
        """Draw the episode's offset and drift of each joint, uniform up to the largest of either sign."""
        if not self.exact:
            self._offset = rng.uniform(-self._largest_offset, self._largest_offset)
            self._drift = rng.uniform(-self._largest_drift, self._largest_drift)
            self._time = 0.0

    def begin(self, joints: FloatArray) -> None:
        """Put resting joints (n,) in the middle of their play."""
        self.value = self._offset + self._drift * self._time
        self._held = joints - self.value

    def follow(self, encoders: FloatArray, duration: float) -> FloatArray:
        """Joint values (n,) when the encoders have moved to values (n,) within a duration [s]."""
        if self.exact:
            return encoders
        self._time += duration
        self._held = np.clip(self._held, encoders - self._play, encoders + self._play)
        joints = self._held + self._offset + self._drift * self._time
        self.value = joints - encoders
        return joints

    def get_state(self) -> FloatArray:
        """Its state as a vector; empty without errors."""
        parts = (self._offset, self._drift, self._held, self.value, [self._time])
        return np.zeros(0) if self.exact else np.concatenate(parts)

    def set_state(self, state: FloatArray) -> None:
        """Restore a state from `get_state`, to the bit."""
        if not self.exact:
            self._offset, self._drift, self._held, self.value = state[:-1].reshape(4, -1).copy()
            self._time = float(state[-1])
