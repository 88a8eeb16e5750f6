"""Keeping a loop to the wall clock, one haptic step after the other, and what that looked like."""

import time
from collections.abc import Callable

import numpy as np

# The last of a wait is spent looking at the clock [s]: a sleep may end later than it was asked to.
SPIN = 2e-4
# Behind by more than this the loop gives up catching up, and counts what it left out [s].
BEHIND_LARGEST = 0.02


class Pace:
    """Deadlines a haptic step apart; `wait` sleeps and then spins to the next.

    Fields:
        skipped: haptic steps of wall clock that were given up
    """

    def __init__(
        self,
        haptic_step: float,
        *,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Begin now, with steps of `haptic_step` [s]."""
        self.skipped = 0
        self._haptic_step, self._clock, self._sleep = haptic_step, clock, sleep
        self._begin = self._due = clock()
        self._late: list[float] = []

    def wait(self) -> float:
        """Wait for the next deadline; returns how late the loop comes to it [s], 0 where it had to wait."""
        self._due += self._haptic_step
        left = self._due - self._clock()
        if left > SPIN:
            self._sleep(left - SPIN)
        while (late := self._clock() - self._due) < 0.0:
            pass
        if late > BEHIND_LARGEST:
            given_up = int(late / self._haptic_step)
            self.skipped += given_up
            self._due += given_up * self._haptic_step
        self._late.append(late)
        return late

    @property
    def rate(self) -> float:
        """Steps a second of wall clock since the start [Hz]."""
        return len(self._late) / max(self._clock() - self._begin, 1e-12)

    def lateness(self, share: float) -> float:
        """How late a share of the steps came at most [s]; 1 for the latest."""
        return float(np.quantile(self._late, share)) if self._late else 0.0
