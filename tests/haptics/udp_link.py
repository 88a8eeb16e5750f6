"""A bridge's end of the UDP device, and a clock that tests set."""

import socket
import time

import numpy as np

from surgsim_env.haptics.packet import PosePacket, pack_pose
from surgsim_env.haptics.udp import UdpDevice


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Sender:
    """A bridge's socket; waits a moment for answers, as loopback is quick and not at once."""

    def __init__(self, device: UdpDevice):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.connect(device.address)
        self.socket.settimeout(0.5)

    def pose(self, sequence: int, place=(0.0, 0.0, 0.0), **rest) -> None:
        self.raw(pack_pose(PosePacket(sequence, 1.5, np.array(place), **rest)))

    def raw(self, data: bytes) -> None:
        self.socket.send(data)

    def answer(self) -> bytes:
        return self.socket.recv(2000)

    def silent(self) -> bool:
        self.socket.settimeout(0.02)
        try:
            self.socket.recv(2000)
        except TimeoutError:
            return True
        finally:
            self.socket.settimeout(0.5)
        return False


def arrived(device: UdpDevice):
    """What comes within half a second; loopback delivers at once, or nothing at all."""
    for _ in range(500):
        if (pose := device.read()) is not None:
            return pose
        time.sleep(1e-3)
    return None


def drained(device: UdpDevice, packets: int) -> None:
    """Read until so many packets have been looked at."""
    for _ in range(500):
        device.read()
        counts = device.counts
        if counts.accepted + counts.malformed + counts.stale + counts.stranger >= packets:
            return
        time.sleep(1e-3)
    raise AssertionError(f"{counts} of {packets} packets came")
