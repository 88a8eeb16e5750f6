"""A bridge's end of the UDP device, and a clock that tests set."""

import socket
import threading
import time

from surgsim_apps.haptics.udp import KIND_FORCE, KIND_POSE, MAGIC, PACKET, VERSION, UdpDevice

# How long anything may take before a test gives up [s]. Nothing that passes depends on it.
SECONDS = 600.0


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class SharedTime:
    """A clock for two threads: when both sleep, it moves on to where the first of them wakes; for one that is left."""

    def __init__(self) -> None:
        self._now, self._awake, self._wakes = 100.0, 2, []
        self._changed = threading.Condition()

    def monotonic(self) -> float:
        return self._now

    def sleep(self, span: float) -> None:
        with self._changed:
            wake = self._now + span
            self._wakes.append(wake)
            self._awake -= 1
            self._move_on()
            self._changed.wait_for(lambda: self._now >= wake)

    def leave(self) -> None:
        """A thread sleeps no more."""
        with self._changed:
            self._awake -= 1
            self._move_on()

    def _move_on(self) -> None:
        if self._awake == 0 and self._wakes:
            self._now = min(self._wakes)
            self._awake += self._wakes.count(self._now)
            self._wakes = [wake for wake in self._wakes if wake > self._now]
            self._changed.notify_all()


def packed(kind: int, sequence: int, sent: float, vector, buttons: int = 0) -> bytes:
    """A pose or a force as it travels."""
    return PACKET.pack(MAGIC, VERSION, kind, buttons, sequence, sent, *vector)


def force_of(answer: bytes) -> tuple[int, float, tuple]:
    """Sequence, time and force of an answer."""
    magic, version, kind, zero, sequence, sent, *force = PACKET.unpack(answer)
    assert (magic, version, kind, zero) == (MAGIC, VERSION, KIND_FORCE, 0)
    return sequence, sent, tuple(force)


class Sender:
    """A bridge's socket; loopback delivers at once, so that an answer is there when the device has written it."""

    def __init__(self, device: UdpDevice):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.connect(device.address)
        self.socket.settimeout(SECONDS)

    def pose(self, sequence: int, place=(0.0, 0.0, 0.0), buttons: int = 0) -> None:
        self.raw(packed(KIND_POSE, sequence, 1.5, place, buttons))

    def raw(self, data: bytes) -> None:
        self.socket.send(data)

    def answer(self) -> bytes:
        return self.socket.recv(2000)

    def silent(self) -> bool:
        self.socket.setblocking(False)
        try:
            self.socket.recv(2000)
        except BlockingIOError:
            return True
        finally:
            self.socket.settimeout(SECONDS)
        return False


def arrived(device: UdpDevice):
    """The pose that comes."""
    deadline = time.monotonic() + SECONDS
    while (pose := device.read()) is None:
        assert time.monotonic() < deadline, "no pose comes"
        time.sleep(1e-3)
    return pose


def drained(device: UdpDevice, packets: int) -> None:
    """Read until so many packets have been looked at."""
    deadline = time.monotonic() + SECONDS
    while True:
        device.read()
        counts = device.counts
        if counts.accepted + counts.malformed + counts.stale + counts.stranger >= packets:
            return
        assert time.monotonic() < deadline, f"{counts} of {packets} packets came"
        time.sleep(1e-3)
