"""The haptic loop: devices coupled to the tips of a simulation's instrument, one haptic step at a time."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from msdm_core.kernels import QUADRATURE_COUNT, OrganModel
from msdm_core.mesh import FloatArray, IntArray
from msdm_core.organ import SIGNAL
from surgsim_apps.haptics.coupling import check_coupling, coupling_for
from surgsim_apps.haptics.device import DevicePose, HapticDevice
from surgsim_apps.haptics.settings import JAW_BIT, HapticSettings
from surgsim_apps.haptics.tip_drive import TipDrive, tip_drives
from surgsim_env.coupling import Simulation
from surgsim_env.instruments import SIDES, Pair

# Poses farther from the device's origin are refused [m].
REACH_LARGEST = 100.0
# Time constant of the filter for a device without force feedback [s].
SMOOTHING = 0.02


class TipTelemetry(NamedTuple):
    """One device and its tip in one haptic step.

    Fields:
        fresh: True if it was read in this step
        target: the coupling's target in the scene [m]                                        (3,)
        tip: position of the tip at the start of the step [m]                                 (3,)
        coupling_force: of the coupling on the tip, in the scene [N]                          (3,)
        force: on the device [N]                                                              (3,)
        contact_force: of the tissue on the tip, in this step [N]                             (3,)
        depth: of the tip's ball, or of the point between its pads, below the resting surface at the contact [m]; 0
            without contact
        clamped: True if the force limit acts on the coupling
        slewed: True if the slew limit acts on the device's force
        share: factor of the watchdog on the force, 0 to 1
        approaching: True while the tip approaches a distant device
        speed_limited: True if the speed limit acts on the tip
        workspace_limited: True if the edge of its workspace stops the tip
        refused_pose_count: poses with a number not finite or beyond 100 m, so far
        device_fault: error while reading or writing the device in this step, or ""
        energy: net work of the hand on the device since the reset [J]
    """

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
        """True if the watchdog reduces the force."""
        return self.share < 1.0


class HapticTelemetry(NamedTuple):
    """One haptic step.

    Fields:
        time: at its end [s]
        fault: reason of a stopped simulation, or ""
        tips: one per device
    """

    time: float
    fault: str
    tips: tuple[TipTelemetry, ...]

    @property
    def tip(self) -> TipTelemetry:
        """The first tip."""
        return self.tips[0]


class PressDepth:
    """Depth of a ball below the resting surface: r - n . (tip - c) [m].

    n and c are normal and centre of the nearest touched triangle of the surface at rest: exact for a flat face, and up
    to the curvature within a triangle otherwise. 0 without contact. The surface at rest follows a moving ground.
    """

    def __init__(self, simulation: Simulation, radius: float) -> None:
        """Measure for a tip of some radius [m]; 0 for the point between the pads of a jaw."""
        self._simulation, self._radius = simulation, radius
        self._model: OrganModel | None = None
        self._centres = self._normals = np.zeros((0, 3))
        self._carried: list[FloatArray] = []

    def of(self, tip: FloatArray) -> float:
        """Depth of a tip at a position [m], (3,)."""
        simulation = self._simulation
        if (model := simulation.organ_model) is not self._model:
            self._model = model
            corners = simulation.rest_position[model.surface_triangles]
            self._centres = corners.mean(axis=1)
            # Displacements by a unit of each motion's signal [m].
            self._carried = [motion.shift(self._centres) for motion in simulation.anatomy.ground_motions]
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            self._normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        engaged = simulation.organ_state.contact_engaged
        # Engaged with any shape, along the last axis. The view as bool makes this a hundred times as fast.
        touched = np.flatnonzero(engaged.view(np.bool_)) % engaged.shape[1] // QUADRATURE_COUNT
        if not len(touched):
            return 0.0
        across = tip - self._centres[touched]
        for signal, carried in zip(simulation.organ_state.motion[:, SIGNAL].tolist(), self._carried, strict=True):
            across -= signal * carried[touched]
        nearest = int(np.einsum("tx,tx->t", across, across).argmin())
        return self._radius - float(self._normals[touched[nearest]] @ across[nearest])


class Follower:
    """The target of a coupling: it follows the device with limited speed.

    It starts at the tip and moves to the device at the approach speed; from then on it follows at up to the largest
    speed: a distant device at the start, a restored link or a jump of the pose cannot throw the tip into an organ.
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
        """Move towards the device's position [m], (3,); `limited` is True if the speed limit acts."""
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


