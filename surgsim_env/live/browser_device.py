"""The browser as a haptic device: a position in shared memory that a page sets, smoothed."""

import math

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.haptics.device import DevicePose
from surgsim_env.live.exchange_records import RecordedSteps
from surgsim_env.live.shared_record import SharedRecord

# Time constant of the smoothing [s]: a mouse reports 20 to 60 positions a second.
SMOOTHING = 0.030
# Steps without a beat (of 100 a second) after which the page's process counts as dead.
SILENT_STEPS_MOST = 20


class BrowserDevice:
    """A `HapticDevice` whose pose a web page sets; it displays forces and exerts none (`dynamics` is None).

    While the page's process is alive every step has a pose, since a hand at rest sends no messages. After 20 steps
    without a beat there is none, and the loop's watchdog fades the force.
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
        """Restart at a position [m], (3,)."""
        self._place = place.copy()
        self._steps, self._silent = 0, SILENT_STEPS_MOST

    def read(self) -> DevicePose | None:
        """The smoothed pose; None when the page's process is dead."""
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
        """Store the force, for the page to display [N], (3,)."""
        self.force = force


class RecordedHand:
    """A `HapticDevice` that replays recorded poses; after the last step it has none."""

    dynamics = None

    def __init__(self, recorded: RecordedSteps, arm: int) -> None:
        """Replay one arm of a recording from its start."""
        self._recorded, self._arm, self._next = recorded, arm, 0
        self.force = np.zeros(3)

    @property
    def done(self) -> bool:
        """Whether every step was replayed."""
        return self._next >= self._recorded.count

    def read(self) -> DevicePose | None:
        """The pose of the next step; None where the recording has none."""
        if self.done:
            return None
        step = self._recorded.steps[self._next]
        self._next += 1
        place = step["hand"][self._arm].copy()
        buttons = int(step["buttons"][self._arm])
        return DevicePose(place, float(step["time"]), buttons) if np.isfinite(place).all() else None

    def write(self, force: FloatArray) -> None:
        """Store the force, for the page to display [N], (3,)."""
        self.force = force


class Hands:
    """The device of one arm: the page's hand, or a recording during a replay."""

    dynamics = None

    def __init__(self, browser: BrowserDevice) -> None:
        """Begin with the page's hand."""
        self.browser = browser
        self.recorded: RecordedHand | None = None
        self.pose: DevicePose | None = None

    def read(self) -> DevicePose | None:
        """The pose of the active device; also stored in `pose`."""
        self.pose = (self.browser if self.recorded is None else self.recorded).read()
        return self.pose

    def write(self, force: FloatArray) -> None:
        """Pass the force to the active device [N], (3,)."""
        (self.browser if self.recorded is None else self.recorded).write(force)
