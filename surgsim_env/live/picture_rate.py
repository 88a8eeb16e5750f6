"""How many pictures a second are made: no more than the slowest browser that looks comes to."""

import time
from collections.abc import Callable

# Pictures a second, at most and at least.
RATE_MOST, RATE_LEAST = 30.0, 6.0
# A browser shall come to so many frames for each picture; each report changes the rate by these factors.
HEADROOM, SLOWER, QUICKER = 1.15, 0.85, 1.08
# Reports older than this are of tabs that sleep [s].
REPORT_AGE_MOST = 5.0


class PictureRate:
    """Follows what browsers report; without a report it is RATE_MOST.

    A browser that cannot keep up would work off ever older pictures, and on a machine of two processors take the
    physics' share of them.

    Fields:
        rate: pictures a second to make now
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin with the largest rate."""
        self.rate = RATE_MOST
        self._clock = clock
        self._reports: dict[int, tuple[float, float]] = {}

    @property
    def slowest(self) -> float | None:
        """Frames a second of the slowest browser; None where none reports."""
        now = self._clock()
        recent = [rate for rate, heard in self._reports.values() if now - heard < REPORT_AGE_MOST]
        return min(recent, default=None)

    def report(self, tab: int, rate: float) -> None:
        """Take in what a tab comes to [frames/s]."""
        self._reports[tab] = (rate, self._clock())
        slowest = self.slowest
        assert slowest is not None
        if rate <= slowest:
            factor = QUICKER if rate >= HEADROOM * self.rate else SLOWER
            self.rate = min(RATE_MOST, max(RATE_LEAST, factor * self.rate))

    def forget(self, tab: int) -> None:
        """A tab was closed."""
        self._reports.pop(tab, None)
        if self.slowest is None:
            self.rate = RATE_MOST
