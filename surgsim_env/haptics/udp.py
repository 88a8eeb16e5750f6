"""A device behind a UDP socket on this machine, such as a client of OpenHaptics, CHAI3D or ROS."""

import ipaddress
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.haptics.device import DeviceDynamics, DevicePose, require_positive
from surgsim_env.haptics.packet import POSE, ForcePacket, PosePacket, newer, pack_force, unpack_pose

# Packets read per haptic step; the socket drops a flood of more.
PACKETS_PER_READ = 16
# Receive buffer of the socket [bytes]: a few tens of packets, so that a flood leaves no old ones.
BUFFER_SIZE = 16384


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
    """Listens on a loopback address; the sender of the first valid packet is attached.

    Each pose is answered by one force, a shorter packet; nothing else is sent. If the attached sender sends no new
    valid pose for `peer_timeout`, the next sender of one is attached, possibly the same one with new sequence numbers.
    """

    def __init__(
        self,
        port: int = 0,
        *,
        host: str = "127.0.0.1",
        dynamics: DeviceDynamics | None = None,
        peer_timeout: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Bind a socket.

        Args:
            port: 0 for a free one.
            host: a loopback address, because packets are not authenticated.
            dynamics: of the device; None if it exerts no force.
            peer_timeout: time without poses after which another sender may attach [s].
            clock: monotonic clock [s].

        Raises:
            ValueError: a host that is not a loopback address, a port or a time out of range.
            OSError: the port is taken.
        """
        require_positive("peer_timeout", peer_timeout, "s")
        if not 0 <= port <= 65535:
            raise ValueError(f"port is {port!r}; it must be from 0 to 65535, 0 for a free one")
        address = _loopback(host)
        self._dynamics, self._peer_timeout, self._clock = dynamics, peer_timeout, clock
        self._socket = socket.socket(socket.AF_INET if address.version == 4 else socket.AF_INET6, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_SIZE)
            self._socket.bind((host, port))
        except OSError:
            self._socket.close()
            raise
        self._counts = UdpCounts()
        self._peer: tuple | None = None
        self._heard = 0.0
        self._last: PosePacket | None = None
        self._unanswered = False

    @property
    def dynamics(self) -> DeviceDynamics | None:
        """Dynamics of the device."""
        return self._dynamics

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of the socket."""
        host, port = self._socket.getsockname()[:2]
        return host, port

    @property
    def peer(self) -> tuple[str, int] | None:
        """Host and port of the attached sender, or None."""
        return None if self._peer is None else (self._peer[0], self._peer[1])

    @property
    def counts(self) -> UdpCounts:
        """Numbers of packets; a copy."""
        return replace(self._counts)

    def read(self) -> DevicePose | None:
        """The newest valid pose since the last call, or None."""
        now, newest = self._clock(), None
        if self._peer is not None and now - self._heard > self._peer_timeout:
            self._peer = self._last = None
        for _ in range(PACKETS_PER_READ):
            try:
                # One byte more than a pose, to detect longer packets.
                data, sender = self._socket.recvfrom(POSE.size + 1)
            except BlockingIOError:
                break
            except OSError:
                # Some systems raise for a packet that is too long, or for a sender that has closed its socket.
                self._counts.malformed += 1
                continue
            newest = self._checked(data, sender, now) or newest
        if newest is None:
            return None
        self._unanswered = True
        return DevicePose(newest.position, now, newest.buttons, newest.rotation)

    def write(self, force: FloatArray) -> None:
        """Answer the last pose with a force [N], (3,), unless it has been answered."""
        if not self._unanswered or self._last is None or self._peer is None:
            return
        self._unanswered = False
        packet = pack_force(ForcePacket(self._last.sequence, self._last.time, force))
        try:
            self._socket.sendto(packet, self._peer)
        except OSError:
            self._counts.unsent += 1
        else:
            self._counts.answered += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _checked(self, data: bytes, sender: tuple, now: float) -> PosePacket | None:
        """The pose in a valid and new packet of the attached sender; otherwise None. Counts the packet."""
        counts = self._counts
        if self._peer is not None and sender != self._peer:
            counts.stranger += 1
            return None
        pose = unpack_pose(data)
        if pose is None:
            counts.malformed += 1
            return None
        if self._last is not None and not newer(pose.sequence, self._last.sequence):
            counts.stale += 1
            return None
        counts.accepted += 1
        self._peer, self._heard, self._last = sender, now, pose
        return pose


def _loopback(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        address = None
    if address is None or not address.is_loopback:
        raise ValueError(
            f"host is {host!r}; a UDP device listens only on a loopback address such as 127.0.0.1, because its packets "
            "are not authenticated: connect a device of another machine through a tunnel of your own"
        )
    return address
