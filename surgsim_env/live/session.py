"""A live session as its page's process sees it: hands that move, requests, and what the physics tells."""

import contextlib
import multiprocessing
import os
import threading
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from surgsim_env.anatomy import load_anatomy
from surgsim_env.live.errors import LiveError
from surgsim_env.live.exchange_records import TRACE_LENGTH, Exchange, Phase, new_exchange
from surgsim_env.live.hand_messages import HandMotion
from surgsim_env.live.home import home_of
from surgsim_env.live.organ_choice import OrganChoice, lesion_kinds, live_scene
from surgsim_env.live.physics import Setup
from surgsim_env.live.physics_process import run_physics
from surgsim_env.live.requests import Change, End, Request
from surgsim_env.pacing import PaceSettings
from surgsim_env.rendering.instrument_geoms import shown_geoms
from surgsim_env.scenes import Scene
from surgsim_env.simulation import Simulation

# The hands' beat [1/s], and how long a key or stick is taken to be held after it was last heard of [s].
BEAT_RATE, HELD = 100.0, 0.15
# A hand at full deflection moves a target this fast [m/s].
HAND_SPEED = 0.04
# The button that closes a jaw, as `HapticSettings.jaw_button` has it.
JAW_BUTTON = 1
# How long compiling with an empty cache may take [s].
START_TIMEOUT = 300.0


