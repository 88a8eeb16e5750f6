"""Pacing of haptic steps in wall-clock time: due times, lateness, skipped steps."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Width [s] and number of the histogram classes of lateness and durations; the last class is open.
CLASS_WIDTH = 20e-6
CLASS_COUNT = 1001
# The process sleeps until this time before a due step [s], and then polls the clock.
SPIN = 120e-6
# It does not sleep if steps take more than this share of their period: a core is slow after sleeping, with cold caches
# (a step of the liver took 0.71 instead of 0.53 ms on 2 cores of a virtual machine).
SLEEP_SHARE = 0.3

TIMING = np.dtype(
    [
        ("steps", "i8"),
        ("skipped", "i8"),
        ("late", "i8", (CLASS_COUNT,)),
        ("spent", "i8", (CLASS_COUNT,)),
        ("late_most", "f8"),
        ("simulated", "f8"),
        ("paced", "f8"),
    ]
)


@dataclass(frozen=True)
class PaceSettings:
    """Configuration of the pacing.

    Args:
        period: of the steps [s].
        behind_most: largest lateness before steps are skipped and counted [s].
    """

    period: float = 0.001
    behind_most: float = 0.020

    def __post_init__(self) -> None:
        if not 0.0 < self.period <= self.behind_most < 10.0:
            raise ValueError(
                f"pace: period {self.period} s and behind_most {self.behind_most} s; the rule is 0 < period <= "
                "behind_most < 10"
            )


class Pacer:
    """Starts of steps at their due times; late steps start at once until they have caught up.

    The lateness of a step is its start less its due time. Steps more than `behind_most` late are skipped and counted in
    `skipped`; simulated time then falls behind the clock.
    """

    def __init__(
        self,
        settings: PaceSettings,
        timing: NDArray,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Count into a record of TIMING, from `start` on."""
        self.settings, self._timing, self._clock, self._sleep = settings, timing, clock, sleep
        self._late, self._spent = timing["late"], timing["spent"]
        self.start()

    def start(self) -> None:
        """Make the next step due now, without lateness."""
        self._due = self._began = self._clock()
        self._sleepy = True

    def wait(self) -> None:
        """Wait until the next step is due."""
        period = self.settings.period
        now = self._clock()
        left = self._due - now
        if self._sleepy and left > SPIN:
            self._sleep(left - SPIN)
        # A paused process makes no steps and sleeps.
        self._sleepy = True
        while now < self._due:
            now = self._clock()
        late = now - self._due
        timing = self._timing
        if late > self.settings.behind_most:
            missed = int(late / period)
            timing["skipped"] += missed
            self._due += missed * period
        self._late[min(int(late / CLASS_WIDTH), CLASS_COUNT - 1)] += 1
        if late > timing["late_most"]:
            timing["late_most"] = late
        self._began = now
        self._due += period

    def done(self, simulated: float) -> None:
        """Count a finished step of `simulated` [s] of the simulation."""
        spent = self._clock() - self._began
        self._sleepy = spent < SLEEP_SHARE * self.settings.period
        self._spent[min(int(spent / CLASS_WIDTH), CLASS_COUNT - 1)] += 1
        timing = self._timing
        timing["steps"] += 1
        timing["simulated"] += simulated
        timing["paced"] += self.settings.period


@dataclass(frozen=True)
class Timeliness:
    """Timing of an interval of steps.

    Fields:
        skipped: number of steps skipped
        rate: steps per wall-clock time [1/s]
        real_time: simulated over wall-clock time
        late_p50, late_p99, late_most: median, 99 % quantile and largest lateness [s]
        spent_p50: median of the steps' duration [s]
    """

    skipped: int
    rate: float
    real_time: float
    late_p50: float
    late_p99: float
    late_most: float
    spent_p50: float


def timeliness(before: NDArray, after: NDArray, wall: float) -> Timeliness:
    """Timing between two copies of a TIMING record, `wall` [s] of wall-clock time apart.

    `late_most` is the upper end of the highest class with a step, or, for the open class, the largest lateness since
    the process started.
    """
    late, spent = after["late"] - before["late"], after["spent"] - before["spent"]
    return Timeliness(
        skipped=int(after["skipped"] - before["skipped"]),
        rate=float(after["steps"] - before["steps"]) / wall,
        real_time=float(after["simulated"] - before["simulated"]) / wall,
        late_p50=quantile(late, 0.5),
        late_p99=quantile(late, 0.99),
        late_most=float(after["late_most"]) if late[-1] else quantile(late, 1.0),
        spent_p50=quantile(spent, 0.5),
    )


def quantile(counts: NDArray[np.int64], share: float) -> float:
    """Upper end of the class of a quantile [s]; 0 without counts."""
    total = int(counts.sum())
    if total == 0:
        return 0.0
    return float(np.searchsorted(np.cumsum(counts), share * total) + 1) * CLASS_WIDTH
