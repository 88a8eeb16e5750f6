"""A live session in the page's process: motions of the hands, requests to the physics, its frames."""

import contextlib
import math
import multiprocessing
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from surgsim_apps.haptics.pacing import PaceSettings
from surgsim_apps.haptics.settings import BREATH_BIT
from surgsim_apps.live.exchange_records import (
    TRACE_LENGTH,
    Change,
    End,
    Exchange,
    LiveError,
    Phase,
    Request,
    new_exchange,
)
from surgsim_apps.live.messages import HandMotion
from surgsim_apps.live.organ_choice import OrganChoice, lesion_kinds
from surgsim_apps.live.physics import home_of, run_physics
from surgsim_env.coupling import Simulation
from surgsim_env.rendering import shown_geoms
from surgsim_env.scene import Anatomy

# Updates of the hands [1/s], and the duration of a key or stick after its last message [s].
BEAT_RATE, HELD = 100.0, 0.15
# Speed of a target at full deflection [m/s].
HAND_SPEED = 0.04
# Speed of a target on its way to a touch, and while it presses and slides [m/s]; its clearance before and after, and
# the longest slide behind a pointer [m].
TOUCH_SPEED, PRESS_SPEED, CLEARANCE, SLIDE_MOST = 0.15, 0.05, 0.008, 0.015
# Buttons for closing a jaw (JAW_BIT of `HapticSettings`), and for holding the breath, of the first arm.
JAW_BUTTON, BREATH_BUTTON = 1, 1 << BREATH_BIT
# Longest start, with an empty numba cache [s].
START_TIMEOUT = 300.0


@dataclass
class _Touch:
    """A touch of one hand: the pressed place at rest [m], the outward normal there, the depth [m]."""

    place: FloatArray
    outward: FloatArray
    depth: float
    # True once the tip is above the place; False once the pointer has let go.
    arrived: bool = False
    held: bool = True


