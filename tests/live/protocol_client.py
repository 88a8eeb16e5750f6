"""A client of the page's protocol that draws nothing: for measurements and tests."""

import asyncio
import math
import threading
import time
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

import msgspec.msgpack
import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_apps.live.stage import SCALE
from surgsim_env.scene.anatomy import Anatomy

# Period of its presses [s].
PRESS_PERIOD = 4.0

Path = Callable[[float], FloatArray]


class ProtocolClient:
    """Receives everything that a browser would, and moves the first hand 30 times a second.

    Fields:
        updates: number of message batches received
        errors: descriptions of errors
    """

    def __init__(self, address: str, path: Path | None = None, *, rate: float = 30.0, pause: float = 0.0) -> None:
        """Connect to an address that `surgsim view` printed.

        Args:
            address: token included.
            path: position of the first hand [m], (3,), over time [s]; None: it stays.
            rate: of the poses that it sends [1/s].
            pause: after each message received [s], to simulate a slow client.
        """
        parts = urlsplit(address)
        self._origin = f"{parts.scheme}://{parts.netloc}"
        self._socket = f"ws://{parts.netloc}{parts.path}"
        self._path, self._rate, self._pause = path, rate, pause
        self.updates, self.bytes = 0, 0
        self.errors: list[str] = []
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._live()), daemon=True)

    def start(self) -> None:
        """Connect, in a thread."""
        self._thread.start()

    def stop(self) -> None:
        """Disconnect."""
        self._stopping.set()
        self._thread.join(timeout=5.0)

    async def _live(self) -> None:
        import viser
        from websockets.asyncio.client import connect
        from websockets.exceptions import WebSocketException

        try:
            async with connect(
                self._socket,
                origin=self._origin,  # type: ignore[arg-type]
                subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
                max_size=None,
                compression=None,
                # A busy machine may leave it without a turn for long.
                open_timeout=None,
                ping_interval=None,
            ) as socket:
                await socket.send(msgspec.msgpack.encode(CAMERA))
                sending = asyncio.create_task(self._send(socket))
                try:
                    while not self._stopping.is_set():
                        if self._path is not None and sending.done():
                            self.errors.append(f"sending poses ended: {sending.exception()!r}")
                            return
                        try:
                            message = await asyncio.wait_for(socket.recv(), 0.2)
                        except TimeoutError:
                            continue
                        self.updates, self.bytes = self.updates + 1, self.bytes + len(message)
                        if self._pause:
                            await asyncio.to_thread(self._stopping.wait, self._pause)
                finally:
                    sending.cancel()
        except (OSError, WebSocketException) as error:
            self.errors.append(repr(error))

    async def _send(self, socket: Any) -> None:
        start = time.monotonic()
        while self._path is not None:
            await asyncio.sleep(1.0 / self._rate)
            await socket.send(hand_message(self._path(time.monotonic() - start)))


CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [0.0, 0.0, 5.0],
    "fov": 1.0,
    "near": 0.1,
    "far": 100.0,
    "image_height": 300,
    "image_width": 400,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}


def hand_message(place: FloatArray) -> bytes:
    """The message that drags the first hand's handle to a position [m], (3,)."""
    moved = {"name": "/hand/0", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": (place * SCALE).tolist(), "owner": ""}
    return msgspec.msgpack.encode({"type": "TransformControlsUpdateMessage", **moved})


def press_path(anatomy: Anatomy) -> Path:
    """Periodic presses at one point of the palpable face, to the scene's press depth."""
    scene = anatomy.scene
    point, normal = anatomy.face.random_point(np.random.default_rng(0), scene.palpation.face_margin)
    radius, depth = scene.instrument.tip_radius, scene.palpation.press_depth

    def path(time: float) -> FloatArray:
        share = 0.5 - 0.5 * math.cos(2.0 * math.pi * time / PRESS_PERIOD)
        return point + normal * (radius + 0.005 - share * (depth + 0.005))

    return path
