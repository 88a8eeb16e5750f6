"""The UDP device: its packets, its one peer, and whatever else comes to an open port."""

import math
import socket
import struct
import time

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from surgsim_env.haptics.loop import HapticLoop
from surgsim_env.haptics.packet import (
    FORCE,
    MAGIC,
    POSE,
    POSITION_LARGEST,
    ForcePacket,
    PosePacket,
    newer,
    pack_force,
    pack_pose,
    unpack_force,
    unpack_pose,
)
from surgsim_env.haptics.settings import HapticSettings
from surgsim_env.haptics.telemetry import TipTelemetry
from surgsim_env.haptics.udp import PACKETS_PER_READ, UdpDevice
from surgsim_env.haptics.watchdog import WatchdogTimes
from tests.haptics.bench_hand import touching_simulation

coordinate = st.floats(-POSITION_LARGEST, POSITION_LARGEST)
places = st.tuples(coordinate, coordinate, coordinate)
finite = st.floats(allow_nan=False, allow_infinity=False)


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


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def device(clock):
    made = UdpDevice(clock=clock)
    yield made
    made.close()


@pytest.fixture
def sender(device):
    made = Sender(device)
    yield made
    made.socket.close()


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


# ---- packets ----------------------------------------------------------------------------------------------------


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), finite, places, st.integers(0, 2**16 - 1))
def test_pose_travels_to_the_bit(sequence, sent, place, buttons):
    data = pack_pose(PosePacket(sequence, sent, np.array(place), buttons))
    back = unpack_pose(data)
    assert back is not None
    assert (back.sequence, back.time, back.buttons, back.rotation) == (sequence, sent, buttons, None)
    np.testing.assert_array_equal(back.position, place)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), finite, st.tuples(finite, finite, finite))
def test_force_travels_to_the_bit(sequence, sent, force):
    back = unpack_force(pack_force(ForcePacket(sequence, sent, np.array(force))))
    assert back is not None
    assert (back.sequence, back.time) == (sequence, sent)
    np.testing.assert_array_equal(back.force, force)


def test_layout_is_the_documented_one():
    """Byte by byte as docs/haptics.md says, little-endian, for whoever writes a bridge in another language."""
    data = pack_pose(PosePacket(7, 2.5, np.array((0.1, -0.2, 0.3)), 5, np.array((0.6, 0.0, 0.8, 0.0))))
    assert len(data) == 76
    assert data[:4] == b"SSHP" and data[4] == 1 and data[5] == 1
    assert int.from_bytes(data[6:8], "little") == 5
    assert int.from_bytes(data[8:12], "little") == 7
    assert struct.unpack_from("<8d", data, 12) == (2.5, 0.1, -0.2, 0.3, 0.6, 0.0, 0.8, 0.0)
    answer = pack_force(ForcePacket(7, 2.5, np.array((1.0, 2.0, 3.0))))
    assert len(answer) == 44
    assert answer[:4] == b"SSHP" and answer[4] == 1 and answer[5] == 2 and answer[6:8] == b"\0\0"
    assert int.from_bytes(answer[8:12], "little") == 7
    assert struct.unpack_from("<4d", answer, 12) == (2.5, 1.0, 2.0, 3.0)


def changed(offset: int, form: str, value) -> bytes:
    data = bytearray(pack_pose(PosePacket(1, 0.0, np.zeros(3), 0, np.array((1.0, 0.0, 0.0, 0.0)))))
    struct.pack_into(form, data, offset, value)
    return bytes(data)