class Watchdog:
    """Counts haptic steps without a fresh pose; `share` is the factor on the force, 0 before the first pose."""

    def __init__(self, settings: HapticSettings, haptic_step: float) -> None:
        """Count in steps of `haptic_step` [s]."""
        # Whole steps: rounding does not decide the begin of the fading.
        self._patience = max(1, math.ceil(settings.timeout / haptic_step - 1e-9))
        self._down = haptic_step / settings.fade
        self._up = haptic_step / settings.resume
        self.share = 0.0
        self._silent = self._patience

    @property
    def expired(self) -> bool:
        """True without a fresh pose for the timeout."""
        return self._silent >= self._patience

    def step(self, fresh: bool) -> float:
        """Count one haptic step; returns the factor on the force, 0 to 1."""
        self._silent = 0 if fresh else min(self._silent + 1, self._patience)
        if self.expired:
            self.share = max(0.0, self.share - self._down)
        else:
            self.share = min(1.0, self.share + self._up)
        return self.share

    def reset(self) -> None:
        """Restart as before the first pose."""
        self.share, self._silent = 0.0, self._patience


def held_within(vector: FloatArray, largest: float) -> tuple[FloatArray, bool]:
    """The vector limited to a length, in the same direction, and True if it was longer."""
    x, y, z = vector.tolist()
    size = math.sqrt(x * x + y * y + z * z)
    if size <= largest:
        return vector, False
    return vector * (largest / size), True


class SlewLimit:
    """Limits the change of a device's force from step to step."""

    def __init__(self, slew_largest: float, haptic_step: float) -> None:
        """Start at zero force; `slew_largest` [N/s] for steps of `haptic_step` [s]."""
        self._most = slew_largest * haptic_step
        self._force = np.zeros(3)

    def follow(self, force: FloatArray) -> tuple[FloatArray, bool]:
        """The next force [N], (3,), and True if the limit changed it."""
        change, held = held_within(force - self._force, self._most)
        self._force = self._force + change if held else force
        return self._force, held

    def reset(self) -> None:
        """Set the force to zero at once."""
        self._force = np.zeros(3)


