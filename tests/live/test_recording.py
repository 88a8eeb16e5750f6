"""Recordings: what is written can be read again, played by the haptic package, and never elsewhere than told."""

import numpy as np
import pytest

from surgsim_env.haptics.trajectory import TrajectoryDevice
from surgsim_env.live.exchange_records import recording_type
from surgsim_env.live.recording import read_recording, write_recording

STEP = 1e-3


def made_steps(arm_count=1, count=50):
    rng = np.random.default_rng(1)
    steps = np.zeros(count, dtype=recording_type(arm_count))
    steps["time"] = 1e-3 * np.arange(1, count + 1)
    for name in ("hand", "tip", "force"):
        steps[name] = rng.normal(size=(count, arm_count, 3))
    steps["buttons"] = rng.integers(0, 2, size=(count, arm_count))
    return steps


@pytest.mark.parametrize("arm_count", [1, 2])
def test_what_is_written_is_read(tmp_path, arm_count):
    steps = made_steps(arm_count)
    assert "recording-1.csv" in write_recording(steps, tmp_path / "new")
    assert "recording-2.csv" in write_recording(steps, tmp_path / "new")
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["recording-1.csv", "recording-2.csv"]
    read = read_recording(tmp_path / "new" / "recording-1.csv", arm_count, STEP)
    for name in ("time", "hand", "buttons"):
        np.testing.assert_allclose(read[name], steps[name], rtol=1e-8)


def test_a_recording_that_finds_no_space_leaves_nothing_and_is_named(tmp_path, monkeypatch):
    def full(file, *_, **__):
        file.write("0,0,")
        raise OSError(28, "No space left on device")

    write_recording(made_steps(), tmp_path)
    monkeypatch.setattr("surgsim_env.live.recording.np.savetxt", full)
    told = write_recording(made_steps(), tmp_path)
    assert told.startswith("the recording was not written: ") and "No space left on device" in told
    assert [path.name for path in tmp_path.iterdir()] == ["recording-1.csv"]


def test_two_sessions_with_one_folder_take_no_number_twice(tmp_path, monkeypatch):
    """The second is written while the first is."""
    save, others = np.savetxt, []

    def meanwhile(file, table, **given):
        if not others:
            others.append("")
            others[0] = write_recording(made_steps(count=20), tmp_path)
        save(file, table, **given)

    monkeypatch.setattr("surgsim_env.live.recording.np.savetxt", meanwhile)
    assert write_recording(made_steps(count=30), tmp_path) == "30 steps written to recording-2.csv"
    assert others == ["20 steps written to recording-1.csv"]
    assert [len(read_recording(tmp_path / f"recording-{number}.csv", 1, STEP)) for number in (1, 2)] == [20, 30]


def test_the_haptic_package_plays_it(tmp_path):
    steps = made_steps()
    write_recording(steps, tmp_path)
    device = TrajectoryDevice.load(tmp_path / "recording-1.csv")
    np.testing.assert_allclose(device.read().position, steps["hand"][0, 0], rtol=1e-8)


def test_a_slow_trajectory_keeps_its_own_time(tmp_path):
    """Ten rows a second, as a tracker tells: a millimetre from each to the next, the button from the third on."""
    path = tmp_path / "slow.csv"
    rows = [f"{2.0 + 0.1 * row:.1f},{1e-3 * row},0,{-1e-3 * row},{int(row >= 2)}" for row in range(6)]
    path.write_text("time,x,y,z,buttons\n" + "\n".join(rows) + "\n")
    read = read_recording(path, 1, STEP)
    assert len(read) == 501
    np.testing.assert_allclose(read["time"], 2.0 + STEP * np.arange(501), atol=1e-12)
    np.testing.assert_allclose(read["hand"][:, 0, 0], np.linspace(0.0, 5e-3, 501), atol=1e-12)
    np.testing.assert_allclose(read["hand"][:, 0, 2], -read["hand"][:, 0, 0])
    np.testing.assert_array_equal(read["buttons"][:, 0], np.arange(501) >= 200)


def test_a_gap_in_a_slow_trajectory_stays_one(tmp_path):
    path = tmp_path / "gap.csv"
    path.write_text("time,x,y,z\n0,0,0,0\n0.01,1,0,0\n0.02,nan,nan,nan\n0.03,3,0,0\n0.04,4,0,0\n")
    places = read_recording(path, 1, STEP)["hand"][:, 0, 0]
    assert np.isnan(places[11:30]).all() and np.isfinite(places[:10]).all() and np.isfinite(places[31:]).all()


