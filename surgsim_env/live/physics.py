"""The physics of a live session: haptic steps in real time, and the page's requests between them."""

import contextlib
import ctypes
import gc
import os
import signal
import sys
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from msdm_core.kernels.structure_kernels import OrganModel
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.haptics.loop import HapticLoop, HapticTelemetry
from surgsim_env.haptics.pacing import Pacer, PaceSettings
from surgsim_env.haptics.settings import HapticSettings
from surgsim_env.live.browser_device import BrowserDevice, Hands, RecordedHand
from surgsim_env.live.exchange_records import (
    TRACE_LENGTH,
    TRACE_STEPS,
    Change,
    End,
    Exchange,
    Pause,
    Phase,
    Record,
    Replay,
    Request,
    Reset,
    encoded,
)
from surgsim_env.live.home import home_of
from surgsim_env.live.organ_choice import OrganChoice, chosen_organ
from surgsim_env.rendering.instrument_geoms import shown_geoms
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.model import Scene

# Steps between frames for the page, and between checks of the parent process and of requests.
FRAME_STEPS, LOOK_STEPS = 16, 8
# Requests handled per check; others wait for the next.
REQUESTS_MOST = 4
# Largest speeds at which a tip follows its hand, in general and on the way to the organ [m/s].
SPEED_LARGEST, APPROACH_SPEED = 0.25, 0.05


@dataclass(frozen=True)
class Setup:
    """Arguments of the physics' process.

    Args:
        scene: of the session.
        choice: its first organ.
        pace: of the steps.
    """

    scene: Scene
    choice: OrganChoice
    pace: PaceSettings


