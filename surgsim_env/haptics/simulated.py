"""A device of given inertia and damping in a simulated hand, to try couplings on without one."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from msdm_core.mesh import FloatArray
from surgsim_env.haptics.device import DeviceDynamics, DevicePose, require_positive

HandPath = Callable[[float], FloatArray]


@dataclass(frozen=True)
class Hand:
    """What holds a device: a spring and a damper to where the hand wants it, and a push.

    Args:
        stiffness: of the grip [N/m]; 0 for a hand that only pushes.
        damping: of the grip, to where the hand wants it [N s/m].
        push: [N].

    Raises:
        ValueError: names the entry, its value and the rule.
    """

    stiffness: float = 0.0
    damping: float = 0.0
    push: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("stiffness", "damping"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"hand {name} is {value!r}; it must be finite and not negative")


class SimulatedDevice:
    """m dv/dt = F + push - b v - k_h (x - x_h) - b_h (v - dx_h/dt), solved exactly for a force held through a step.

    `advance` moves it on by one haptic step. Poses may come late, forces act late, positions be those of an encoder.
    """

    def __init__(
        self,
        *,
        mass: float,
        damping: float,
        haptic_step: float,
        position: FloatArray,
        hand: Hand | None = None,
        path: HandPath | None = None,
        encoder: float = 0.0,
        pose_delay: int = 0,
        force_delay: int = 0,
    ) -> None:
        """Hold a device still at a place.

        Args:
            mass: m [kg].
            damping: b [N s/m].
            haptic_step: between two forces [s].
            position: where it is held at the start [m], (3,).
            hand: None: nobody holds it.
            path: where the hand wants it at a time [m]; where it started by default.
            encoder: what its positions are rounded to [m]; 0 for exact ones.
            pose_delay: haptic steps after which a pose is read.
            force_delay: haptic steps after which a force acts.

        Raises:
            ValueError: names the entry, its value and the rule.
        """
        self.hand = hand or Hand()
        require_positive("haptic_step", haptic_step, "s")
        if min(pose_delay, force_delay) < 0 or not encoder >= 0.0:
            raise ValueError(
                f"pose_delay {pose_delay!r}, force_delay {force_delay!r} and encoder {encoder!r} must not be negative"
            )
        start = np.array(position, dtype=np.float64)
        self._dynamics = DeviceDynamics(damping, mass, delay=(pose_delay + force_delay) * haptic_step)
        self._path: HandPath = path or (lambda time: start)
        self._haptic_step, self._encoder = haptic_step, encoder
        self.position, self.velocity = start.copy(), np.zeros(3)
        self.time = 0.0
        self.linked = True
        # The work of the forces on the handle since the start [J]: below zero while the loop takes energy.
        self.work = 0.0
        self._wanted = self._path(0.0).copy()
        self._poses = deque([self.position.copy()] * (pose_delay + 1), maxlen=pose_delay + 1)
        self._forces = deque([np.zeros(3)] * (force_delay + 1), maxlen=force_delay + 1)
        self._free, self._driven, self._led = self._discretised()

    @property
    def dynamics(self) -> DeviceDynamics:
        """What it is made of."""
        return self._dynamics

    @property
    def force(self) -> FloatArray:
        """What acts on the handle through the next `advance` [N], (3,)."""
        return self._forces[0]

    def read(self) -> DevicePose | None:
        """The pose that has arrived; None while the link is cut (`linked` False)."""
        if not self.linked:
            return None
        place = self._poses[0]
        if self._encoder > 0.0:
            place = np.round(place / self._encoder) * self._encoder
        return DevicePose(place.copy(), self.time)

    def write(self, force: FloatArray) -> None:
        """Let a force act, [N], (3,), from now or after its delay."""
        self._forces.append(np.array(force, dtype=np.float64))

    def advance(self) -> None:
        """Move on by one haptic step under the force that acts, in the hand."""
        self.time += self._haptic_step
        wanted = self._path(self.time)
        before, force = self.position, self._forces[0]
        led = np.stack([self._wanted, (wanted - self._wanted) / self._haptic_step])
        state = self._free @ np.stack([self.position, self.velocity])
        state += np.outer(self._driven, force + np.asarray(self.hand.push)) + self._led @ led
        self.position, self.velocity, self._wanted = state[0], state[1], wanted.copy()
        self.work += float(force @ (self.position - before))
        self._poses.append(self.position.copy())

    def energy(self) -> float:
        """Of motion and of the grip's spring [J]."""
        across = self.position - self._wanted
        kinetic = 0.5 * self._dynamics.mass * float(self.velocity @ self.velocity)
        return kinetic + 0.5 * self.hand.stiffness * float(across @ across)

    def _discretised(self) -> tuple[FloatArray, ...]:
        """What a step makes of (x, v), of a force held, of the hand's place and its steady speed."""
        m, b, k, c = self._dynamics.mass, self._dynamics.damping, self.hand.stiffness, self.hand.damping
        # d/dt (x, v, F, x_h, u_h): the hand's place goes on at its speed u_h, the force stays.
        rate = np.zeros((5, 5))
        rate[0, 1] = rate[3, 4] = 1.0
        rate[1] = np.array([-k, -(b + c), 1.0, k, c]) / m
        step = np.asarray(expm(rate * self._haptic_step), dtype=np.float64)
        return step[:2, :2], step[:2, 2], step[:2, 3:]