HOSTILE = {
    "empty": b"",
    "short": changed(0, "<4s", MAGIC)[:-1],
    "long": changed(0, "<4s", MAGIC) + b"\0",
    "very long": changed(0, "<4s", MAGIC) + bytes(60_000),
    "magic": changed(0, "<4s", b"SSHQ"),
    "version": changed(4, "<B", 2),
    "kind of a force": changed(5, "<B", 2),
    "time not a number": changed(12, "<d", math.nan),
    "time without end": changed(12, "<d", math.inf),
    "place not a number": changed(20, "<d", math.nan),
    "place without end": changed(28, "<d", -math.inf),
    "place far away": changed(36, "<d", 10.001),
    "place very far away": changed(36, "<d", 1e308),
    "rotation not a number": changed(44, "<d", math.nan),
    "rotation without end": changed(44, "<d", math.inf),
    "rotation too short": changed(44, "<d", 0.99),
    "rotation too long": changed(52, "<d", 1e200),
    "our own answer": pack_force(ForcePacket(1, 0.0, np.ones(3))),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_packet_is_dropped_counted_and_not_answered(name, device, sender):
    sender.raw(HOSTILE[name])
    drained(device, 1)
    assert device.counts.malformed == 1
    assert device.peer is None
    device.write(np.ones(3))
    assert sender.silent()
    # And the port works on.
    sender.pose(1)
    assert arrived(device) is not None


@settings(deadline=None)
@given(st.binary(max_size=200))
def test_bytes_are_no_pose_or_a_good_one(data):
    pose = unpack_pose(data)
    if pose is not None:
        assert np.abs(pose.position).max() <= POSITION_LARGEST and math.isfinite(pose.time)
    answer = unpack_force(data)
    if answer is not None:
        assert np.isfinite(answer.force).all()


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=300)
@given(st.binary(min_size=POSE.size - 12, max_size=POSE.size - 12), st.integers(0, 2**16 - 1))
def test_bytes_behind_a_good_header_are_no_pose_or_a_good_one(body, buttons):
    data = MAGIC + bytes((1, 1)) + buttons.to_bytes(2, "little") + bytes(4) + body
    pose = unpack_pose(data)
    if pose is not None:
        assert np.abs(pose.position).max() <= POSITION_LARGEST and math.isfinite(pose.time)
        assert pose.rotation is None or abs(np.linalg.norm(pose.rotation) - 1.0) <= 2e-3


@settings(deadline=None, max_examples=40)
@given(st.lists(st.one_of(st.binary(max_size=100), st.sampled_from(list(HOSTILE.values()))), max_size=30))
def test_device_survives_any_packets(packets):
    """Whatever comes, `read` returns a good pose or none, and the next good pose is read."""
    device = UdpDevice()
    sender = Sender(device)
    try:
        for data in packets:
            sender.raw(data)
            device.read()
            device.write(np.zeros(3))
        sender.pose(2**31)
        pose = arrived(device)
        assert pose is not None and np.isfinite(pose.position).all()
    finally:
        device.close()
        sender.socket.close()


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 2**31 - 1))
def test_sequence_goes_round(last, ahead):
    after = (last + ahead) % 2**32
    assert newer(after, last)
    assert not newer(last, after)
    assert not newer(last, last)


# ---- the link ---------------------------------------------------------------------------------------------------


def test_pose_is_read_and_answered_once(device, sender):
    sender.pose(3, (0.01, 0.02, 0.03), buttons=2, rotation=np.array((0.0, 1.0, 0.0, 0.0)))
    pose = arrived(device)
    assert pose is not None and pose.buttons == 2 and pose.time == 100.0
    np.testing.assert_array_equal(pose.position, (0.01, 0.02, 0.03))
    np.testing.assert_array_equal(pose.rotation, (0.0, 1.0, 0.0, 0.0))
    device.write(np.array((0.5, -0.5, 1.0)))
    answer = unpack_force(sender.answer())
    assert answer is not None and answer.sequence == 3 and answer.time == 1.5
    np.testing.assert_array_equal(answer.force, (0.5, -0.5, 1.0))
    # Nothing new was read: no second answer.
    assert device.read() is None
    device.write(np.ones(3))
    assert sender.silent()
    assert device.counts.answered == 1


def test_answer_is_never_longer_than_the_request():
    assert FORCE.size <= POSE.size


def test_newest_pose_wins_and_one_answer_goes_out(device, sender):
    for sequence in range(1, 6):
        sender.pose(sequence, (0.001 * sequence, 0.0, 0.0))
    time.sleep(0.05)
    pose = arrived(device)
    assert pose is not None and pose.position[0] == 0.005
    device.write(np.zeros(3))
    assert len(sender.answer()) == FORCE.size
    assert sender.silent()


def test_old_doubled_and_reordered_packets_are_dropped(device, sender):
    for sequence in (10, 10, 9, 12, 11, 2**31 + 12):
        sender.pose(sequence)
    drained(device, 6)
    counts = device.counts
    assert (counts.accepted, counts.stale) == (2, 4)


