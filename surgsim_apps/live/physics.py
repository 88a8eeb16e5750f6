"""The physics of a live session: haptic steps in real time for the page's hands, requests between them."""

import contextlib
import gc
import math
import os
import signal
import sys
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from msdm_core.kernels import OrganModel
from msdm_core.mesh import FloatArray
from surgsim_apps.haptics.device import DevicePose
from surgsim_apps.haptics.loop import HapticLoop, HapticTelemetry
from surgsim_apps.haptics.pacing import Pacer, PaceSettings
from surgsim_apps.haptics.settings import BREATH_BIT, HapticSettings
from surgsim_apps.live.exchange_records import (
    TRACE_LENGTH,
    TRACE_STEPS,
    Change,
    End,
    Exchange,
    Paint,
    Pause,
    Phase,
    Record,
    Request,
    Reset,
)
from surgsim_apps.live.organ_choice import OrganChoice, chosen_organ
from surgsim_env.coupling import Simulation
from surgsim_env.instruments import CONTACT_GROUP, ArmInstrument, Instrument, Pair
from surgsim_env.rendering import shown_geoms
from surgsim_env.scene import Anatomy

# Steps between frames for the page, and between checks of the parent process and of requests.
FRAME_STEPS, LOOK_STEPS = 16, 8
# Largest speeds of a tip after its hand, in general and on the way to the organ [m/s].
SPEED_LARGEST, APPROACH_SPEED = 0.25, 0.05
# Initial distance of a tip on slides from the organ, and smallest distance of any contact shape [m].
HOME_GAP, SHAPE_GAP = 0.015, 0.004
# Time constant of the smoothing [s]: a mouse reports 20 to 60 positions a second.
SMOOTHING = 0.030
# Steps without a beat (of 100 a second) until the page's process counts as dead.
SILENT_STEPS_MOST = 20


def home_of(anatomy: Anatomy, instrument: Instrument) -> FloatArray:
    """Initial tip positions [m], (3,) or (2, 3): over the middle of the palpable face, or an arm's parked position.

    Farther away if an open jaw would touch beyond its tip. `instrument` is parked and is not moved.
    """
    face = anatomy.face
    if isinstance(instrument, ArmInstrument | Pair):
        place = instrument.parked
    else:
        corners = face.points[face.triangles]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        point, normal = face.project(np.average(corners.mean(axis=1), axis=0, weights=area))
        place = point + normal * (anatomy.scene.instrument.tip_radius + HOME_GAP)
    missing = SHAPE_GAP - _clearance(anatomy, instrument, (place - instrument.parked).reshape(-1, 3)[0])
    return np.clip(place - max(0.0, missing) * face.approach, instrument.lower, instrument.upper)


def _clearance(anatomy: Anatomy, instrument: Instrument, shift: FloatArray) -> float:
    """Smallest distance [m] of a parked instrument, shifted by [m] (3,), from the organ along the approach."""
    model, data, face = instrument.model, instrument.data, anatomy.face
    out, gaps = -face.approach, []
    for geom in np.flatnonzero((model.geom_group == CONTACT_GROUP) & (model.geom_bodyid != 0)):
        turn = data.geom_xmat[geom].reshape(3, 3)
        centre = data.geom_xpos[geom] + turn @ model.geom_aabb[geom, :3] + shift
        half = float(np.abs(out @ turn) @ model.geom_aabb[geom, 3:])
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
            half = float(model.geom_size[geom, 0])
        gaps.append(float((centre - face.project(centre)[0]) @ out) - half)
    return min(gaps)


class BrowserDevice:
    """A `HapticDevice` with the pose of a web page and without force.

    While the page's process is alive every step has a pose, since a hand at rest sends no messages. After 20 steps
    without a beat there is none, and the loop's watchdog fades the force.

    Fields:
        pose: of the last step; None without one
    """

    dynamics = None

    def __init__(self, exchange: Exchange, arm: int, step: float, place: FloatArray) -> None:
        """Follow one arm's target in steps [s], from its tip's place [m], (3,)."""
        self._hand, self._arm, self._step_time = exchange.hand, arm, step
        self._share = 1.0 - math.exp(-step / SMOOTHING)
        self._beat, self._buttons = -1, 0
        self.pose: DevicePose | None = None
        self.restart(place)

    def restart(self, place: FloatArray) -> None:
        """Restart at a position [m], (3,)."""
        self._place = place.copy()
        self._steps, self._silent = 0, SILENT_STEPS_MOST

    def read(self) -> DevicePose | None:
        """The smoothed pose, None if the page's process is dead."""
        self._steps += 1
        record = self._hand.glance()
        if record is None or int(record["beat"]) == self._beat:
            self._silent += 1
        else:
            self._beat, self._silent = int(record["beat"]), 0
            self._target, self._buttons = record["target"][self._arm].copy(), int(record["buttons"][self._arm])
        self.pose = None
        if self._silent < SILENT_STEPS_MOST:
            self._place = self._place + self._share * (self._target - self._place)
            self.pose = DevicePose(self._place, self._steps * self._step_time, self._buttons)
        return self.pose

    def write(self, force: FloatArray) -> None:
        """Nothing to do: the page displays the forces of frames."""


