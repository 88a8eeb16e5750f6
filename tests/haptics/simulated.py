"""A simulated device of given inertia and damping in a simulated hand, for tests of couplings."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_apps.haptics.device import DeviceDynamics, DevicePose, require_positive

HandPath = Callable[[float], FloatArray]


@dataclass(frozen=True)
class Hand:
    """A hand that holds a device: a spring and a damper to its target, and a constant force.

    Args:
        stiffness: of the grip [N/m]; 0 for a hand that only pushes.
        damping: of the grip [N s/m].
        push: constant force [N].

    Raises:
        ValueError: names the entry, its value and the rule.
    """

    stiffness: float = 0.0
    damping: float = 0.0
    push: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        require_positive("hand stiffness", self.stiffness, "N/m", or_zero=True)
        require_positive("hand damping", self.damping, "N s/m", or_zero=True)


class SimulatedDevice:
    """Simulates m dv/dt = F + push - b v - k_h (x - x_h) - b_h (v - dx_h/dt), exactly for a force constant in a step.

    `advance` advances it by one haptic step. Poses and forces may be delayed, and positions rounded by an encoder.
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
        """Start at rest.

        Args:
            mass: m [kg].
            damping: b [N s/m].
            haptic_step: [s].
            position: initial position [m], (3,).
            hand: None: nobody holds it.
            path: target of the hand [m], (3,), over time [s]; by default the initial position.
            encoder: resolution of the positions [m]; 0 for exact ones.
            pose_delay: of the poses, in haptic steps.
            force_delay: of the forces, in haptic steps.

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
        # Work of the forces on the handle since the start [J]: negative while the loop dissipates.
        self.work = 0.0
        self._wanted = self._path(0.0).copy()
        self._poses = deque([self.position.copy()] * (pose_delay + 1), maxlen=pose_delay + 1)
        self._forces = deque([np.zeros(3)] * (force_delay + 1), maxlen=force_delay + 1)
        self._free, self._driven, self._led = self._discretised()

    @property
    def dynamics(self) -> DeviceDynamics:
        """Its dynamics."""
        return self._dynamics

    @property
    def force(self) -> FloatArray:
        """The force on the handle during the next `advance` [N], (3,)."""
        return self._forces[0]

    def read(self) -> DevicePose | None:
        """The pose after its delay; None while the link is lost (`linked` False)."""
        if not self.linked:
            return None
        place = self._poses[0]
        if self._encoder > 0.0:
            place = np.round(place / self._encoder) * self._encoder
        return DevicePose(place.copy(), self.time)

    def write(self, force: FloatArray) -> None:
        """Apply a force [N], (3,), after its delay."""
        self._forces.append(np.array(force, dtype=np.float64))

    def advance(self) -> None:
        """Advance by one haptic step."""
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
        """Kinetic energy plus that of the grip's spring [J]."""
        across = self.position - self._wanted
        kinetic = 0.5 * self._dynamics.mass * float(self.velocity @ self.velocity)
        return kinetic + 0.5 * self.hand.stiffness * float(across @ across)

    def _discretised(self) -> tuple[FloatArray, ...]:
        """Matrices of one step: for (x, v), for a constant force, for the hand's target and its constant speed."""
        m, b, k, c = self._dynamics.mass, self._dynamics.damping, self.hand.stiffness, self.hand.damping
        # d/dt (x, v, F, x_h, u_h): the hand's target moves at its speed u_h, the force is constant.
        rate = np.zeros((5, 5))
        rate[0, 1] = rate[3, 4] = 1.0
        rate[1] = np.array([-k, -(b + c), 1.0, k, c]) / m
        step = np.asarray(expm(rate * self._haptic_step), dtype=np.float64)
        return step[:2, :2], step[:2, 2], step[:2, 3:]
