"""Open tabs: motions of keys and gamepads, how fast each browser draws, and the picture rate that follows."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

from websockets.asyncio.server import ServerConnection

from surgsim_env.live.messages import InvalidMessageError, MessageFilter, read_hand, read_report
from surgsim_env.live.session import Session

# Largest and smallest picture rate [1/s].
RATE_MOST, RATE_LEAST = 30.0, 6.0
# Frames that a browser should draw per picture; factors by which a report changes the rate.
HEADROOM, SLOWER, QUICKER = 1.15, 0.85, 1.08
# Older reports are ignored: the tab is in the background [s].
REPORT_AGE_MOST = 5.0


class PictureRate:
    """Adapts the picture rate to the slowest browser; without a report it is RATE_MOST.

    A browser that cannot keep up would draw ever older pictures, and on a machine with two processors take time from
    the physics.

    Fields:
        rate: pictures to send now [1/s]
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin with the largest rate."""
        self.rate = RATE_MOST
        self._clock = clock
        self._reports: dict[int, tuple[float, float]] = {}

    @property
    def slowest(self) -> float | None:
        """Frame rate of the slowest browser [1/s]; None without reports."""
        now = self._clock()
        recent = [rate for rate, heard in self._reports.values() if now - heard < REPORT_AGE_MOST]
        return min(recent, default=None)

    def report(self, tab: int, rate: float) -> None:
        """Process a tab's frame rate [1/s]."""
        self._reports[tab] = (rate, self._clock())
        slowest = self.slowest
        assert slowest is not None
        if rate <= slowest:
            factor = QUICKER if rate >= HEADROOM * self.rate else SLOWER
            self.rate = min(RATE_MOST, max(RATE_LEAST, factor * self.rate))

    def forget(self, tab: int) -> None:
        """Remove a closed tab."""
        self._reports.pop(tab, None)
        if self.slowest is None:
            self.rate = RATE_MOST


class HandSockets:
    """The sockets that `hand.js` opens, one per tab.

    Fields:
        rate: the picture rate
        software: whether a tab without a graphics card was opened
    """

    def __init__(self, session: Session, message_filter: MessageFilter) -> None:
        """Push a session's hands; the filter counts disconnected clients."""
        self._session, self._message_filter = session, message_filter
        self.rate = PictureRate()
        self.software = False

    async def serve(self, connection: ServerConnection) -> None:
        """Serve one tab until it is closed or sends an invalid message."""
        tab = id(connection)
        async for message in _messages(connection):
            try:
                report = read_report(message)
                if report is None:
                    self._session.push(read_hand(message, arm_count=max(2, self._session.arm_count)))
                    continue
                self.software = self.software or report.software
                if report.rate is not None:
                    self.rate.report(tab, report.rate)
            except InvalidMessageError as error:
                self._message_filter.dropped += 1
                await connection.close(1008, str(error)[:100])
        self.rate.forget(tab)


async def _messages(connection: ServerConnection) -> AsyncIterator[Any]:
    from websockets.exceptions import ConnectionClosed

    while True:
        try:
            yield await connection.recv()
        except (ConnectionClosed, asyncio.CancelledError):
            return
