"""The UDP device: its answers, its one peer, and what a loop makes of a bridge that floods or stops."""

import numpy as np

from surgsim_apps.haptics.loop import HapticLoop, TipTelemetry
from surgsim_apps.haptics.settings import HapticSettings
from surgsim_apps.haptics.udp import PACKET, PACKETS_PER_READ
from tests.haptics.bench_hand import touching_simulation
from tests.haptics.udp_link import Sender, arrived, drained, force_of


def test_pose_is_read_and_answered_once(device, sender):
    sender.pose(3, (0.01, 0.02, 0.03), buttons=2)
    pose = arrived(device)
    assert pose is not None and pose.buttons == 2 and pose.time == 100.0
    np.testing.assert_array_equal(pose.position, (0.01, 0.02, 0.03))
    device.write(np.array((0.5, -0.5, 1.0)))
    assert force_of(sender.answer()) == (3, 1.5, (0.5, -0.5, 1.0))
    # Nothing new was read: no second answer.
    assert device.read() is None
    device.write(np.ones(3))
    assert sender.silent()
    assert device.counts.answered == 1


def test_newest_pose_wins_and_one_answer_goes_out(device, sender):
    for sequence in range(1, 6):
        sender.pose(sequence, (0.001 * sequence, 0.0, 0.0))
    pose = arrived(device)
    assert pose is not None and pose.position[0] == 0.005
    device.write(np.zeros(3))
    assert len(sender.answer()) == PACKET.size
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
    first = device._peer
    other.pose(500, (0.5, 0.5, 0.5))
    drained(device, 2)
    assert device.counts.stranger == 1 and device._peer == first
    device.write(np.zeros(3))
    assert len(sender.answer()) == PACKET.size
    assert other.silent()
    clock.now += 0.99
    other.pose(501)
    drained(device, 3)
    assert device.counts.stranger == 2
    clock.now += 0.02
    other.pose(5)
    assert arrived(device) is not None
    assert device._peer != first
    device.write(np.zeros(3))
    assert len(other.answer()) == PACKET.size
    other.socket.close()


def test_garbage_and_old_poses_do_not_keep_a_silent_peer_attached(device, sender, clock):
    sender.pose(10)
    assert arrived(device) is not None
    for number in range(12):
        clock.now += 0.1
        sender.raw(b"garbage")
        sender.pose(10)
        drained(device, 1 + 2 * (number + 1))
        if device._peer is None or device.counts.accepted == 2:
            break
    # The same one, numbering anew, counts as a new one after its second of silence.
    assert device.counts.accepted == 2


def test_reading_never_waits_and_a_flood_is_bounded(device, sender):
    assert device._socket.gettimeout() == 0.0
    for _ in range(200):
        assert device.read() is None
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
        telemetry = loop.step()
    assert not telemetry.fault
    counts = device.counts
    assert counts.accepted > 30 and counts.answered > 30
    other.socket.close()


def test_bridge_that_stops_sending_loses_its_force(device, sender):
    """The whole chain: packets stop, after 50 ms the force fades to zero in 100 ms; packets come, it comes back."""
    settings = HapticSettings(resume=0.02, relative=True, smoothing=0.0, approach_speed=0.5)
    loop = HapticLoop(touching_simulation(), device, settings)

    def steps(first: int, count: int, height: float) -> TipTelemetry:
        for sequence in range(first, first + count):
            sender.pose(sequence, (0.0, 0.0, height))
            telemetry = loop.step()
        return telemetry.tip

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
