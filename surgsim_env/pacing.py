"""Wall-clock time for haptic steps: when the next one is due, how late it came, and what is skipped."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Lateness and durations are counted in classes of this width [s]; the last class is for all beyond.
CLASS_WIDTH = 20e-6
CLASS_COUNT = 1001
# Before a step is due the process sleeps until this long before it [s], and then looks at the clock;
SPIN = 120e-6
# but it does not sleep where steps take more than this share of their period: a core that slept comes back slow, with
# cold caches, so that a step of the liver takes 0.71 ms and not 0.53 (2 cores of a virtual machine).
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
    """How steps follow each other.

    Args:
        period: of the steps [s].
        behind_most: a process that is later than this gives up the steps in between, and counts them [s].
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
    """Begins each step when it is due; a step that is late is made at once, and the next ones until time is met again.

    A step's lateness is how long after it was due it began. Whatever is more than `behind_most` late is not caught up:
    the steps in between are skipped, simulated time falls behind the clock by them, and `skipped` says so.
    """

    def __init__(
        self,
        settings: PaceSettings,
        timing: NDArray,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Count into a record of TIMING; the clock counts from `start`."""
        self.settings, self._timing, self._clock, self._sleep = settings, timing, clock, sleep
        self._late, self._spent = timing["late"], timing["spent"]
        self.start()

    def start(self) -> None:
        """The next step is due now: nothing is late that was not asked for."""
        self._due = self._began = self._clock()
        self._sleepy = True

    def wait(self) -> None:
        """Until the next step is due."""
        period = self.settings.period
        now = self._clock()
        left = self._due - now
        if self._sleepy and left > SPIN:
            self._sleep(left - SPIN)
        # A process that is paused makes no steps, and sleeps.
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
        """A step is made; it advanced the simulation by some time [s]."""
        spent = self._clock() - self._began
        self._sleepy = spent < SLEEP_SHARE * self.settings.period
        self._spent[min(int(spent / CLASS_WIDTH), CLASS_COUNT - 1)] += 1
        timing = self._timing
        timing["steps"] += 1
        timing["simulated"] += simulated
        timing["paced"] += self.settings.period


@dataclass(frozen=True)
class Timeliness:
    """How a stretch of steps kept time.

    Fields:
        steps, skipped: how many were made, how many were given up
        rate: steps a second of wall-clock time [1/s]
        real_time: simulated over wall-clock time
        late_p50, late_p99, late_most: how late steps began [s]
        spent_p50, spent_p99: how long they took [s]
    """

    steps: int
    skipped: int
    rate: float
    real_time: float
    late_p50: float
    late_p99: float
    late_most: float
    spent_p50: float
    spent_p99: float


def timeliness(before: NDArray, after: NDArray, wall: float) -> Timeliness:
    """Of the steps between two copies of a TIMING record that lie some wall-clock time [s] apart.

    `late_most` is since the process began where a step in between fell into the last class, else the upper end of the
    highest class that was met.
    """
    late, spent = after["late"] - before["late"], after["spent"] - before["spent"]
    steps = int(after["steps"] - before["steps"])
    return Timeliness(
        steps=steps,
        skipped=int(after["skipped"] - before["skipped"]),
        rate=steps / wall,
        real_time=float(after["simulated"] - before["simulated"]) / wall,
        late_p50=quantile(late, 0.5),
        late_p99=quantile(late, 0.99),
        late_most=float(after["late_most"]) if late[-1] else quantile(late, 1.0),
        spent_p50=quantile(spent, 0.5),
        spent_p99=quantile(spent, 0.99),
    )


def quantile(counts: NDArray[np.int64], share: float) -> float:
    """Upper end of the class below which a share of all counts lies [s]; 0 without any."""
    total = int(counts.sum())
    if total == 0:
        return 0.0
    return float(np.searchsorted(np.cumsum(counts), share * total) + 1) * CLASS_WIDTH
