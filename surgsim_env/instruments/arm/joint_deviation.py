"""Deviation of an arm's joints from their encoders: cables stretch, and encoders sit at the motors."""

from __future__ import annotations

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.scene.arm_description import JointErrors


class JointDeviation:
    """Joint values q of an arm with errors: q = held + offset + drift t; held follows the encoder e with a play.

    The play operator (Visintin 1994, Differential Models of Hysteresis, III.2) clips held to e +- play; the time t
    counts from the last placement. Between two commands q and e advance at constant speeds. Without errors q = e, to
    the bit.
    """

    def __init__(self, errors: JointErrors | None) -> None:
        """Take the errors of a description; None: exact joints."""
        self.errors = errors
        count = 0 if errors is None else len(errors.play)
        # Encoders at the last command, their speed, and its time [s].
        self.offset, self.drift, self._encoders, self._speed, self._began = np.zeros((5, count))

    def draw(self, rng: np.random.Generator) -> None:
        """Draw the episode's offset and drift of each joint, uniform up to the largest of either sign."""
        if self.errors is not None:
            self.offset, self.drift = (
                rng.uniform(-np.array(most), most) for most in (self.errors.offset, self.errors.drift)
            )

    def begin(self, joints: FloatArray, time: float) -> None:
        """Rest at joint values (n,), in the middle of their play."""
        if self.errors is not None:
            self._encoders, self._speed = joints - self.offset - self.drift * time, np.zeros_like(joints)
            self._began = np.full_like(joints, time)

    def encoders(self, joints: FloatArray, time: float) -> FloatArray:
        """Values of the encoders at the targets of the joints (n,)."""
        return joints if self.errors is None else self._encoders + self._speed * (time - self._began)

    def follow(self, joints: FloatArray, encoders: FloatArray, duration: float, time: float) -> FloatArray:
        """Targets of the joints (n,), from those now, for encoders that move to values (n,) within a duration [s]."""
        if self.errors is None:
            return encoders
        now, play = self.encoders(joints, time), np.array(self.errors.play)
        held = np.clip(joints - self.offset - self.drift * time, encoders - play, encoders + play)
        self._encoders, self._speed, self._began = now, (encoders - now) / duration, np.full_like(now, time)
        return held + self.offset + self.drift * (time + duration)

    def get_state(self) -> FloatArray:
        """Its state as a vector; empty without errors."""
        return np.concatenate([self.offset, self.drift, self._encoders, self._speed, self._began])

    def set_state(self, state: FloatArray) -> None:
        """Restore a state from `get_state`, to the bit."""
        self.offset, self.drift, self._encoders, self._speed, self._began = np.split(state.copy(), 5)