def paused(count=200, arm_count=1):
    """Steps of which some have no hand, late enough for rounded times."""
    steps = made_steps(arm_count, count)
    steps["time"] += 290.0
    steps["hand"][50:60], steps["buttons"][50:60] = np.nan, 0
    steps["hand"][120], steps["buttons"][120] = np.nan, 0
    return steps


def test_a_native_recording_is_taken_as_it_is(tmp_path):
    """To the bit of what is written, with the steps in which the hand said nothing."""
    steps = paused()
    write_recording(steps, tmp_path)
    read = read_recording(tmp_path / "recording-1.csv", 1, STEP)
    written = np.genfromtxt(tmp_path / "recording-1.csv", delimiter=",", names=True)
    present = np.isfinite(steps["hand"][:, 0, 0])
    np.testing.assert_array_equal(read["hand"][present, 0], np.column_stack([written[axis] for axis in "xyz"]))
    assert np.isnan(read["hand"][~present]).all()
    np.testing.assert_array_equal(read["buttons"], steps["buttons"])
    np.testing.assert_allclose(read["time"], steps["time"], atol=1e-6)


def test_a_pause_is_a_gap_in_time(tmp_path):
    """No row is without numbers, which other programs would stumble over."""
    assert write_recording(paused(), tmp_path).startswith("189 steps written")
    table = np.genfromtxt(tmp_path / "recording-1.csv", delimiter=",", skip_header=1)
    assert len(table) == 189
    assert np.isfinite(table).all()
    np.testing.assert_allclose(np.unique(np.diff(table[:, 0]).round(4)), [0.001, 0.002, 0.011])


def test_of_two_arms_a_row_has_a_hand_at_least(tmp_path):
    steps = paused(arm_count=2)
    steps["hand"][80:90, 1] = np.nan
    assert write_recording(steps, tmp_path).startswith("189 steps written")
    read = read_recording(tmp_path / "recording-1.csv", 2, STEP)
    np.testing.assert_array_equal(np.isnan(read["hand"]), np.isnan(steps["hand"]))


def test_a_recording_without_a_hand_says_so(tmp_path):
    steps = made_steps()
    steps["hand"] = np.nan
    assert "no hand moved an instrument" in write_recording(steps, tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_haptic_package_plays_pauses(tmp_path):
    """No pose in the same steps in which there was none."""
    steps = paused()
    write_recording(steps, tmp_path)
    device = TrajectoryDevice.load(tmp_path / "recording-1.csv", haptic_step=STEP)
    played = [device.read() for _ in range(len(steps))]
    assert device.over
    assert [pose is None for pose in played] == np.isnan(steps["hand"][:, 0, 0]).tolist()
    places = np.array([np.full(3, np.nan) if pose is None else pose.position for pose in played])
    np.testing.assert_allclose(places, steps["hand"][:, 0], rtol=1e-8)
    assert [0 if pose is None else pose.buttons for pose in played] == steps["buttons"][:, 0].tolist()


def test_a_pause_of_a_recording_may_not_be_endless(tmp_path):
    path = tmp_path / "long.csv"
    path.write_text("time,x,y,z,tip_x\n0,0,0,0,0\n0.001,0,0,0,0\n0.002,0,0,0,0\n1e9,0,0,0,0\n")
    for play in (lambda: read_recording(path, 1, STEP), lambda: TrajectoryDevice.load(path)):
        with pytest.raises(ValueError, match=r"more than \d+ steps with those of its pauses"):
            play()


def test_nothing_recorded_writes_nothing(tmp_path):
    assert "nothing" in write_recording(made_steps(count=0), tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_folder_that_cannot_be_written_is_said(tmp_path):
    (tmp_path / "file").write_text("")
    assert "not written" in write_recording(made_steps(), tmp_path / "file")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "column 'time' is missing"),
        ("time,x,y,z\n", "no rows"),
        ("time,x,y,z\n0,0,0,zero\n", "line 2"),
        ("time,x,y,z\n0,0,0,inf\n", "not finite"),
        ("time,x,y,z\n0,0,0,0\n1,0,0,0\n1,0,0,0\n", "row 2: time 1 s is not after"),
        ("time,x,y,z\n0,0,0,0\n301,0,0,0\n", "lasts 301 s"),
        ("time,x,y,z,buttons\n0,0,0,0,1e300\n", "line 2: buttons is 1e\\+300"),
    ],
)
def test_files_that_are_none_are_refused(tmp_path, text, told):
    path = tmp_path / "made.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=told):
        read_recording(path, 1, STEP)
