"""The UDP device's packets: what they hold to the bit, and those that are dropped."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgsim_apps.haptics.udp import KIND_FORCE, KIND_POSE, MAGIC, POSITION_LARGEST, UdpDevice, newer, unpack_pose
from tests.haptics.udp_link import Sender, arrived, drained, packed

coordinate = st.floats(-POSITION_LARGEST, POSITION_LARGEST)
places = st.tuples(coordinate, coordinate, coordinate)
finite = st.floats(allow_nan=False, allow_infinity=False)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), finite, places, st.integers(0, 2**16 - 1))
def test_pose_travels_to_the_bit(sequence, sent, place, buttons):
    back = unpack_pose(packed(KIND_POSE, sequence, sent, place, buttons))
    assert back is not None
    assert (back.sequence, back.time, back.buttons) == (sequence, sent, buttons)
    np.testing.assert_array_equal(back.position, place)


def test_layout_is_the_documented_one():
    """Byte by byte as docs/haptics.md says, little-endian, for whoever writes a bridge in another language."""
    data = packed(KIND_POSE, 7, 2.5, (0.1, -0.2, 0.3), 5)
    assert len(data) == 44
    assert data[:4] == b"SSHP" and data[4] == 1 and data[5] == 1
    assert int.from_bytes(data[6:8], "little") == 5
    assert int.from_bytes(data[8:12], "little") == 7
    assert struct.unpack_from("<4d", data, 12) == (2.5, 0.1, -0.2, 0.3)


def changed(offset: int, form: str, value) -> bytes:
    data = bytearray(packed(KIND_POSE, 1, 0.0, (0.0, 0.0, 0.0)))
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
    "our own answer": packed(KIND_FORCE, 1, 0.0, (1.0, 1.0, 1.0)),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_packet_is_dropped_counted_and_not_answered(name, device, sender):
    sender.raw(HOSTILE[name])
    drained(device, 1)
    assert device.counts.malformed == 1
    assert device._peer is None
    device.write(np.ones(3))
    assert sender.silent()
    # And the port works on.
    sender.pose(1)
    assert arrived(device) is not None


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
