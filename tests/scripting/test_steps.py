"""Steps of a script in the phantom: they do what they say in newtons and metres, or say by name what they did not."""

from functools import cache

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from surgsim_env.scripting import (
    Control,
    Declare,
    Follow,
    Hold,
    Lift,
    MoveTo,
    PressUntil,
    ScriptError,
    WaitUntil,
    run_script,
)

RADIUS, TOP = 0.008, 0.03
MIDDLE = (0.03, 0.03)


@cache
def made(instrument="probe"):
    return gym.make("SurgSim/Palpate-v0", scene="phantom", instrument=instrument)


def above(instrument="probe", gap=0.001, seed=1):
    """The environment with its tip at rest above the middle of the phantom."""
    env = made(instrument)
    env.reset(seed=seed)
    env.unwrapped.simulation.restart(np.array([*MIDDLE, TOP + RADIUS + gap]))
    return env


@pytest.mark.parametrize("instrument", ["probe", "psm_palpator"])
@pytest.mark.parametrize("force", [0.08, 0.3])
def test_press_hold_lift(instrument, force):
    trace = run_script(above(instrument), [PressUntil(force, max_depth=0.008), Hold(0.4), Lift(0.012)])
    press, hold, lift = (trace.between(name) for name in ("PressUntil", "Hold", "Lift"))
    # Within the step's tolerance of the force and never far above it: the last step is sized by the stiffness felt.
    assert press.force[-1, 2] == pytest.approx(force, abs=0.01)
    assert trace.peak_force < force + 0.015
    # The tip rests: what is left is the tissue's own motion, damped with alpha = 25/s, gone after 0.2 s.
    settled = hold.force_size[-200:]
    assert np.ptp(settled) < 0.002
    assert settled.mean() == pytest.approx(force, abs=0.015)
    assert hold.duration == pytest.approx(0.4)
    # Parted: no contact, no force, to the bit.
    assert not lift.wrench[-1].any()
    assert lift.tip_position[-1, 2] - hold.tip_position[-1, 2] == pytest.approx(0.012, abs=3e-4)
    assert trace.failure == "" and not trace.terminated


def test_a_press_by_the_sensor_stops_where_the_sensor_says():
    env = above()
    bias, noise = 0.1, env.unwrapped.scene.sensor.noise
    env.unwrapped.runtime.sensors["contact_force"].bias = np.array([0.0, 0.0, bias])
    trace = run_script(env, [PressUntil(0.2, 0.008, sensed=True)])
    assert trace.observation[-1, 8] >= 0.19
    # The true force lacks the bias; within the tolerance and four standard deviations of the reading that ended it.
    assert trace.force[-1, 2] == pytest.approx(0.2 - bias, abs=0.01 + 4 * noise)


def test_a_press_along_a_slant_counts_the_force_along_it():
    direction = np.array([0.6, 0.0, -0.8])
    trace = run_script(above(), [PressUntil(0.15, 0.01, direction=tuple(3.0 * direction))])
    assert -trace.force[-1] @ direction == pytest.approx(0.15, abs=0.012)
    way = trace.tip_position[-1] - trace.tip_position[0]
    np.testing.assert_allclose(way / np.linalg.norm(way), direction, atol=0.03)


def test_depth_counts_from_contact_and_is_never_passed():
    with pytest.raises(ScriptError, match=r"'PressUntil'.* 1\.50 mm") as e:
        run_script(above(gap=0.003), [Hold(0.05), PressUntil(0.5, max_depth=0.0015), Hold(0.1)])
    trace = e.value.trace
    assert trace.failure == str(e.value)
    assert [step.name for step in trace.steps] == ["Hold", "PressUntil"]
    assert trace.depth.max() == pytest.approx(0.0015, abs=5e-5)
    # The same by the geometry: the ball's lowest point under the resting top, contact at d^2 / (2 R) < 0.3 mm of it.
    assert 0.0014 < TOP + RADIUS - trace.tip_position[:, 2].min() < 0.0019


@pytest.mark.parametrize("instrument", ["probe", "psm_palpator"])
def test_move_to_goes_straight_and_no_faster_than_told(instrument):
    env = above(instrument, gap=0.01)
    start = env.unwrapped.simulation.instrument.tip_position
    goal = start + np.array([0.008, -0.006, 0.004])
    trace = run_script(env, [MoveTo(tuple(goal), speed=0.015, tolerance=0.0001)])
    assert np.linalg.norm(trace.tip_position[-1] - goal) <= 0.0001
    line = (goal - start) / np.linalg.norm(goal - start)
    away = trace.tip_position - start
    assert np.linalg.norm(away - np.outer(away @ line, line), axis=1).max() < 1e-4
    assert away @ line == pytest.approx(np.clip(away @ line, 0.0, np.linalg.norm(goal - start) + 1e-4))
    speed = np.linalg.norm(np.diff(trace.tip_position, axis=0), axis=1) / 0.001
    assert np.median(speed[100:400]) == pytest.approx(0.015, rel=0.02)
    assert speed.max() < 0.015 * 1.3  # the servo's overshoot at the start


def late(step):
    with pytest.raises(ScriptError) as caught:
        run_script(above(gap=0.004), [Hold(0.05), step])
    return str(caught.value), caught.value.trace


