"""Recordings: what is written can be read again, played by the haptic package, and never elsewhere than told."""

import numpy as np
import pytest

from surgsim_apps.haptics.trajectory import TrajectoryDevice
from surgsim_apps.live.exchange_records import recording_type
from surgsim_apps.live.recording import write_recording
from surgsim_env.scripting.motion_file import read_motion

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
    for arm, mark in enumerate(("", "_2")[:arm_count]):
        read = read_motion(tmp_path / "new" / "recording-1.csv", mark)
        np.testing.assert_allclose(read.time, steps["time"], rtol=1e-8)
        np.testing.assert_allclose(read.position, steps["hand"][:, arm], rtol=1e-8)
        np.testing.assert_array_equal(read.buttons, steps["buttons"][:, arm])


def test_a_recording_that_finds_no_space_leaves_nothing_and_is_named(tmp_path, monkeypatch):
    def full(path, *_, **__):
        path.write_text("0,0,")
        raise OSError(28, "No space left on device")

    write_recording(made_steps(), tmp_path)
    monkeypatch.setattr("surgsim_apps.live.recording.np.savetxt", full)
    sentence = write_recording(made_steps(), tmp_path)
    assert sentence.startswith("the recording was not written: ") and "No space left on device" in sentence
    assert [path.name for path in tmp_path.iterdir()] == ["recording-1.csv"]


def test_two_sessions_with_one_folder_take_no_number_twice(tmp_path, monkeypatch):
    """The second is written while the first is."""
    save, others = np.savetxt, []

    def meanwhile(file, table, **given):
        if not others:
            others.append("")
            others[0] = write_recording(made_steps(count=20), tmp_path)
        save(file, table, **given)

    monkeypatch.setattr("surgsim_apps.live.recording.np.savetxt", meanwhile)
    assert write_recording(made_steps(count=30), tmp_path) == "30 steps written to recording-2.csv"
    assert others == ["20 steps written to recording-1.csv"]
    assert [len(read_motion(tmp_path / f"recording-{number}.csv").time) for number in (1, 2)] == [20, 30]


def test_the_haptic_package_plays_it(tmp_path):
    steps = made_steps()
    write_recording(steps, tmp_path)
    device = TrajectoryDevice.load(tmp_path / "recording-1.csv")
    np.testing.assert_allclose(device.read().position, steps["hand"][0, 0], rtol=1e-8)


def paused(count=200, arm_count=1):
    """Steps of which some have no hand, late enough for rounded times."""
    steps = made_steps(arm_count, count)
    steps["time"] += 290.0
    steps["hand"][50:60], steps["buttons"][50:60] = np.nan, 0
    steps["hand"][120], steps["buttons"][120] = np.nan, 0
    return steps


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


def test_nothing_recorded_writes_nothing(tmp_path):
    assert "nothing" in write_recording(made_steps(count=0), tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_folder_that_cannot_be_written_is_said(tmp_path):
    (tmp_path / "file").write_text("")
    assert "not written" in write_recording(made_steps(), tmp_path / "file")
