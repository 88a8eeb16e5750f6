"""One haptic device coupled to one tip."""

from dataclasses import replace

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.haptics.coupling import check_coupling, coupling_for
from surgsim_env.haptics.device import DevicePose, HapticDevice
from surgsim_env.haptics.frame import Follower
from surgsim_env.haptics.press_depth import PressDepth
from surgsim_env.haptics.settings import HapticSettings, SlewLimit, held_within
from surgsim_env.haptics.telemetry import TipTelemetry
from surgsim_env.haptics.tip_drive import TipDrive
from surgsim_env.haptics.watchdog import Watchdog

# Poses farther from the device's origin are refused [m].
REACH_LARGEST = 100.0
# Time constant of the filter for a device that exerts no force [s].
SMOOTHING = 0.02


class HeldTip:
    """Reads the pose, writes the force, applies the coupling to the tip: once per haptic step, first."""

    def __init__(
        self, device: HapticDevice, drive: TipDrive, settings: HapticSettings, depth: PressDepth, haptic_step: float
    ) -> None:
        """Couple a device to a tip.

        Raises:
            ValueError: a coupling too stiff for device or tip, or a force limit above what either can exert.
        """
        self.device, self.drive, self.settings = device, drive, settings
        frame, limits = settings.frame, settings.limits
        scale = frame.scale**2
        dynamics, smoothing = device.dynamics, settings.smoothing
        if dynamics is None:
            smoothing = SMOOTHING if smoothing is None else smoothing
        elif smoothing:
            # The filtered path differs from the path by at most tau |dx/dt|, as for a lag of tau.
            dynamics = replace(dynamics, delay=dynamics.delay + smoothing)
        self.coupling = settings.coupling or coupling_for(dynamics, drive.dynamics, haptic_step, scale)
        check_coupling(self.coupling, dynamics, drive.dynamics, haptic_step, scale)
        _check_force("instrument's servo", limits.force_largest, drive.force_largest)
        if device.dynamics is not None:
            _check_force("device", limits.force_largest * frame.scale, device.dynamics.force_largest)
        self._turn = np.array(frame.rotation, dtype=np.float64)
        self._origin = np.array(frame.origin, dtype=np.float64)
        self._damping_rate = self.coupling.damping / haptic_step
        self._depth = depth
        self._watchdog = Watchdog(settings.watchdog, haptic_step)
        self._slew = SlewLimit(limits.slew_largest, haptic_step)
        self._follower = Follower(
            drive.position, settings.approach_speed, settings.speed_largest, smoothing or 0.0, haptic_step
        )
        self.restart()

    def restart(self) -> None:
        """Restart after the tip was moved: zero force, and a slow approach to the device."""
        self.drive.restart()
        self._follower.restart(self.drive.position)
        self._watchdog.reset()
        self._slew.reset()
        self._stretch = np.zeros(3)
        self._pose: DevicePose | None = None
        self._shift: FloatArray | None = None
        self._pressed = False
        self._force = self._coupling_force = np.zeros(3)
        self._fresh = self._clamped = self._slewed = False
        self._refused, self._energy, self._fault = 0, 0.0, ""

    def step(self, contact_force: FloatArray) -> None:
        """Read the device, apply forces to both ends; `contact_force` [N], (3,), is the tissue's in the last step."""
        self._fault = ""
        self._read()
        share = self._watchdog.step(self._fresh)
        if self._watchdog.expired:
            self._follower.wait()
        elif self._pose is not None:
            self._follower.follow(self._scene_place(self._pose.position))
        stretch = self._follower.place - self.drive.position
        pull = self.coupling.stiffness * stretch + self._damping_rate * (stretch - self._stretch)
        self._stretch = stretch
        self._coupling_force, self._clamped = held_within(pull, self.settings.limits.force_largest)
        self.drive.push(self._coupling_force, contact_force)
        wanted = (-share * self.settings.frame.scale) * (self._coupling_force @ self._turn)
        self._force, self._slewed = self._slew.follow(wanted)
        self._write(self._force)

    def release(self) -> None:
        """Set all forces to zero at once; poses are still read."""
        self._fault = ""
        self._read()
        self._watchdog.reset()
        self._follower.wait()
        self._slew.reset()
        self._force = self._coupling_force = np.zeros(3)
        self._clamped = self._slewed = False
        self._write(self._force)

    def telemetry(self, contact_force: FloatArray) -> TipTelemetry:
        """The record of the step; `contact_force` [N], (3,), is the tissue's in it."""
        tip = self.drive.tip
        return TipTelemetry(
            pose=self._pose,
            fresh=self._fresh,
            target=self._follower.place,
            tip=tip,
            coupling_force=self._coupling_force,
            force=self._force,
            contact_force=contact_force,
            depth=self._depth.of(tip) if contact_force.any() else 0.0,
            clamped=self._clamped,
            slewed=self._slewed,
            share=self._watchdog.share,
            approaching=self._follower.approaching,
            speed_limited=self._follower.limited and not self._follower.approaching,
            workspace_limited=self.drive.limited,
            refused_pose_count=self._refused,
            device_fault=self._fault,
            energy=self._energy,
        )

    def _read(self) -> None:
        self._fresh = False
        try:
            pose = self.device.read()
        except OSError as error:
            self._fault = f"reading: {error}"
            return
        if pose is None:
            return
        # No comparison with a NaN holds.
        if not all(abs(value) <= REACH_LARGEST for value in pose.position.tolist()):
            self._refused += 1
            return
        if self._pose is not None:
            self._energy -= float(self._force @ (pose.position - self._pose.position))
        self._fresh, self._pose = True, pose
        self._close_jaw(pose.buttons)

    def _write(self, force: FloatArray) -> None:
        try:
            self.device.write(force)
        except OSError as error:
            self._fault = f"writing: {error}"

    def _scene_place(self, position: FloatArray) -> FloatArray:
        place = self.settings.frame.scale * (self._turn @ position)
        if self._shift is None:
            self._shift = self._follower.place - place if self.settings.relative else self._origin
        return place + self._shift

    def _close_jaw(self, buttons: int) -> None:
        if self.settings.jaw_button is None or not self.drive.has_jaw:
            return
        pressed = bool(buttons >> self.settings.jaw_button & 1)
        if pressed != self._pressed:
            self._pressed = pressed
            self.drive.command_jaw(-1.0 if pressed else 1.0)


def _check_force(what: str, wanted: float, most: float) -> None:
    if wanted > most:
        raise ValueError(f"limits.force_largest is {wanted:g} N; the {what} can exert {most:g} N: lower it")
