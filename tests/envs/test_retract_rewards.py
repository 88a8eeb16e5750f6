"""SurgSim/Retract-v0: what it pays, and what ends it."""

from dataclasses import replace

import numpy as np
import pytest

from surgsim_env.tasks.declaration import SPEED_FULL_SCALE, ControlStep, reward_weights
from surgsim_env.tasks.retract import EPISODE_STEPS, HIDDEN_SHARE, SUCCESS_SHARE, RetractTask
from tests.envs.retract_steps import EMPTY, HELD, STEP, act

WEIGHTS = reward_weights(RetractTask)


class Told:
    """A task's verdicts on what it is told was seen and grasped; nothing moves."""

    def __init__(self, env, monkeypatch):
        self.task, self.runtime, self.simulation = env.task, env.runtime, env.simulation
        self.returned, self.verdict = 0.0, None
        monkeypatch.setattr(self.task, "_look", lambda _: self.visible)
        monkeypatch.setattr(type(self.simulation), "grasp", property(lambda _: HELD if self.holds else EMPTY))
        self.holds = False

    def step(self, visible=0.0, holds=False, force=0.0, pull=0.0, fault=""):
        self.visible, self.holds, self.simulation.pull_peak = visible, holds, pull
        self.task.step_count += 1
        step = ControlStep(self.simulation, force, fault)
        if not fault:
            self.task.update(step)
        self.verdict = self.runtime.judge(step)
        self.returned += sum(self.verdict.rewards.values())
        return self.verdict


@pytest.fixture
def episode(retract_env, monkeypatch):
    return Told(retract_env, monkeypatch)


# ---- what it pays -----------------------------------------------------------------------------------------------


def test_the_weights_put_every_failure_below_every_full_episode():
    """The inequality of the table's comment."""
    w = WEIGHTS
    assert w["forgone"] == pytest.approx(w["time"] + w["soft_force"])
    for failure in ("torn", "hard_force", "fault"):
        margin = -HIDDEN_SHARE * w["visible"] + EPISODE_STEPS * w["soft_force"] - w["visible"] - w["grasped"]
        assert margin - w[failure] > 0.5


FAILURES = {"torn": {"pull": 1e9}, "hard_force": {"force": 1e9}, "fault": {"fault": "told so"}}


def worst_full_return(episode):
    """A full episode that presses as hard as it may all the time and loses at its end what was seen at its start."""
    episode.runtime._reached = {"visible": HIDDEN_SHARE, "grasped": 0.0}
    for _ in range(EPISODE_STEPS):
        verdict = episode.step(force=episode.runtime.force_limit)
    assert verdict.truncated and not verdict.terminated
    return episode.returned


@pytest.mark.slow
@pytest.mark.parametrize("failure", FAILURES)
def test_no_failed_episode_returns_more_than_the_worst_full_one(episode, failure):
    """The best way to fail: all seen but never for long, grasped, without pressing; then, sooner or later, harm."""
    worst = worst_full_return(episode)
    for step in (1, 2, 9, 100, 333, 599, 600):
        episode.runtime.draw(np.random.default_rng(0))
        episode.runtime._reached = {"visible": 0.0, "grasped": 0.0}
        episode.returned = 0.0
        for before in range(1, step):
            # Never for SUCCESS_TIME on end.
            assert not episode.step(visible=float(before % 10 > 0), holds=True).terminated
        verdict = episode.step(visible=1.0, holds=True, **FAILURES[failure])
        assert verdict.terminated and verdict.rewards[failure] == WEIGHTS[failure]
        assert episode.returned < worst


def test_seen_and_grasped_pay_once_however_often_they_come_and_go(episode):
    for _ in range(40):
        episode.step(visible=0.7, holds=True)
        episode.step(visible=0.1, holds=False)
    assert episode.returned == pytest.approx(80 * WEIGHTS["time"] + 0.1 * WEIGHTS["visible"])
    episode.step(visible=0.7, holds=True)
    assert episode.verdict.rewards["visible"] == pytest.approx(0.6 * WEIGHTS["visible"])
    assert episode.verdict.rewards["grasped"] == WEIGHTS["grasped"]


def test_success_is_a_half_second_on_end(episode):
    """Of sight and hold at the same time: a shut jaw that scoops the lobe up holds nothing."""
    for _ in range(9):
        assert not episode.step(visible=SUCCESS_SHARE, holds=True).terminated
    assert not episode.step(visible=SUCCESS_SHARE - 1e-6, holds=True).terminated
    for _ in range(9):
        assert not episode.step(visible=1.0, holds=True).terminated
    for _ in range(20):
        assert not episode.step(visible=1.0, holds=False).terminated
    for _ in range(9):
        assert not episode.step(visible=1.0, holds=True).terminated
    verdict = episode.step(visible=1.0, holds=True)
    assert verdict.terminated and verdict.info["success"] and verdict.rewards["success"] == 10.0
    assert verdict.rewards["forgone"] == 0.0
    assert (SUCCESS_SHARE, HIDDEN_SHARE) == (0.8, 0.1)


