"""Records of a haptic loop's steps."""

from typing import NamedTuple

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.haptics.device import DevicePose


class TipTelemetry(NamedTuple):
    """One device and its tip in one haptic step.

    Fields:
        pose: the device's last valid pose; None before the first
        fresh: whether it was read in this step
        target: the coupling's target in the scene [m]                                        (3,)
        tip: position of the tip at the start of the step [m]                                 (3,)
        coupling_force: of the coupling on the tip, in the scene [N]                          (3,)
        force: on the device, in its own frame [N]                                            (3,)
        contact_force: of the tissue on the tip, in the step that just ended [N]              (3,)
        depth: of the tip's ball, or of the point between its pads, below the resting surface where it touches [m]; 0
            without contact
        clamped: whether the force limit acts on the coupling
        slewed: whether the slew limit acts on the device's force
        share: of the force that the watchdog passes, 0 to 1
        approaching: whether the tip approaches a distant device
        speed_limited: whether the speed limit acts on the tip
        workspace_limited: whether the edge of its workspace stops the tip
        refused_pose_count: poses with a number that is not finite or beyond 100 m, so far
        device_fault: why the device could not be read or written in this step, or ""
        energy: net work of the hand on the device since the reset [J]
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
        """Whether the watchdog reduces the force."""
        return self.share < 1.0


class HapticTelemetry(NamedTuple):
    """One haptic step.

    Fields:
        time: at its end [s]
        fault: why the simulation has stopped, or ""
        tips: one per device
    """

    time: float
    fault: str
    tips: tuple[TipTelemetry, ...]

    @property
    def tip(self) -> TipTelemetry:
        """The first tip."""
        return self.tips[0]
