"""The physics of a live session: a haptic step whenever one is due, and what the page asks for in between."""

from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from msdm_core.kernels import OrganModel
from surgsim_env.anatomy import load_anatomy
from surgsim_env.haptics.loop import HapticLoop
from surgsim_env.haptics.settings import HapticSettings
from surgsim_env.haptics.telemetry import HapticTelemetry
from surgsim_env.live.browser_device import BrowserDevice, Hands, RecordedHand
from surgsim_env.live.exchange_records import TRACE_LENGTH, TRACE_STEPS, Exchange, Phase, said
from surgsim_env.live.home import home_of
from surgsim_env.live.organ_choice import OrganChoice, chosen_organ
from surgsim_env.live.requests import Change, End, Pause, Record, Replay, Request, Reset
from surgsim_env.pacing import Pacer, PaceSettings
from surgsim_env.rendering.instrument_geoms import shown_geoms
from surgsim_env.scenes import Scene
from surgsim_env.simulation import Simulation

# A frame for the page is written once in so many steps, the parent and the page's requests looked at likewise.
FRAME_STEPS, LOOK_STEPS = 16, 8
# So many requests are heeded at a look; the others wait for the next.
REQUESTS_MOST = 4
# The hand may go through the air at this speed [m/s] before a tip follows no more.
SPEED_LARGEST, APPROACH_SPEED = 0.25, 0.05


@dataclass(frozen=True)
class Setup:
    """What a physics process is started with.

    Args:
        scene: of the session.
        choice: its first organ.
        pace: of the steps.
    """

    scene: Scene
    choice: OrganChoice
    pace: PaceSettings


class Physics:
    """Steps a simulation that the page's hands hold, tells the page, and does what it asks between two steps."""

    def __init__(self, setup: Setup, exchange: Exchange, requests: Connection) -> None:
        """Load the scene, compile what is to be compiled, and couple the hands."""
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
        # Requests that were heeded; those that came before the first step lie in the pipe.
        self._asked = 0
        # The first steps load and compile.
        self._last = self._loop.step()
        self._begin_again()

    def run(self, parent_lives: Any) -> None:
        """Step until told to end."""
        count, frame_steps = 0, FRAME_STEPS
        self._pacer.start()
        while True:
            self._pacer.wait()
            if self._phase == Phase.RUNNING:
                self._last = self._loop.step()
                self._keep(self._last)
                self._pacer.done(self._simulation.haptic_dt)
            count += 1
            if count % frame_steps == 0:
                self._tell()
            if count % LOOK_STEPS == 0 and not self._look(parent_lives):
                break
        self._phase = Phase.ENDED
        self._tell()

    def _look(self, parent_lives: Any) -> bool:
        """Do what was asked for; False to end."""
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
                self._do(request)
                took_long = took_long or isinstance(request, Change | Replay | Reset)
        except (EOFError, OSError):
            return False
        # Making an organ, or a state, takes longer than a step, and was asked for: the clock starts again. Any other
        # request is heeded within a step, and what it costs is lateness like any other.
        if took_long:
            self._pacer.start()
        return True

    def _do(self, request: Request) -> None:
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
        self._tell()

    def _rest(self, organ: OrganModel | None = None) -> None:
        self._recording = self._replaying = False
        for hand in self._hands:
            hand.recorded = None
        self._loop.reset(organ, self._home)
        self._begin_again()

    def _begin_again(self) -> None:
        """The tips were put somewhere: hands start from there, and the trace anew."""
        self._phase = Phase.RUNNING
        for hand, held in zip(self._hands, self._loop.held, strict=True):
            hand.browser.restart(held.drive.tip)
        with self._exchange.trace.writing() as trace:
            trace["organ"], trace["count"] = self._organ_number, 0
        self._peak[:] = 0.0
        untouched = tuple(held.telemetry(np.zeros(3)) for held in self._loop.held)
        self._last = HapticTelemetry(self._simulation.time, "", untouched)
        self._tell()

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
            self._said = f"not that organ: {error}"

    def _record(self, on: bool) -> None:
        if on and self._recording:
            return
        if on and not self._replaying:
            self._exchange.recorded.clear()
            # From a held instrument's state and couplings that start anew, so that a replay can start the same.
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
        self._begin_again()
        for arm, hand in enumerate(self._hands):
            hand.recorded = RecordedHand(self._exchange.recorded, arm)
        self._replaying = True

    def _keep(self, told: HapticTelemetry) -> None:
        """Note a step in trace and recording, and see what it came to."""
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
                hand.browser.restart(held.drive.tip)
        if told.fault:
            self._phase, self._said, self._recording = Phase.FAULT, told.fault, False
            self._tell()

    def _tell(self) -> None:
        """Write a frame for the page."""
        simulation, told = self._simulation, self._last
        data = simulation.instrument.data
        with self._exchange.frame.writing() as frame:
            frame["phase"], frame["organ"] = int(self._phase), self._organ_number
            frame["recording"], frame["replaying"] = self._recording, self._replaying
            frame["time"], frame["said"] = simulation.time, said(self._said)
            frame["added_mass"] = self._organ.added_mass
            for arm, tip in enumerate(told.tips):
                frame["tip"][arm] = self._loop.held[arm].drive.tip
                frame["place"][arm], frame["force"][arm] = tip.target, tip.contact_force
                frame["pushed"][arm], frame["share"][arm] = tip.force, tip.share
                frame["limited"][arm] = tip.clamped or tip.workspace_limited
            frame["node"] = simulation.organ_state.node_position[:, :3]
            frame["geom"], frame["turn"] = data.geom_xpos[self._geoms], data.geom_xmat[self._geoms]