class HeldTip:
    """A tip held by a device: reads the pose, writes the force, applies the coupling, first in each haptic step."""

    def __init__(
        self, device: HapticDevice, drive: TipDrive, depth: PressDepth, settings: HapticSettings, haptic_step: float
    ) -> None:
        """Couple a device to a tip.

        Raises:
            ValueError: a coupling too stiff for device or tip, or a force limit beyond either.
        """
        self.device, self.drive, self.settings = device, drive, settings
        dynamics, smoothing = device.dynamics, settings.smoothing
        if dynamics is None:
            smoothing = SMOOTHING if smoothing is None else smoothing
        elif smoothing:
            # The filtered path differs from the path by at most tau |dx/dt|, as for a lag of tau.
            dynamics = replace(dynamics, delay=dynamics.delay + smoothing)
        self.coupling = settings.coupling or coupling_for(dynamics, drive.dynamics, haptic_step)
        check_coupling(self.coupling, dynamics, drive.dynamics, haptic_step)
        _check_force("instrument's servo", settings.force_largest, drive.force_largest)
        if device.dynamics is not None:
            _check_force("device", settings.force_largest, device.dynamics.force_largest)
        self._damping_rate = self.coupling.damping / haptic_step
        self._depth = depth
        self._watchdog = Watchdog(settings, haptic_step)
        self._slew = SlewLimit(settings.slew_largest, haptic_step)
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
        self._coupling_force, self._clamped = held_within(pull, self.settings.force_largest)
        self.drive.push(self._coupling_force, contact_force)
        self._force, self._slewed = self._slew.follow(-share * self._coupling_force)
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

    @property
    def holds_breath(self) -> bool | None:
        """True if the device's button holds the breath; None before the first pose, and without such a button."""
        button = self.settings.breath_button
        return None if button is None or self._pose is None else bool(self._pose.buttons >> button & 1)

    def telemetry(self, contact_force: FloatArray) -> TipTelemetry:
        """The record of the step; `contact_force` [N], (3,), is the tissue's in it."""
        tip = self.drive.tool.tip_position
        return TipTelemetry(
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
        if self._shift is None:
            self._shift = self._follower.place - position if self.settings.relative else np.zeros(3)
        return position + self._shift

    def _close_jaw(self, buttons: int) -> None:
        if self.drive.tool.jaw is None:
            return
        pressed = bool(buttons >> JAW_BIT & 1)
        if pressed != self._pressed:
            self._pressed = pressed
            self.drive.tool.command_jaw(-1.0 if pressed else 1.0)


def _check_force(what: str, wanted: float, most: float) -> None:
    if wanted > most:
        raise ValueError(f"haptic force_largest is {wanted:g} N; the {what} can exert {most:g} N: lower it")


class HapticLoop:
    """A simulation with its instrument coupled to devices; `step` never raises for faults of organ or device.

    Each step reads the devices' poses, writes the couplings' forces to devices and tips, and advances organ and
    instrument by one haptic step: a force responds to the pose of its own step.

    After a divergence of the organ or MuJoCo (`fault` gives the reason) forces are zero and the simulation stops, until
    `reset`.

    Fields:
        simulation: of the instrument
        held: one per device, with its coupling
        fault: reason of a stopped simulation, or ""
    """

    def __init__(
        self,
        simulation: Simulation,
        devices: HapticDevice | Sequence[HapticDevice],
        settings: HapticSettings | None = None,
    ) -> None:
        """Couple devices to the tips of an instrument at their present positions.

        Args:
            simulation: after a reset; only this loop may advance it.
            devices: one, or one per tip, the left arm's first.
            settings: for all devices.

        Raises:
            ValueError: another number of devices than of tips; a coupling too stiff for a device or tip (with the
                limit); a force beyond a device or servo.
        """
        self.simulation = simulation
        scene, dt = simulation.anatomy.scene, simulation.haptic_dt
        many = list(devices) if isinstance(devices, Sequence) else [devices]
        drives = tip_drives(simulation.instrument, dt)
        if len(many) != len(drives):
            raise ValueError(
                f"{len(many)} devices for the {len(drives)} tips of scene {scene.name!r}: give one device for each tip"
            )
        settings = settings or HapticSettings()
        depths = [PressDepth(simulation, 0.0 if drive.tool.jaw else scene.instrument.tip_radius) for drive in drives]
        self.held = [HeldTip(*parts, settings, dt) for parts in zip(many, drives, depths, strict=True)]
        self.fault = simulation.fault
        instrument = simulation.instrument
        # Indices of the tools at each tip.
        self._tools: list[IntArray] = [np.arange(instrument.tool_count, dtype=np.int32)]
        if isinstance(instrument, Pair):
            self._tools = [instrument.tools_of(side) for side in SIDES]
        # The tissue's force on each tip in the last step [N].
        self._contacts = self._contact_forces()
        self._has_breath = scene.has_breath

    def step(self) -> HapticTelemetry:
        """Advance by one haptic step; after a fault all forces are zero."""
        simulation = self.simulation
        if not self.fault:
            for held, contact in zip(self.held, self._contacts, strict=True):
                held.step(contact)
            if self._has_breath:
                self._hold_breath()
            simulation.control_step(1)
            simulation.instrument.refresh()
            self.fault = simulation.fault
            if not self.fault and simulation.instrument.data.warning.number.any():
                self.fault = simulation.instrument.warning()
            self._contacts = self._contact_forces()
        if self.fault:
            for held in self.held:
                held.release()
        tips = tuple(held.telemetry(contact) for held, contact in zip(self.held, self._contacts, strict=True))
        return HapticTelemetry(simulation.time, self.fault, tips)

    def reset(
        self, organ_model: OrganModel | None = None, tip_position: FloatArray | None = None, *, elapsed: float = 0.0
    ) -> None:
        """Restart: forces are zero, and the tips approach the devices slowly from their new positions.

        Args:
            organ_model: another organ of the same scene; the same one by default.
            tip_position: [m], (3,), or (2, 3) for a pair; the instrument's parked position by default.
            elapsed: start time of the patient's motions [s].

        Raises:
            OrganError: too few substeps in the scene for this organ; the loop keeps the previous one.
            ValueError: a position out of an arm's reach.
        """
        simulation = self.simulation
        place = simulation.instrument.parked if tip_position is None else np.asarray(tip_position, dtype=np.float64)
        if organ_model is None:
            simulation.restart(place, elapsed=elapsed)
        else:
            simulation.reset(organ_model, place, elapsed=elapsed)
        self.fault = simulation.fault
        self._contacts = self._contact_forces()
        for held in self.held:
            held.restart()

    def _hold_breath(self) -> None:
        """Hold the breath while a device's button is pressed; a device without a pose is ignored."""
        requests = [held.holds_breath for held in self.held]
        if any(request is not None for request in requests):
            self.simulation.hold_breath(any(requests))

    def _contact_forces(self) -> list[FloatArray]:
        wrench = self.simulation.contact_wrench
        return [wrench[tools, :3].sum(axis=0) for tools in self._tools]
