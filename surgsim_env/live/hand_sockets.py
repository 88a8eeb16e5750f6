"""What open tabs say beside viser's messages: where keys and sticks push, and how the browser draws."""

import asyncio
from collections.abc import AsyncIterator
from typing import Any

from websockets.asyncio.server import ServerConnection

from surgsim_env.live.hand_messages import read_hand, read_report
from surgsim_env.live.picture_rate import PictureRate
from surgsim_env.live.session import Session
from surgsim_env.live.web_messages import Judge, NonsenseError


class HandSockets:
    """The sockets that `hand.js` opens, one for each tab.

    Fields:
        rate: how many pictures the browsers come to
        software: whether a tab was opened that draws without a graphics card
    """

    def __init__(self, session: Session, judge: Judge) -> None:
        """Push a session's hands; the judge counts who is sent away."""
        self._session, self._judge = session, judge
        self.rate = PictureRate()
        self.software = False

    async def serve(self, connection: ServerConnection) -> None:
        """One tab, until it is closed, or says nonsense."""
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
            except NonsenseError as error:
                self._judge.dropped += 1
                await connection.close(1008, str(error)[:100])
        self.rate.forget(tab)


async def _messages(connection: ServerConnection) -> AsyncIterator[Any]:
    from websockets.exceptions import ConnectionClosed

    while True:
        try:
            yield await connection.recv()
        except (ConnectionClosed, asyncio.CancelledError):
            return