class Physics:
    """A simulation with tips after the page's hands: steps, frames, and requests between steps."""

    def __init__(
        self, anatomy: Anatomy, choice: OrganChoice, pace: PaceSettings, exchange: Exchange, requests: Connection
    ) -> None:
        """Compile the first organ, and couple the hands."""
        self._exchange, self._requests, self._anatomy = exchange, requests, anatomy
        self._simulation = Simulation(self._anatomy)
        self._organ: OrganModel = chosen_organ(self._anatomy, choice)
        self._organ_number = self._changes = 1
        self._paints = False
        instrument = self._simulation.instrument
        self._home = home_of(self._anatomy, instrument)
        self._simulation.reset(self._organ, self._home)
        dt = self._simulation.haptic_dt
        self._hands = [BrowserDevice(exchange, arm, dt, place) for arm, place in enumerate(np.atleast_2d(self._home))]
        settings = HapticSettings(approach_speed=APPROACH_SPEED, speed_largest=SPEED_LARGEST, breath_button=BREATH_BIT)
        self._loop = HapticLoop(self._simulation, self._hands, settings)
        self._geoms = np.array(shown_geoms(instrument.model), dtype=np.int64)
        self._pacer = Pacer(pace, exchange.timing.peek)
        self._phase, self._message = Phase.RUNNING, ""
        # The page counts recordings: one may begin and end between two of its looks.
        self._recording, self._recordings = False, 0
        self._peak = np.zeros(len(self._hands))
        # The first step loads or compiles the kernels.
        self._last = self._loop.step()
        self._restart()

    def run(self, parent_lives: Any) -> None:
        """Step until an End request or the end of the parent process."""
        count = 0
        self._pacer.start()
        while True:
            self._pacer.wait()
            if self._phase == Phase.RUNNING:
                self._last = self._loop.step()
                self._record_step(self._last)
                self._pacer.done(self._simulation.haptic_dt)
            count += 1
            if count % FRAME_STEPS == 0:
                self._write_frame()
            if count % LOOK_STEPS == 0 and not self._handle_requests(parent_lives):
                break
        self._phase = Phase.ENDED
        self._write_frame()

    def _handle_requests(self, parent_lives: Any) -> bool:
        """Handle requests; False to end."""
        if not parent_lives():
            return False
        took_long = False
        try:
            while self._requests.poll():
                request = self._requests.recv()
                if isinstance(request, End):
                    return False
                self._handle(request)
                took_long = took_long or isinstance(request, Change | Reset)
        except (EOFError, OSError):
            return False
        # Compiling an organ takes longer than a step, so the pacing starts again. Other requests
        # are handled within a step, and their time counts as lateness.
        if took_long:
            self._pacer.start()
        return True

    def _handle(self, request: Request) -> None:
        self._message = ""
        if isinstance(request, Pause):
            if self._phase in (Phase.RUNNING, Phase.PAUSED):
                self._phase = Phase.PAUSED if request.on else Phase.RUNNING
        elif isinstance(request, Reset):
            self._rest()
        elif isinstance(request, Change):
            self._change(request.choice)
        elif isinstance(request, Record):
            self._record(request.on)
        elif isinstance(request, Paint):
            self._paints = request.on
        self._write_frame()

    def _rest(self, organ: OrganModel | None = None) -> None:
        self._recording = False
        self._loop.reset(organ, self._home)
        self._restart()

    def _restart(self) -> None:
        """Restart the hands from moved tips, and the trace."""
        self._phase = Phase.RUNNING
        for hand, held in zip(self._hands, self._loop.held, strict=True):
            hand.restart(held.drive.tool.tip_position)
        with self._exchange.trace.writing() as trace:
            trace["count"] = 0
        self._peak[:] = 0.0
        untouched = tuple(held.telemetry(np.zeros(3)) for held in self._loop.held)
        self._last = HapticTelemetry(self._simulation.time, "", untouched)
        self._write_frame()

    def _change(self, choice: OrganChoice) -> None:
        before, number = self._organ, self._organ_number
        self._changes += 1
        try:
            organ = chosen_organ(self._anatomy, choice)
            self._organ_number = self._changes
            self._rest(organ)
            self._organ = organ
        except ValueError as error:
            self._organ_number = number
            self._rest(before)
            self._message = f"this organ cannot be made: {error}"

    def _record(self, on: bool) -> None:
        if on and self._recording:
            return
        if on:
            self._exchange.recorded.clear()
            self._recordings += 1
        self._recording = on

    def _record_step(self, telemetry: HapticTelemetry) -> None:
        """Add a step to the trace and the recording, and react to faults."""
        exchange, simulation = self._exchange, self._simulation
        for arm, tip in enumerate(telemetry.tips):
            x, y, z = tip.contact_force.tolist()
            self._peak[arm] = max(self._peak[arm], (x * x + y * y + z * z) ** 0.5)
        step = round(telemetry.time / simulation.haptic_dt)
        if step % TRACE_STEPS == 0:
            with exchange.trace.writing() as trace:
                row = trace["row"][int(trace["count"]) % TRACE_LENGTH]
                row["time"] = telemetry.time
                for arm, tip in enumerate(telemetry.tips):
                    row["tip"][arm] = tip.tip - simulation.ground_shift(tip.tip)
                    row["depth"][arm], row["force"][arm] = tip.depth, tip.contact_force
                row["peak"] = self._peak
                trace["count"] += 1
            self._peak[:] = 0.0
        if self._recording:
            if exchange.recorded.full:
                self._recording, self._message = False, "the recording is full"
            else:
                poses = [hand.pose for hand in self._hands]
                places = np.array([np.full(3, np.nan) if pose is None else pose.position for pose in poses])
                tips = np.array([tip.tip for tip in telemetry.tips])
                buttons = [0 if pose is None else pose.buttons for pose in poses]
                exchange.recorded.append(
                    telemetry.time, places, buttons, tips, np.array([tip.contact_force for tip in telemetry.tips])
                )
        if telemetry.fault:
            self._phase, self._message, self._recording = Phase.FAULT, telemetry.fault, False
            self._write_frame()

    def _write_frame(self) -> None:
        """Write a frame for the page."""
        simulation, telemetry = self._simulation, self._last
        data = simulation.instrument.data
        with self._exchange.frame.writing() as frame:
            frame["phase"], frame["organ"] = int(self._phase), self._organ_number
            frame["recording"], frame["recordings"] = self._recording, self._recordings
            frame["breath_held"] = simulation.holds_breath
            frame["time"], frame["message"] = simulation.time, self._message.encode()
            frame["added_mass"] = self._organ.added_mass
            for arm, tip in enumerate(telemetry.tips):
                frame["tip"][arm] = self._loop.held[arm].drive.tool.tip_position
                frame["force"][arm] = tip.contact_force
            frame["node"] = simulation.organ_state.node_position[:, :3]
            if simulation.taxels is not None:
                frame["taxel"] = simulation.taxels[..., 2]
            frame["geom"], frame["turn"] = data.geom_xpos[self._geoms], data.geom_xmat[self._geoms]
        if self._paints:
            with self._exchange.tissue.writing() as tissue:
                tissue["organ"] = self._organ_number
                for name, array in simulation.get_state().items():
                    tissue[name] = array


# Unix niceness (scheduling priority); values below 0 need the right to set them.
NICENESS = -10


def run_physics(
    anatomy: Anatomy, choice: OrganChoice, pace: PaceSettings, exchange: Exchange, requests: Connection, parent: int
) -> None:
    """Run the child process; it ends on request, or when the process with the id `parent` has ended.

    An error at the start goes through `requests` as a text, and the process ends with status 1.
    """
    # The page's process handles Ctrl-C and ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _raise_priority()
    try:
        physics = Physics(anatomy, choice, pace, exchange, requests)
    except (ValueError, OSError) as error:
        with contextlib.suppress(OSError):
            requests.send(str(error))
        sys.exit(1)
    # Objects made so far stay, and no step creates reference cycles: garbage collection would only cost time.
    gc.collect()
    gc.freeze()
    gc.disable()
    physics.run(lambda: os.getppid() == parent)


def _raise_priority() -> None:
    """Raise the process' priority above pictures and browsers, if allowed.

    Linux shares the processor first between sessions (autogroups), then within each by niceness, so the physics gets
    a session of its own.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.setsid()
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text(str(NICENESS))