class Session:
    """Starts the physics' process and speaks with it; every method may be called from any thread.

    Fields:
        anatomy, instrument: as the physics has them; the instrument stays parked
        exchange: what both share
        parked: where tips begin [m]                                             (n_arm, 3)
        choice: the organ that was asked for last
        directions: unit vectors right, away and out of the view, as rows         (3, 3)
    """

    def __init__(self, scene: Scene, *, pace: PaceSettings | None = None) -> None:
        """Start; `wait` waits until it steps.

        Raises:
            ValueError: a scene whose mesh or instrument cannot be made.
        """
        self.scene = live_scene(scene)
        self.anatomy = load_anatomy(self.scene)
        self.instrument = Simulation(self.anatomy).instrument
        self.parked = np.atleast_2d(home_of(self.anatomy, self.instrument)).copy()
        self.choice = OrganChoice(lesions=lesion_kinds(scene)[0])
        self.directions = np.eye(3)
        self.geoms = shown_geoms(self.instrument.model)
        self.exchange: Exchange = new_exchange(len(self.parked), self.anatomy.mesh.node_count, len(self.geoms))
        self._targets = self.parked.copy()
        self._buttons = np.zeros(len(self.parked), dtype=np.int64)
        self._motions: dict[int, tuple[FloatArray, float]] = {}
        self._lock = threading.Lock()
        self._requests = 0
        spawn = multiprocessing.get_context("spawn")
        self._pipe, child = spawn.Pipe()
        setup = Setup(self.scene, self.choice, pace or PaceSettings(period=self.scene.timing.haptic_step))
        self._process = spawn.Process(
            target=run_physics, args=(setup, self.exchange, child, os.getpid()), name="surgsim physics", daemon=True
        )
        self._process.start()
        child.close()
        self._ended = threading.Event()
        self._beating = threading.Thread(target=self._beat, name="surgsim hands", daemon=True)
        self._beating.start()

    @property
    def arm_count(self) -> int:
        """How many tips are held."""
        return len(self.parked)

    @property
    def targets(self) -> FloatArray:
        """Where the hands are [m], (n_arm, 3)."""
        with self._lock:
            return self._targets.copy()

    @property
    def alive(self) -> bool:
        """Whether the physics' process lives."""
        return self._process.is_alive()

    def wait(self, timeout: float = START_TIMEOUT) -> None:
        """Until the physics steps.

        Raises:
            LiveError: it died, and why where it said so, or did not begin in time.
        """
        deadline = time.monotonic() + timeout
        while self.frame()["phase"] == Phase.STARTING or not int(self.exchange.timing.peek["steps"]):
            self.require_alive()
            if time.monotonic() > deadline:
                raise LiveError(f"the physics did not begin within {timeout:g} s")
            time.sleep(0.02)

    def require_alive(self) -> None:
        """Check that the physics' process lives.

        Raises:
            LiveError: it died; with what it said.
        """
        if self.alive:
            return
        said = ""
        # What it could not say, Python has printed.
        with contextlib.suppress(EOFError, OSError):
            said = self._pipe.recv() if self._pipe.poll() else ""
        why = said or f"exit code {self._process.exitcode}; its own message, if any, stands above"
        raise LiveError(f"the physics' process died: {why}")

    def frame(self) -> NDArray[Any]:
        """The newest frame, a copy."""
        return self.exchange.frame.read()

    def trace(self) -> NDArray[Any]:
        """The trace's rows, oldest first."""
        trace = self.exchange.trace.read()
        count = int(trace["count"])
        if count <= TRACE_LENGTH:
            return trace["row"][:count]
        return np.roll(trace["row"], -(count % TRACE_LENGTH), axis=0)

    def timing(self) -> tuple[NDArray[Any], float]:
        """A copy of the timing record and the clock's reading [s]."""
        return self.exchange.timing.peek.copy(), time.perf_counter()

    def ask(self, request: Request) -> None:
        """Send a request; what it leads to shows in frames."""
        with self._lock:
            if isinstance(request, Change):
                self.choice = request.choice
            try:
                self._pipe.send(request)
            except OSError:
                return  # The physics is gone; `alive` says so.
            self._requests += 1

    def move_to(self, arm: int, target: FloatArray) -> None:
        """Put a hand somewhere [m], (3,); it is held within the tip's workspace and a centimetre of its walls.

        Raises:
            ValueError: a place that is not finite.
        """
        if not np.isfinite(target).all():
            raise ValueError(f"a hand's place is {target}; it must be finite")
        with self._lock:
            self._targets[arm] = np.clip(target, self.instrument.lower - 0.01, self.instrument.upper + 0.01)

    def park(self) -> None:
        """Put all hands where tips are parked."""
        with self._lock:
            self._targets[:] = self.parked

    def push(self, motion: HandMotion) -> None:
        """Let a key or a stick move a hand; it is held until it is not heard of for a while.

        A page does not know how many arms there are: the other arm of one is the same.
        """
        arm = motion.arm % self.arm_count
        with self._lock:
            self._motions[arm] = (np.array(motion.axes), time.monotonic())
            if motion.turns_jaw:
                self._buttons[arm] ^= JAW_BUTTON

    def close_jaw(self, closed: bool) -> None:
        """Close or open the first arm's jaw."""
        with self._lock:
            self._buttons[0] = JAW_BUTTON if closed else 0

    @property
    def jaw_closed(self) -> bool:
        """Whether the first arm's jaw was told to be closed."""
        return bool(self._buttons[0] & JAW_BUTTON)

    def close(self) -> None:
        """End the physics."""
        self.ask(End())
        self._ended.set()
        self._beating.join(timeout=1.0)
        with self._lock:
            self._show_hands()
        self._process.join(timeout=3.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join(timeout=3.0)
        self._pipe.close()

    def _beat(self) -> None:
        """Move hands that are pushed, and show the physics that this process lives."""
        period, then = 1.0 / BEAT_RATE, time.monotonic()
        while not self._ended.wait(period):
            now = time.monotonic()
            passed, then = min(now - then, 0.1), now
            with self._lock:
                for arm, (axes, heard) in list(self._motions.items()):
                    if now - heard > HELD or not axes.any():
                        del self._motions[arm]
                        continue
                    moved = self._targets[arm] + passed * HAND_SPEED * (axes @ self.directions)
                    self._targets[arm] = np.clip(moved, self.instrument.lower, self.instrument.upper)
                self._show_hands()

    def _show_hands(self) -> None:
        with self.exchange.hand.writing() as hand:
            hand["target"], hand["buttons"] = self._targets, self._buttons
            hand["beat"] += 1
            hand["requests"] = self._requests
