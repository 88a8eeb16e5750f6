"""A recorded trajectory: played where and when it was, to the bit from its file, and refused by row where it is bad."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgsim_apps.haptics.loop import HapticLoop
from surgsim_apps.haptics.settings import HapticSettings
from surgsim_apps.haptics.trajectory import TrajectoryDevice
from tests.haptics.bench_hand import START, save_trajectory, touching_simulation


def test_plays_linearly_between_rows_and_holds_the_last():
    device = TrajectoryDevice(np.array([5.0, 5.002, 5.003]), np.array([[0, 0, 0], [2, 0, 4], [2, 1, 4.0]]), [0, 1, 0])
    poses = [device.read() for _ in range(6)]
    np.testing.assert_allclose([pose.position for pose in poses[:4]], [[0, 0, 0], [1, 0, 2], [2, 0, 4], [2, 1, 4]])
    np.testing.assert_array_equal(poses[5].position, [2, 1, 4])
    assert [pose.buttons for pose in poses] == [0, 0, 1, 0, 0, 0]
    assert device.over
    device.rewind()
    assert not device.over
    np.testing.assert_array_equal(device.read().position, [0, 0, 0])


def test_plays_in_the_steps_of_its_loop():
    device = TrajectoryDevice(np.array([0.0, 1.0]), np.array([[0, 0, 0], [1, 0, 0.0]]), haptic_step=0.25)
    assert [device.read().position[0] for _ in range(5)] == [0.0, 0.25, 0.5, 0.75, 1.0]


@settings(deadline=None)
@given(st.lists(st.tuples(*[st.floats(-1e3, 1e3)] * 3), min_size=1, max_size=20))
def test_file_keeps_every_bit(tmp_path_factory, rows):
    path = tmp_path_factory.mktemp("way") / "way.csv"
    time, place = np.cumsum(np.full(len(rows), 0.1)), np.array(rows)
    save_trajectory(path, time, place)
    device = TrajectoryDevice.load(path)
    np.testing.assert_array_equal(device._position, place)
    np.testing.assert_array_equal(device._time, time)


def test_press_recorded_by_hand_is_felt(tmp_path):
    """A file presses 3 mm into the phantom; the tip follows, and the forces that came are kept."""
    time = np.array([0.0, 0.1, 0.6, 1.5])
    save_trajectory(tmp_path / "press.csv", time, START + np.outer([0, 0, 1, 1], [0.0, 0.0, -0.0035]))
    device = TrajectoryDevice.load(tmp_path / "press.csv")
    loop = HapticLoop(touching_simulation(), device, HapticSettings())
    while not device.over:
        telemetry = loop.step()
    assert telemetry.tip.depth == pytest.approx(2.6e-3, abs=3e-4)
    np.testing.assert_allclose(device.force, telemetry.tip.contact_force, atol=5e-3)
    assert device.force[2] > 0.1


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("time,x,y\n0,0,0\n", "'z'"),
        ("time,x,y,z\n", "rows"),
        ("time,x,y,z\n0,0,0,0\n1,0,zero,0\n", "line 3"),
        ("time,x,y,z\n0,0,0,0\n1,0,nan,0\n", "row 1"),
        ("time,x,y,z\n0,0,0,0\n1,0,0,0\n1,0,0,0\n", "row 2"),
        ("time,x,y,z,buttons\n0,0,0,0,-1\n", "line 2: .*-1"),
        ("time,x,y,z\n0,5,0,1,0,2,0,3\n", "line 2"),
    ],
)
def test_bad_file_is_refused_by_name_and_row(tmp_path, text, named):
    path = tmp_path / "way.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=rf"way\.csv.*{named}"):
        TrajectoryDevice.load(path)