class Session:
    """Starts the physics' process and communicates with it; every method may be called from any thread.

    Fields:
        anatomy, simulation, instrument: copies of the physics' ones; they stay at rest while no field is painted
        exchange: memory shared with the physics
        parked: initial positions of the tips [m]                                 (n_arm, 3)
        choices: organs requested so far; a frame's `organ` is the number of its own, from 1
        directions: unit vectors right, away and out of the view, as rows         (3, 3)
    """

    def __init__(
        self, anatomy: Anatomy, *, pace: PaceSettings | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Start the process; `wait` returns when it steps.

        Args:
            anatomy: what is shown.
            pace: of the haptic steps; one a haptic step of the scene by default.
            clock: for the durations of keys and sticks [s].

        Raises:
            ValueError: a scene without a valid instrument.
        """
        self.anatomy, self.scene = anatomy, anatomy.scene
        self.simulation = Simulation(self.anatomy)
        self.instrument = self.simulation.instrument
        self.parked = np.atleast_2d(home_of(self.anatomy, self.instrument)).copy()
        self.choices = [OrganChoice(lesions=lesion_kinds(self.scene)[0])]
        self.directions = np.eye(3)
        self.geoms = shown_geoms(self.instrument.model)
        self.exchange: Exchange = new_exchange(
            len(self.parked),
            self.anatomy.mesh.node_count,
            len(self.geoms),
            self.simulation.get_state(),
            self.instrument.taxel_shape[:3],
        )
        self._targets = self.parked.copy()
        self._buttons = np.zeros(len(self.parked), dtype=np.int64)
        self._motions: dict[int, tuple[FloatArray, float]] = {}
        self._touches: dict[int, _Touch] = {}
        self._clock = clock
        self._lock = threading.Lock()
        spawn = multiprocessing.get_context("spawn")
        self._pipe, child = spawn.Pipe()
        pace = pace or PaceSettings(period=self.scene.timing.haptic_step)
        self._process = spawn.Process(
            target=run_physics,
            args=(anatomy, self.choice, pace, self.exchange, child, os.getpid()),
            name="surgsim physics",
            daemon=True,
        )
        self._process.start()
        child.close()
        self._ended = threading.Event()
        self._beating = threading.Thread(target=self._beat, name="surgsim hands", daemon=True)
        self._beating.start()

    @property
    def arm_count(self) -> int:
        """Number of tips."""
        return len(self.parked)

    @property
    def choice(self) -> OrganChoice:
        """The organ requested last."""
        return self.choices[-1]

    @property
    def targets(self) -> FloatArray:
        """Target positions of the hands [m], (n_arm, 3)."""
        with self._lock:
            return self._targets.copy()

    @property
    def alive(self) -> bool:
        """True if the physics' process is running."""
        return self._process.is_alive()

    def wait(self, timeout: float = START_TIMEOUT) -> None:
        """Wait until the physics steps.

        Raises:
            LiveError: the process ended (with its reason, if it sent one) or did not start in time.
        """
        deadline = time.monotonic() + timeout
        while self.frame()["phase"] == Phase.STARTING or not int(self.exchange.timing.peek["steps"]):
            self.require_alive()
            if time.monotonic() > deadline:
                raise LiveError(f"the physics did not begin within {timeout:g} s")
            time.sleep(0.02)

    def require_alive(self) -> None:
        """Check the physics' process.

        Raises:
            LiveError: it ended; with its reason, if it sent one.
        """
        if self.alive:
            return
        reason = ""
        # Other errors were printed by Python.
        with contextlib.suppress(EOFError, OSError):
            reason = self._pipe.recv() if self._pipe.poll() else ""
        reason = reason or f"exit code {self._process.exitcode}; its own message, if any, stands above"
        raise LiveError(f"the physics' process died: {reason}")

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
        """Send a request; its effect appears in later frames."""
        with self._lock:
            if isinstance(request, Change):
                self.choices.append(request.choice)
            # Without the physics, `alive` is False.
            with contextlib.suppress(OSError):
                self._pipe.send(request)

    def move_to(self, arm: int, target: FloatArray) -> None:
        """Set the target of a hand [m], (3,), limited to the tip's workspace plus a margin of 1 cm."""
        with self._lock:
            self._touches.pop(arm, None)
            self._targets[arm] = np.clip(target, self.instrument.lower - 0.01, self.instrument.upper + 0.01)

    def touch(self, arm: int, place: FloatArray, outward: FloatArray, depth: float) -> None:
        """Press a place of the surface at rest to a depth; a hand that presses nearby slides, others come from above.

        Args:
            arm: index of the hand.
            place: on the surface at rest [m], (3,).
            outward: unit normal of the surface there, (3,).
            depth: of the tip's ball below the surface at rest [m].
        """
        with self._lock:
            before = self._touches.get(arm)
            slides = before is not None and before.arrived and math.dist(place, before.place) < SLIDE_MOST
            self._touches[arm] = _Touch(place, outward, depth, arrived=slides)

    def lift(self, arm: int) -> None:
        """End a touch: the hand leaves along the normal."""
        with self._lock:
            if arm in self._touches:
                self._touches[arm].held = False

    def touches(self, arm: int) -> bool:
        """True until a hand is back above the place of its touch."""
        with self._lock:
            return arm in self._touches

    def park(self) -> None:
        """Set all targets to the parked positions."""
        with self._lock:
            self._touches.clear()
            self._targets[:] = self.parked

    def push(self, motion: HandMotion) -> None:
        """Move a hand by a key or a stick, until its messages stop.

        A page does not know the number of arms: with one arm, arm 1 is arm 0.
        """
        arm = motion.arm % self.arm_count
        with self._lock:
            if any(motion.axes):
                self._touches.pop(arm, None)
            self._motions[arm] = (np.array(motion.axes), self._clock())
            if motion.turns_jaw:
                self._buttons[arm] ^= JAW_BUTTON

    def close_jaw(self, closed: bool) -> None:
        """Close or open the first arm's jaw."""
        self._press(JAW_BUTTON, closed)

    @property
    def jaw_closed(self) -> bool:
        """True if the first arm's jaw is commanded to close."""
        return bool(self._buttons[0] & JAW_BUTTON)

    def hold_breath(self, held: bool) -> None:
        """Hold the patient's breath, or let it go on; it is recorded with the hand's buttons."""
        self._press(BREATH_BUTTON, held)

    @property
    def breath_held(self) -> bool:
        """True if the page holds the breath."""
        return bool(self._buttons[0] & BREATH_BUTTON)

    def close(self) -> None:
        """End the physics' process."""
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
        """Move the pushed hands, and signal life to the physics."""
        period, then = 1.0 / BEAT_RATE, self._clock()
        while not self._ended.wait(period):
            now = self._clock()
            passed, then = min(now - then, 0.1), now
            with self._lock:
                for arm, (axes, heard) in list(self._motions.items()):
                    if now - heard > HELD or not axes.any():
                        del self._motions[arm]
                        continue
                    moved = self._targets[arm] + passed * HAND_SPEED * (axes @ self.directions)
                    self._targets[arm] = np.clip(moved, self.instrument.lower, self.instrument.upper)
                for arm, touch in list(self._touches.items()):
                    self._follow(arm, touch, passed)
                self._show_hands()

    def _follow(self, arm: int, touch: _Touch, passed: float) -> None:
        """Move a hand towards its touch for a time [s]."""
        presses = touch.held and touch.arrived
        height = self.scene.instrument.tip_radius + (-touch.depth if presses else CLEARANCE)
        way = touch.place + height * touch.outward - self._targets[arm]
        length, most = float(np.linalg.norm(way)), passed * (PRESS_SPEED if touch.arrived else TOUCH_SPEED)
        moved = self._targets[arm] + way * min(1.0, most / max(length, 1e-12))
        self._targets[arm] = np.clip(moved, self.instrument.lower, self.instrument.upper)
        if length <= most and not presses:
            touch.arrived = True
            if not touch.held:
                del self._touches[arm]

    def _press(self, button: int, pressed: bool) -> None:
        """Press a button of the first arm's hand, or let it go."""
        with self._lock:
            self._buttons[0] = self._buttons[0] | button if pressed else self._buttons[0] & ~button

    def _show_hands(self) -> None:
        with self.exchange.hand.writing() as hand:
            hand["target"], hand["buttons"] = self._targets, self._buttons
            hand["beat"] += 1
