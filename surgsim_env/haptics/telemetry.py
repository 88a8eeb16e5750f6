"""What a haptic loop tells of each step."""

from typing import NamedTuple

from msdm_core.mesh import FloatArray
from surgsim_env.haptics.device import DevicePose


class TipTelemetry(NamedTuple):
    """One device and the tip that it holds, in one haptic step.

    Fields:
        pose: the device's last good pose; None before the first
        fresh: whether it is of this step
        target: the place in the scene that the coupling pulls towards [m]                    (3,)
        tip: where the tip was at the step's start [m]                                        (3,)
        coupling_force: of the coupling on the tip, in the scene [N]                          (3,)
        force: on the device, in its own frame [N]                                            (3,)
        contact_force: of the tissue on the tip, in the step that just ended [N]              (3,)
        depth: of the tip's ball, or of the point between its pads, below the resting surface where it touches [m]; 0
            without contact
        clamped: the coupling's force is held at its largest
        slewed: the device's force is held back by its largest change
        share: of the force that the watchdog lets through, 0 to 1
        approaching: the tip is on its slow way to the device
        speed_limited: the device is faster than the tip may follow
        workspace_limited: the edge of its workspace holds the tip
        refused_pose_count: poses with a number that is not finite or beyond 100 m, so far
        device_fault: why the device could not be read or written in this step, or ""
        energy: that the device's hand has put in, less what it got back, since the reset [J]
    """

    pose: DevicePose | None
    fresh: bool
    target: FloatArray
    tip: FloatArray
    coupling_force: FloatArray
    force: FloatArray
    contact_force: FloatArray
    depth: float
    clamped: bool
    slewed: bool
    share: float
    approaching: bool
    speed_limited: bool
    workspace_limited: bool
    refused_pose_count: int
    device_fault: str
    energy: float

    @property
    def faded(self) -> bool:
        """Whether the watchdog holds some of the force back."""
        return self.share < 1.0


class HapticTelemetry(NamedTuple):
    """One haptic step.

    Fields:
        time: at its end [s]
        fault: why the simulation stands still, or ""
        tips: one for each device
    """

    time: float
    fault: str
    tips: tuple[TipTelemetry, ...]

    @property
    def tip(self) -> TipTelemetry:
        """The first tip."""
        return self.tips[0]
