"""A device behind a UDP socket on this machine, such as a client of OpenHaptics, CHAI3D or ROS (docs/haptics.md)."""

import math
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_apps.haptics.device import DeviceDynamics, DevicePose

# UDP port of the simulation, in no list of IANA.
PORT = 47801
MAGIC = b"SSHP"
VERSION = 1
KIND_POSE, KIND_FORCE = 1, 2
# Little-endian, without gaps. Magic, version, kind, buttons (0 of a force), sequence, time (of a force those of its
# pose); position or force.
PACKET = struct.Struct("<4sBBHId3d")

# Positions farther from the device's origin are refused [m].
POSITION_LARGEST = 10.0
# Time without poses until another sender may attach [s].
PEER_TIMEOUT = 1.0
# Packets read per haptic step; the socket drops a flood of more.
PACKETS_PER_READ = 16
# Receive buffer of the socket [bytes]: a few tens of packets; a flood leaves no old ones.
BUFFER_SIZE = 16384


class PosePacket(NamedTuple):
    """A pose.

    Fields:
        sequence: increases with each packet, modulo 2^32
        time: on the sender's clock [s]; the answer repeats it
        position: [m], (3,)
        buttons: one bit each, 16 of them
    """

    sequence: int
    time: float
    position: FloatArray
    buttons: int = 0


def unpack_pose(data: bytes) -> PosePacket | None:
    """A pose of exactly 44 well-formed bytes; None for anything else."""
    if len(data) != PACKET.size:
        return None
    magic, version, kind, buttons, sequence, time, x, y, z = PACKET.unpack(data)
    if magic != MAGIC or version != VERSION or kind != KIND_POSE or not math.isfinite(time):
        return None
    # No comparison with a NaN holds.
    if not all(abs(value) <= POSITION_LARGEST for value in (x, y, z)):
        return None
    return PosePacket(sequence, time, np.array((x, y, z)), buttons)


def newer(sequence: int, last: int) -> bool:
    """True if a sequence number comes after another, modulo 2^32 (RFC 1982)."""
    return 0 < (sequence - last) % 2**32 < 2**31


@dataclass(slots=True)
class UdpCounts:
    """Numbers of packets.

    Args:
        accepted: new poses.
        malformed: wrong length, magic, version or kind, or a number out of range.
        stale: old, duplicated or out of order.
        stranger: from another sender than the attached one.
        answered: forces sent.
        unsent: forces that the socket refused.
    """

    accepted: int = 0
    malformed: int = 0
    stale: int = 0
    stranger: int = 0
    answered: int = 0
    unsent: int = 0


class UdpDevice:
    """A device on 127.0.0.1, as packets are not authenticated; the sender of the first valid packet is attached.

    Each pose is answered by one force, a packet of the same size; nothing else is sent. If the attached sender sends no
    new valid pose for PEER_TIMEOUT, the next valid pose attaches its sender, maybe the same with new sequence numbers.

    Fields:
        counts: numbers of packets so far
        dynamics: of the device; None if it exerts no force
    """

    def __init__(
        self,
        port: int = 0,
        *,
        dynamics: DeviceDynamics | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Bind a socket.

        Args:
            port: 0 for a free one.
            dynamics: of the device; None if it exerts no force.
            clock: monotonic clock [s].

        Raises:
            ValueError: a port out of range.
            OSError: the port is taken.
        """
        if not 0 <= port <= 65535:
            raise ValueError(f"port is {port!r}; it must be from 0 to 65535, 0 for a free one")
        self.dynamics, self._clock = dynamics, clock
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_SIZE)
            self._socket.bind(("127.0.0.1", port))
        except OSError:
            self._socket.close()
            raise
        self.counts = UdpCounts()
        self._peer: tuple | None = None
        self._heard = 0.0
        self._last: PosePacket | None = None
        self._unanswered = False

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of the socket."""
        return self._socket.getsockname()[:2]

    def read(self) -> DevicePose | None:
        """The newest valid pose since the last call, or None."""
        now, newest = self._clock(), None
        if self._peer is not None and now - self._heard > PEER_TIMEOUT:
            self._peer = self._last = None
        for _ in range(PACKETS_PER_READ):
            try:
                # One byte more than a pose, to detect longer packets.
                data, sender = self._socket.recvfrom(PACKET.size + 1)
            except BlockingIOError:
                break
            except OSError:
                # Some systems raise for a packet that is too long, or for a sender that has closed its socket.
                self.counts.malformed += 1
                continue
            newest = self._checked(data, sender, now) or newest
        if newest is None:
            return None
        self._unanswered = True
        return DevicePose(newest.position, now, newest.buttons)

    def write(self, force: FloatArray) -> None:
        """Answer the last pose with a force [N], (3,), unless it has been answered."""
        if not self._unanswered or self._last is None or self._peer is None:
            return
        self._unanswered = False
        packet = PACKET.pack(MAGIC, VERSION, KIND_FORCE, 0, self._last.sequence, self._last.time, *force.tolist())
        try:
            self._socket.sendto(packet, self._peer)
        except OSError:
            self.counts.unsent += 1
        else:
            self.counts.answered += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _checked(self, data: bytes, sender: tuple, now: float) -> PosePacket | None:
        """The pose in a valid and new packet of the attached sender; otherwise None. Counts the packet."""
        if self._peer is not None and sender != self._peer:
            self.counts.stranger += 1
            return None
        pose = unpack_pose(data)
        if pose is None:
            self.counts.malformed += 1
            return None
        if self._last is not None and not newer(pose.sequence, self._last.sequence):
            self.counts.stale += 1
            return None
        self.counts.accepted += 1
        self._peer, self._heard, self._last = sender, now, pose
        return pose
