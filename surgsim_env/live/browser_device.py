"""The browser as a haptic device: a place in shared memory that a page moves, followed smoothly."""

import math

import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.haptics.device import DevicePose
from surgsim_env.live.exchange_records import RecordedSteps
from surgsim_env.live.shared_record import SharedRecord

# A mouse says where it is 20 to 60 times a second: its place is followed with this time constant [s].
SMOOTHING = 0.030
# The page's process beats 100 times a second; silent for so many steps it is taken for dead.
SILENT_STEPS_MOST = 20


class BrowserDevice:
    """A `HapticDevice` whose pose a web page sets; it shows forces and pushes nobody (`dynamics` is None).

    A pose is fresh in every step for as long as the page's process lives: a hand that holds still says nothing. Without
    a beat for 20 steps there is none, and the loop's watchdog lets the force fade.
    """

    dynamics = None

    def __init__(self, hand: SharedRecord, arm: int, step: float, place: FloatArray) -> None:
        """Follow one arm's target in steps [s], from where its tip is [m]."""
        self._hand, self._arm, self._step_time = hand, arm, step
        self._share = 1.0 - math.exp(-step / SMOOTHING)
        self._beat, self._buttons = -1, 0
        self.force = np.zeros(3)
        self.restart(place)

    def restart(self, place: FloatArray) -> None:
        """Begin at a place [m]."""
        self._place = place.copy()
        self._steps, self._silent = 0, SILENT_STEPS_MOST

    def read(self) -> DevicePose | None:
        """The smoothed place, while the page lives."""
        self._steps += 1
        record = self._hand.glance()
        if record is None or int(record["beat"]) == self._beat:
            self._silent += 1
        else:
            self._beat, self._silent = int(record["beat"]), 0
            self._target, self._buttons = record["target"][self._arm].copy(), int(record["buttons"][self._arm])
        if self._silent >= SILENT_STEPS_MOST:
            return None
        self._place = self._place + self._share * (self._target - self._place)
        return DevicePose(self._place, self._steps * self._step_time, self._buttons)

    def write(self, force: FloatArray) -> None:
        """Keep the force for the page to show [N], (3,)."""
        self.force = force


class RecordedHand:
    """A `HapticDevice` that moves as one did while it was recorded; after the last step there is no pose."""

    dynamics = None

    def __init__(self, recorded: RecordedSteps, arm: int) -> None:
        """Play one arm of a recording from its beginning."""
        self._recorded, self._arm, self._next = recorded, arm, 0
        self.force = np.zeros(3)

    @property
    def done(self) -> bool:
        """Whether every step was played."""
        return self._next >= self._recorded.count

    def read(self) -> DevicePose | None:
        """The place of the next step; None where the recording had none."""
        if self.done:
            return None
        step = self._recorded.steps[self._next]
        self._next += 1
        place = step["hand"][self._arm].copy()
        buttons = int(step["buttons"][self._arm])
        return DevicePose(place, float(step["time"]), buttons) if np.isfinite(place).all() else None

    def write(self, force: FloatArray) -> None:
        """Keep the force for the page to show [N], (3,)."""
        self.force = force


class Hands:
    """What an arm is moved by: the page, or a recording while it is played; always the same device to its loop."""

    dynamics = None

    def __init__(self, browser: BrowserDevice) -> None:
        """Begin with the page's hand."""
        self.browser = browser
        self.recorded: RecordedHand | None = None
        self.pose: DevicePose | None = None

    def read(self) -> DevicePose | None:
        """The pose of whoever moves the arm; kept in `pose`."""
        self.pose = (self.browser if self.recorded is None else self.recorded).read()
        return self.pose

    def write(self, force: FloatArray) -> None:
        """To whoever moves the arm."""
        (self.browser if self.recorded is None else self.recorded).write(force)