@pytest.mark.parametrize(
    "step",
    [
        MoveTo((0.03, 0.03, 1.0), timeout=0.2, name="out of reach"),
        PressUntil(0.2, 0.01, speed=0.001, timeout=0.2, name="slow press"),
        Lift(0.05, speed=0.001, timeout=0.2, name="slow lift"),
        WaitUntil(lambda view: False, timeout=0.2, name="never"),
        Declare(timeout=0.2, name="in the air"),
        Control(lambda observation: np.zeros(4), timeout=0.2, until=lambda view: False, name="mine"),
    ],
    ids=lambda step: step.name,
)
def test_a_step_out_of_time_is_named_with_what_was_reached(step):
    message, trace = late(step)
    assert repr(step.name) in message and "0.2 s" in message
    assert trace.failure == message
    assert trace.between(step.name).duration == pytest.approx(0.2)


def test_an_episode_that_ends_too_soon_is_an_error():
    with pytest.raises(ScriptError, match=r"'PressUntil'.* 0\.80\d N") as caught:
        run_script(above(), [PressUntil(5.0, 0.02, speed=0.02)])
    assert caught.value.trace.terminated and caught.value.trace.peak_force > 0.8
    with pytest.raises(ScriptError, match="'Declare'"):
        run_script(above(), [PressUntil(0.1, 0.01), Declare(), Hold(0.1)])


def test_a_fault_is_named():
    env = above()

    def break_it(observation):
        env.unwrapped.simulation.organ_state.node_velocity[700, 1] = np.nan
        return np.zeros(4)

    with pytest.raises(ScriptError, match="'Control'"):
        run_script(env, [Control(break_it, timeout=1.0)])


def test_an_episode_may_end_in_the_last_step_that_is_made_for_it():
    trace = run_script(above(), [PressUntil(0.1, 0.01), Declare()])
    assert trace.terminated and trace.info["declared"]
    assert len(trace.between("Declare").reward) == 3


def test_wait_until_sees_the_view_and_ends_with_it():
    seen = []

    def late_enough(view):
        seen.append(view)
        return view.step_time > 0.12

    trace = run_script(above(), [Hold(0.1), WaitUntil(late_enough, timeout=1.0)])
    assert trace.between("WaitUntil").duration == pytest.approx(0.15)
    assert [round(view.time, 9) for view in seen] == [0.1, 0.15, 0.2, 0.25]
    assert [round(view.step_time, 9) for view in seen] == [0.0, 0.05, 0.1, 0.15]


def test_a_view_shows_both_forces():
    views = []
    env = above()
    trace = run_script(env, [PressUntil(0.2, 0.008), WaitUntil(lambda view: views.append(view) or True, timeout=1.0)])
    (view,) = views
    assert view.true_force.tobytes() == trace.force[-1].tobytes()
    assert (view.sensed_force == env.unwrapped.task_observation[6:9]).all()
    assert view.tip_position.tobytes() == trace.tip_position[-1].tobytes()
    assert view.contact_position is None  # nothing happened since this step began


class Pusher:
    """A controller with a state: down until it feels a force, then still; counts its calls."""

    def __init__(self, force):
        self.force, self.observations, self.resets = force, [], 0

    def reset(self):
        self.resets += 1
        self.observations = []

    def __call__(self, observation):
        self.observations.append(observation.copy())
        down = observation[8] < self.force
        observation[:] = np.nan  # what a controller does to its observation is its own affair
        return np.array([0.0, 0.0, -0.4 if down else 0.0, 0.0])


def test_a_controller_of_ones_own_sees_each_observation_and_acts():
    pusher = Pusher(0.1)
    trace = run_script(above(), [Hold(0.1), Control(pusher, timeout=1.0), Lift(0.01)])
    mine = trace.between("Control")
    assert pusher.resets == 1 and len(mine.reward) == 20 == len(pusher.observations)
    # The first is what the step before left, the last its own last action brought is not seen any more.
    assert pusher.observations[0].tobytes() == trace.between("Hold").observation[-1].tobytes()
    for seen, gave in zip(pusher.observations[1:], mine.observation[:-1], strict=True):
        assert seen.tobytes() == gave.tobytes()
    assert mine.force_size[-1] > 0.05
    env = above()
    first = env.unwrapped.observation
    until = run_script(env, [Control(pusher, timeout=2.0, until=lambda view: view.true_force[2] > 0.05)])
    assert pusher.observations[0].tobytes() == first.tobytes()
    assert until.duration < 1.0 and until.force[-1, 2] > 0.05


def recorded(path, trace, *, pause=slice(0, 0)):
    """A trace's tip as `surgsim view` would record it, with a hand that is somewhere else and lets go for a while."""
    rows = np.column_stack([trace.haptic_time, np.zeros((len(trace.haptic_time), 4)), trace.tip_position])
    rows = np.delete(rows, pause, axis=0)
    np.savetxt(path, rows, delimiter=",", header="time,x,y,z,buttons,tip_x,tip_y,tip_z", comments="", fmt="%.9g")
    return path


@pytest.mark.parametrize("pause", [slice(0, 0), slice(300, 420)], ids=["whole", "paused"])
def test_a_recording_is_followed(tmp_path, pause):
    first = run_script(above(), [PressUntil(0.2, max_depth=0.008), Hold(0.5)])
    again = run_script(above(gap=0.003), [Follow(recorded(tmp_path / "r.csv", first, pause=pause)), Hold(0.3)])
    played = again.between("Follow")
    # The tip ends where it was recorded, at that pace, and feels the same: 0.1 mm is 0.01 N here.
    np.testing.assert_allclose(again.tip_position[-1], first.tip_position[-1], atol=1e-4)
    assert again.force[-1, 2] == pytest.approx(first.force[-1, 2], abs=0.015)
    assert played.duration > first.haptic_time[-1] - first.haptic_time[0]