def test_second_sender_is_a_stranger_until_the_first_is_silent(device, sender, clock):
    other = Sender(device)
    sender.pose(1, (0.001, 0.0, 0.0))
    assert arrived(device) is not None
    first = device.peer
    other.pose(500, (0.5, 0.5, 0.5))
    drained(device, 2)
    assert device.counts.stranger == 1 and device.peer == first
    device.write(np.zeros(3))
    assert len(sender.answer()) == FORCE.size
    assert other.silent()
    clock.now += 0.99
    other.pose(501)
    drained(device, 3)
    assert device.counts.stranger == 2
    clock.now += 0.02
    other.pose(5)
    assert arrived(device) is not None
    assert device.peer != first
    device.write(np.zeros(3))
    assert len(other.answer()) == FORCE.size
    other.socket.close()


def test_garbage_and_old_poses_do_not_keep_a_silent_peer_attached(device, sender, clock):
    sender.pose(10)
    assert arrived(device) is not None
    for number in range(12):
        clock.now += 0.1
        sender.raw(b"garbage")
        sender.pose(10)
        drained(device, 1 + 2 * (number + 1))
        if device.peer is None or device.counts.accepted == 2:
            break
    # The same one, numbering anew, counts as a new one after its second of silence.
    assert device.counts.accepted == 2


def test_reading_never_waits_and_a_flood_is_bounded(device, sender):
    begin = time.perf_counter()
    for _ in range(200):
        assert device.read() is None
    assert time.perf_counter() - begin < 0.5
    for _ in range(400):
        sender.raw(b"flood")
    device.read()
    counts = device.counts
    assert counts.malformed <= PACKETS_PER_READ


def test_loop_rides_on_a_flood(device, sender):
    """Garbage from another port while a bridge sends poses: the force still comes, nothing faults."""
    loop = HapticLoop(touching_simulation(), device)
    other = Sender(device)
    for step in range(60):
        for _ in range(3):
            other.raw(b"x" * (step + 1))
        sender.pose(step + 1, (0.0, 0.0, -1e-5 * step))
        told = loop.step()
    assert not told.fault
    counts = device.counts
    assert counts.accepted > 30 and counts.answered > 30
    other.socket.close()


def test_bridge_that_stops_sending_loses_its_force(device, sender):
    """The whole chain: packets stop, after 50 ms the force fades to zero in 100 ms; packets come, it comes back."""
    watchdog = WatchdogTimes(resume=0.02)
    settings = HapticSettings(watchdog=watchdog, relative=True, smoothing=0.0, approach_speed=0.5)
    loop = HapticLoop(touching_simulation(), device, settings)

    def steps(first: int, count: int, height: float) -> TipTelemetry:
        for sequence in range(first, first + count):
            sender.pose(sequence, (0.0, 0.0, height))
            told = loop.step()
        return told.tip

    # The first pose means where the tip is; then 3 mm down.
    steps(1, 1, 0.5)
    before = steps(2, 300, 0.497)
    assert before.force[2] > 0.1 and not before.faded
    silent = [loop.step().tip for _ in range(160)]
    assert not silent[45].faded and silent[60].faded
    np.testing.assert_array_equal(silent[-1].force, 0.0)
    assert silent[-1].contact_force[2] > 0.1
    back = steps(302, 100, 0.497)
    np.testing.assert_allclose(back.force, before.force, atol=0.01)


def test_peer_that_has_gone_is_no_fault(device, sender):
    """A closed port's refusal (ICMP) comes back as an error of the socket on some systems."""
    sender.pose(1)
    assert arrived(device) is not None
    sender.socket.close()
    for _ in range(5):
        device.write(np.zeros(3))
        device._unanswered = True
        assert device.read() is None


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.7", "::", "example.org", ""])
def test_other_hosts_than_loopback_are_refused(host):
    with pytest.raises(ValueError, match=r"loopback address such as 127\.0\.0\.1 alone"):
        UdpDevice(host=host)


@pytest.mark.parametrize(("given_", "words"), [({"port": 70000}, "port is 70000"), ({"peer_timeout": 0.0}, "timeout")])
def test_bad_settings_are_refused(given_, words):
    with pytest.raises(ValueError, match=words):
        UdpDevice(**given_)


def test_taken_port_says_so(device):
    with pytest.raises(OSError, match=r"[Aa]ddress already in use"):
        UdpDevice(device.address[1])