class Physics:
    """Steps a simulation whose tips follow the page's hands, writes frames, and handles requests between steps."""

    def __init__(self, setup: Setup, exchange: Exchange, requests: Connection) -> None:
        """Load the scene, compile the organ, and couple the hands."""
        self._exchange, self._requests = exchange, requests
        self._anatomy = load_anatomy(setup.scene)
        self._simulation = Simulation(self._anatomy)
        self._organ: OrganModel = chosen_organ(self._anatomy, setup.choice)
        self._organ_number = 1
        instrument = self._simulation.instrument
        self._home = home_of(self._anatomy, instrument)
        self._simulation.reset(self._organ, self._home)
        dt = self._simulation.haptic_dt
        places = np.atleast_2d(self._home)
        self._hands = [Hands(BrowserDevice(exchange.hand, arm, dt, place)) for arm, place in enumerate(places)]
        settings = HapticSettings(approach_speed=APPROACH_SPEED, speed_largest=SPEED_LARGEST)
        self._loop = HapticLoop(self._simulation, self._hands, settings)
        self._geoms = np.array(shown_geoms(instrument.model), dtype=np.int64)
        self._pacer = Pacer(setup.pace, exchange.timing.peek)
        self._phase, self._said = Phase.RUNNING, ""
        self._recording, self._replaying = False, False
        self._start_state: dict[str, np.ndarray] | None = None
        self._peak = np.zeros(len(self._hands))
        # Number of requests handled; earlier ones wait in the pipe.
        self._asked = 0
        # The first step loads or compiles the kernels.
        self._last = self._loop.step()
        self._restart()

    def run(self, parent_lives: Any) -> None:
        """Step until an End request or the end of the parent process."""
        count, frame_steps = 0, FRAME_STEPS
        self._pacer.start()
        while True:
            self._pacer.wait()
            if self._phase == Phase.RUNNING:
                self._last = self._loop.step()
                self._record_step(self._last)
                self._pacer.done(self._simulation.haptic_dt)
            count += 1
            if count % frame_steps == 0:
                self._write_frame()
            if count % LOOK_STEPS == 0 and not self._handle_requests(parent_lives):
                break
        self._phase = Phase.ENDED
        self._write_frame()

    def _handle_requests(self, parent_lives: Any) -> bool:
        """Handle requests; False to end."""
        if not parent_lives():
            return False
        asked = int(self._exchange.hand.peek["requests"])
        if asked == self._asked:
            return True
        took_long = False
        try:
            for _ in range(REQUESTS_MOST):
                if not self._requests.poll():
                    break
                request = self._requests.recv()
                if isinstance(request, End):
                    return False
                self._asked += 1
                self._handle(request)
                took_long = took_long or isinstance(request, Change | Replay | Reset)
        except (EOFError, OSError):
            return False
        # Compiling an organ or restoring a state takes longer than a step, so the pacing starts again. Other requests
        # are handled within a step, and their time counts as lateness.
        if took_long:
            self._pacer.start()
        return True

    def _handle(self, request: Request) -> None:
        self._said = ""
        if isinstance(request, Pause):
            if self._phase in (Phase.RUNNING, Phase.PAUSED):
                self._phase = Phase.PAUSED if request.on else Phase.RUNNING
        elif isinstance(request, Reset):
            self._rest()
        elif isinstance(request, Change):
            self._change(request.choice)
        elif isinstance(request, Record):
            self._record(request.on)
        elif isinstance(request, Replay):
            self._replay(request)
        self._write_frame()

    def _rest(self, organ: OrganModel | None = None) -> None:
        self._recording = self._replaying = False
        for hand in self._hands:
            hand.recorded = None
        self._loop.reset(organ, self._home)
        self._restart()

    def _restart(self) -> None:
        """After the tips were moved: restart the hands from there, and the trace."""
        self._phase = Phase.RUNNING
        for hand, held in zip(self._hands, self._loop.held, strict=True):
            hand.browser.restart(held.drive.tool.tip_position)
        with self._exchange.trace.writing() as trace:
            trace["organ"], trace["count"] = self._organ_number, 0
        self._peak[:] = 0.0
        untouched = tuple(held.telemetry(np.zeros(3)) for held in self._loop.held)
        self._last = HapticTelemetry(self._simulation.time, "", untouched)
        self._write_frame()

    def _change(self, choice: OrganChoice) -> None:
        before, number = self._organ, self._organ_number
        try:
            organ = chosen_organ(self._anatomy, choice)
            self._organ_number += 1
            self._rest(organ)
            self._organ, self._start_state = organ, None
        except ValueError as error:
            self._organ_number = number
            self._rest(before)
            self._said = f"this organ cannot be made: {error}"

    def _record(self, on: bool) -> None:
        if on and self._recording:
            return
        if on and not self._replaying:
            self._exchange.recorded.clear()
            # The couplings restart here and in a replay, so that both begin in the same state.
            self._start_state = self._simulation.get_state()
            for held in self._loop.held:
                held.restart()
        self._recording = on and not self._replaying

    def _replay(self, request: Replay) -> None:
        self._recording = False
        if not request.on or self._exchange.recorded.count == 0:
            self._replaying = False
            for hand in self._hands:
                hand.recorded = None
            return
        if request.given or self._start_state is None:
            self._loop.reset(None, self._home)
        else:
            self._simulation.set_state(self._organ, self._start_state)
            self._loop.fault = self._simulation.fault
            for held in self._loop.held:
                held.restart()
        self._restart()
        for arm, hand in enumerate(self._hands):
            hand.recorded = RecordedHand(self._exchange.recorded, arm)
        self._replaying = True

    def _record_step(self, told: HapticTelemetry) -> None:
        """Add a step to the trace and the recording, and react to the end of a replay and to faults."""
        exchange, simulation = self._exchange, self._simulation
        for arm, tip in enumerate(told.tips):
            x, y, z = tip.contact_force.tolist()
            self._peak[arm] = max(self._peak[arm], (x * x + y * y + z * z) ** 0.5)
        step = round(told.time / simulation.haptic_dt)
        if step % TRACE_STEPS == 0:
            with exchange.trace.writing() as trace:
                row = trace["row"][int(trace["count"]) % TRACE_LENGTH]
                row["time"] = told.time
                for arm, tip in enumerate(told.tips):
                    row["tip"][arm], row["depth"][arm], row["force"][arm] = tip.tip, tip.depth, tip.contact_force
                row["peak"] = self._peak
                trace["count"] += 1
            self._peak[:] = 0.0
        if self._recording:
            if exchange.recorded.full:
                self._recording, self._said = False, "the recording is full"
            else:
                poses = [hand.pose for hand in self._hands]
                places = np.array([np.full(3, np.nan) if pose is None else pose.position for pose in poses])
                tips = np.array([tip.tip for tip in told.tips])
                buttons = [0 if pose is None else pose.buttons for pose in poses]
                exchange.recorded.append(
                    told.time, places, buttons, tips, np.array([tip.contact_force for tip in told.tips])
                )
        if self._replaying and all(hand.recorded is None or hand.recorded.done for hand in self._hands):
            self._replaying = False
            for hand, held in zip(self._hands, self._loop.held, strict=True):
                hand.recorded = None
                hand.browser.restart(held.drive.tool.tip_position)
        if told.fault:
            self._phase, self._said, self._recording = Phase.FAULT, told.fault, False
            self._write_frame()

    def _write_frame(self) -> None:
        """Write a frame for the page."""
        simulation, told = self._simulation, self._last
        data = simulation.instrument.data
        with self._exchange.frame.writing() as frame:
            frame["phase"], frame["organ"] = int(self._phase), self._organ_number
            frame["recording"], frame["replaying"] = self._recording, self._replaying
            frame["time"], frame["said"] = simulation.time, encoded(self._said)
            frame["added_mass"] = self._organ.added_mass
            for arm, tip in enumerate(told.tips):
                frame["tip"][arm] = self._loop.held[arm].drive.tool.tip_position
                frame["place"][arm], frame["force"][arm] = tip.target, tip.contact_force
                frame["pushed"][arm], frame["share"][arm] = tip.force, tip.share
                frame["limited"][arm] = tip.clamped or tip.workspace_limited
            frame["node"] = simulation.organ_state.node_position[:, :3]
            frame["geom"], frame["turn"] = data.geom_xpos[self._geoms], data.geom_xmat[self._geoms]


# Unix niceness (scheduling priority); values below 0 need the right to set them.
NICENESS = -10


def run_physics(setup: Setup, exchange: Exchange, requests: Connection, parent: int) -> None:
    """Run the child process; it ends on request, or when the process with the id `parent` has ended.

    An error at the start is sent through `requests` as a text, and the process ends with status 1.
    """
    # The page's process handles Ctrl-C and ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _set_timer_slack()
    _raise_priority()
    try:
        physics = Physics(setup, exchange, requests)
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
    """Raise the process' priority above pictures and browsers, where that is allowed.

    Linux shares the processor first between sessions (autogroups), then within each by niceness, so the physics gets
    a session of its own.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.setsid()
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text(str(NICENESS))


def _set_timer_slack() -> None:
    """Set the timer slack of Linux to 1 ns: sleeps otherwise end up to 50 us late."""
    if sys.platform == "linux":
        set_timer_slack = 29
        ctypes.CDLL(None).prctl(set_timer_slack, 1, 0, 0, 0)
