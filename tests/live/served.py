"""A whole session behind a page, for tests that meet it at the level of its protocol."""

import asyncio
import threading
import time
from pathlib import Path

import msgspec.msgpack
import numpy as np
import viser
from websockets.asyncio.client import connect

from surgsim_env.haptics.pacing import PaceSettings
from surgsim_env.live.page import Page
from surgsim_env.live.protocol_client import CAMERA
from surgsim_env.live.session import Session
from surgsim_env.scene.load import make_scene

# A physics at a quarter of real time leaves room on a machine where other tests run beside.
PACE = PaceSettings(period=0.004)
# How long anything may take before a test gives up [s]. Nothing that passes depends on it.
SECONDS = 600.0


class Clock:
    """Time that passes when a test says so [s]."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


class Served:
    """A page with its loop in a thread."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.hand_clock = Clock()
        self.session = Session(make_scene("phantom_small"), pace=PACE, clock=self.hand_clock)
        self.session.wait()
        self.page = Page(self.session, host="127.0.0.1", port=0, remote=False, out=out)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.page.run, args=(self._stop.is_set,))
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.page.server.stop()
        self.session.close()

    @property
    def address(self) -> str:
        return self.page.server.address

    @property
    def force(self) -> float:
        return float(np.linalg.norm(self.session.frame()["force"][0]))

    def socket(self, path="/"):
        gate = self.page.server.gate
        return connect(
            f"ws://127.0.0.1:{gate.port}/{gate.token}{path}",
            origin=f"http://127.0.0.1:{gate.port}",
            subprotocols=[f"viser-v{viser.__version__}"] if path == "/" else None,
            max_size=None,
            compression=None,
            open_timeout=SECONDS,
            ping_interval=None,
        )


def wait_until(condition, seconds=SECONDS):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not come to pass"
        time.sleep(0.02)


def setting(handle, value):
    return msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": value}})


async def send(served, *messages, until):
    """Messages of a tab that stays open until a condition holds."""
    async with served.socket() as socket:
        await socket.send(msgspec.msgpack.encode(CAMERA))
        await asyncio.wait_for(socket.recv(), SECONDS)
        for message in messages:
            await socket.send(message)
        await asyncio.to_thread(wait_until, until)