@pytest.mark.slow
def test_a_shut_jaw_that_scoops_the_lobe_up_does_not_succeed(shared_retract):
    """Under the free edge and up: the target is in sight, and nothing is held."""
    shared_retract.reset(seed=3)
    x, seen = shared_retract.task.drawn.target[0], 0
    for y, z, steps in ((0.072, -0.006, 20), (0.048, -0.004, 25), (0.046, 0.031, 36), (0.046, 0.031, 15)):
        for _ in range(steps):
            way = np.array([x, y, z]) - shared_retract.simulation.instrument.tip_position
            velocity = way / max(np.abs(way).max() / SPEED_FULL_SCALE, STEP)
            _, _, terminated, _, info = act(shared_retract, velocity, jaw=-1.0)
            assert not terminated
            seen += info["visible"] >= SUCCESS_SHARE
    assert seen > 10 and not info["holds"]


def test_soft_force_costs_by_its_share_of_the_way_to_the_hard_limit(episode):
    limits = episode.task.limits
    middle = 0.5 * (limits.soft_force + limits.hard_force)
    for force, share in ((limits.soft_force, 0.0), (middle, 0.5), (limits.hard_force, 1.0)):
        assert episode.step(force=force).rewards["soft_force"] == pytest.approx(share * WEIGHTS["soft_force"])


def test_time_runs_out_after_600_steps(episode):
    for step in range(1, EPISODE_STEPS + 1):
        verdict = episode.step()
        assert verdict.truncated == (step == EPISODE_STEPS)
    assert episode.returned == pytest.approx(EPISODE_STEPS * WEIGHTS["time"], abs=0.5)


# ---- what ends it -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_step_that_tears_ends_in_its_very_haptic_step(shared_retract):
    """Grasp the edge and pull it away, with tissue that bears less than the grip does."""
    shared_retract.reset(seed=2)
    task, limits = shared_retract.task, shared_retract.task.limits
    task.limits = replace(limits, tear_force=0.08)
    try:
        info = grasp_and_pull(shared_retract)
    finally:
        task.limits = limits
    assert info["torn"] and not info["hard_limit"] and not info["success"]
    assert info["reward_torn"] == WEIGHTS["torn"]
    assert 0.08 < info["pull_force_peak"] < 0.085
    steps = shared_retract.simulation.time / STEP
    assert abs(steps - round(steps)) > 0.01


@pytest.mark.slow
def test_the_hard_limit_ends_it(shared_retract):
    shared_retract.reset(seed=2)
    task, limits = shared_retract.task, shared_retract.task.limits
    task.limits = replace(limits, soft_force=0.02, hard_force=0.05)
    try:
        info = grasp_and_pull(shared_retract)
    finally:
        task.limits = limits
    assert info["hard_limit"] and not info["torn"]
    assert 0.05 < info["force_peak"] < 0.055


def grasp_and_pull(env):
    """Close the jaw about the free edge and pull it up and away till the episode ends; the last info."""
    tip, edge = env.simulation.instrument.tip_position, env.simulation.organ_state.node_position[:, 1].max()
    middle = env.simulation.organ_state.node_position[:, 2][env.task.tracked_nodes[:5]].mean() - 0.006
    for target in ((tip[0], tip[1], middle), (tip[0], edge - 0.004, middle)):
        for _ in range(60):
            way = np.array(target) - env.simulation.instrument.tip_position
            info = act(env, way / max(np.abs(way).max() / SPEED_FULL_SCALE, STEP), jaw=1.0)[-1]
    for velocity in [(0.0, 0.0, 0.0)] * 16 + [(0.0, 0.01, 0.015)] * 60:
        _, _, terminated, _, info = act(env, velocity, jaw=-1.0)
        if terminated:
            return info
    raise AssertionError(f"nothing ended it: {info}")


def test_a_fault_ends_it_with_the_last_finite_observation_and_a_clean_reset(retract_env):
    expected = retract_env.reset(seed=6)[0]
    before = act(retract_env)[0]
    retract_env.simulation.organ_state.node_velocity[-1, 1] = np.nan
    observation, reward, terminated, _, info = act(retract_env)
    assert terminated and "no longer finite" in info["sim_fault"]
    np.testing.assert_array_equal(observation, before)
    assert reward < WEIGHTS["fault"] + 598 * WEIGHTS["forgone"] + 1e-9
    np.testing.assert_array_equal(retract_env.reset(seed=6)[0], expected)
