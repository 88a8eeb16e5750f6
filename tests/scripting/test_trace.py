"""A trace: its cuts, its depth, and its tables read back."""

import csv
from functools import cache

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from surgsim_env.scripting import Hold, Lift, PressUntil, StepInterval, Trace, run_script
from surgsim_env.scripting.trace import contact_depth


@cache
def pressed():
    """A run with a press, and the environment after it."""
    env = gym.make("SurgSim/Palpate-v0", instrument="tactile_probe")
    env.reset(seed=2)
    env.unwrapped.simulation.restart(np.array([0.03, 0.03, 0.039]))
    return run_script(env, [PressUntil(0.15, 0.008), Hold(0.1, name="a, hold"), Lift(0.006), Hold(0.05)])


def test_cuts_are_the_steps_and_together_the_whole():
    trace = pressed()
    parts = [trace.between(step.name) for step in trace.steps]
    for name in (
        "haptic_time",
        "wrench",
        "taxels",
        "tip_position",
        "tip_orientation",
        "depth",
        "control_time",
        "observation",
    ):
        whole = np.concatenate([getattr(part, name) for part in parts])
        assert whole.tobytes() == getattr(trace, name).tobytes(), name
    assert sum((part.infos for part in parts), ()) == trace.infos
    both = trace.between("PressUntil", "a, hold")
    assert len(both.reward) == len(parts[0].reward) + 2 and both.start == 0.0
    assert both.between("a, hold").force_size.tobytes() == parts[1].force_size.tobytes()
    assert max(part.peak_force for part in parts) == trace.peak_force
    with pytest.raises(
        ValueError, match="no step 'press' was run; the steps are 'PressUntil', 'a, hold', 'Lift', 'Hold'"
    ):
        trace.between("press")


def test_depth_starts_anew_with_each_contact():
    # Down 4, contact over the last 3; up out of it; down again elsewhere, one step of contact.
    z = np.array([5.0, 4.0, 3.0, 2.0, 3.0, 6.0, 5.0, 4.5])
    touching = np.array([0, 1, 1, 1, 1, 0, 1, 1])
    wrench = np.zeros((8, 1, 6))
    wrench[:, 0, 2] = touching
    places = np.stack([np.arange(8.0), np.zeros(8), z], axis=1)
    depth = contact_depth(wrench, places, np.array([0.0, 0.0, -1.0]))
    np.testing.assert_allclose(depth, [0.0, 0.0, 1.0, 2.0, 1.0, 0.0, 0.0, 0.5])
    assert contact_depth(wrench[:0], places[:0], np.array([0.0, 0.0, -1.0])).shape == (0,)


def read(path):
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    return rows[0], rows[1:]


def column(table, name, kind=float):
    return np.array([kind(row[table[0].index(name)]) for row in table[1]])


def test_tables_read_back_to_the_bit_and_repeat_to_the_byte(tmp_path):
    trace = pressed()
    haptic, control = trace.to_csv(tmp_path / "run.csv")
    assert (haptic.name, control.name) == ("run.csv", "run_control.csv")
    table = read(haptic)
    assert column(table, "time_s").tobytes() == trace.haptic_time.tobytes()
    assert column(table, "force_size_N").tobytes() == trace.force_size.tobytes()
    assert column(table, "depth_m").tobytes() == trace.depth.tobytes()
    place = np.stack([column(table, f"tip_{axis}_m") for axis in "xyz"], axis=1)
    assert place.tobytes() == trace.tip_position.tobytes()
    turned = np.stack([column(table, f"tip_q{axis}") for axis in "wxyz"], axis=1)
    assert turned.tobytes() == trace.tip_orientation.tobytes()
    names = [f"tip_force_{axis}_N" for axis in "xyz"] + [f"tip_torque_{axis}_Nm" for axis in "xyz"]
    assert np.stack([column(table, name) for name in names], axis=1).tobytes() == trace.wrench[:, 0].tobytes()
    names = [f"taxel_0_{row}_{place}_normal_N" for row in range(4) for place in range(4)]
    normal = np.stack([column(table, name) for name in names], axis=1)
    assert normal.tobytes() == trace.taxels[..., 2].tobytes() and len(table[0]) == 17 + 48
    # The probe points down, the wrench up.
    np.testing.assert_allclose(normal.sum(axis=1), trace.wrench[:, 0, 2], rtol=0, atol=1e-12 * trace.peak_force)
    # Each row belongs to the step that was running.
    assert [(column(table, "step", str) == step.name).sum() for step in trace.steps] == [
        len(trace.between(step.name).haptic_time) for step in trace.steps
    ]
    table = read(control)
    assert column(table, "time_s").tobytes() == trace.control_time.tobytes()
    assert column(table, "reward").tobytes() == trace.reward.tobytes()
    seen = np.stack([column(table, f"observation_{index}") for index in range(11 + 48)], axis=1).astype(np.float32)
    assert seen.tobytes() == trace.observation.tobytes()
    assert column(table, "force_peak").max() == max(info["force_peak"] for info in trace.infos)
    again = trace.to_csv(tmp_path / "again.csv")
    assert [path.read_bytes() for path in again] == [haptic.read_bytes(), control.read_bytes()]


def made_up(wrench, name):
    """A trace of three haptic steps and no control step, with two tools."""
    time = np.array([0.001, 0.002, 0.003])
    return Trace(
        start=0.0,
        haptic_time=time,
        wrench=wrench,
        taxels=np.zeros((3, 0, 0, 0, 3)),
        tip_position=np.zeros((3, 3)),
        tip_orientation=np.zeros((3, 4)),
        depth=np.zeros(3),
        control_time=np.zeros(0),
        observation=np.zeros((0, 10)),
        action=np.zeros((0, 4)),
        reward=np.zeros(0),
        infos=(),
        steps=(StepInterval(name, 0.0, 0.003),),
        tool_names=("left", "right"),
        terminated=False,
        truncated=False,
        failure="",
    )


def test_the_total_force_is_that_of_all_tools():
    wrench = np.zeros((3, 2, 6))
    wrench[1, 0, :3], wrench[1, 1, :3], wrench[2, 1, 3:] = (3.0, 0.0, 1.0), (0.0, 4.0, -1.0), 9.0
    trace = made_up(wrench, "x")
    np.testing.assert_allclose(trace.force_size, [0.0, 5.0, 0.0])
    assert trace.peak_force == 5.0 and trace.info == {}
