"""The interface of a haptic device: a pose in, a force out, and the dynamics for the coupling's stiffness limit."""

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from msdm_core.mesh import FloatArray


class DevicePose(NamedTuple):
    """Pose of a device's handle.

    Fields:
        position: along the scene's axes [m], shape (3,)
        time: of reading, on a monotonic clock [s]
        buttons: one bit each, the first is 1
    """

    position: FloatArray
    time: float
    buttons: int = 0


@dataclass(frozen=True)
class DeviceDynamics:
    """Dynamics of a device with force feedback, at its handle.

    Args:
        damping: viscous damping b of the device itself, without a hand [N s/m]; more of it allows a stiffer coupling.
        mass: apparent mass m at the handle [kg].
        delay: of pose and force together beyond the haptic step for which a force is held [s]: transport, filters, and
            the interval of poses beyond a haptic step.
        force_largest: its largest force [N].

    Raises:
        ValueError: names the entry, its value and the rule.
    """

    damping: float
    mass: float
    delay: float = 0.0
    force_largest: float = math.inf

    def __post_init__(self) -> None:
        require_positive("device damping", self.damping, "N s/m")
        require_positive("device mass", self.mass, "kg")
        require_positive("device force_largest", self.force_largest, "N", finite=False)
        require_positive("device delay", self.delay, "s", or_zero=True)


class HapticDevice(Protocol):
    """A device of a `HapticLoop`: read and written once per haptic step, without blocking."""

    @property
    def dynamics(self) -> DeviceDynamics | None:
        """Its dynamics; None if it displays forces but exerts none."""
        ...

    def read(self) -> DevicePose | None:
        """The newest pose not read before; None if there is none.

        A device at rest still gives poses: one that gives none for 50 ms counts as lost, and its force fades.
        """
        ...

    def write(self, force: FloatArray) -> None:
        """Push the hand with a force along the scene's axes [N], shape (3,), until the next one."""
        ...


def require_positive(name: str, value: float, unit: str, *, finite: bool = True, or_zero: bool = False) -> None:
    """Refuse a number not above zero, or with `or_zero` below zero.

    Raises:
        ValueError: names the number, its value and the rule.
    """
    if not (value > 0.0 or (or_zero and value == 0.0)) or (finite and not math.isfinite(value)):
        rule = f"{'finite and ' if finite else ''}{'not negative' if or_zero else 'above 0'}"
        raise ValueError(f"{name} is {value!r} {unit}; it must be {rule}")
