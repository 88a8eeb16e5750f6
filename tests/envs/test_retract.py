"""SurgSim/Retract-v0: what it pays, what ends it, what it draws, what it sees, and what it refuses."""

import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from surgsim_env.env import PalpateEnv, RetractEnv
from surgsim_env.grasp import Grasp
from surgsim_env.rendering import gl
from surgsim_env.rendering.stage import LABELS
from surgsim_env.rewards import RETRACT_WEIGHTS
from surgsim_env.scenes import make_scene
from surgsim_env.scripting import Hold, Until, run_script
from surgsim_env.tasks.retract import EPISODE_STEPS, HIDDEN_SHARE, SPEED_FULL_SCALE, SUCCESS_SHARE
from surgsim_env.tasks.retraction_record import RetractionRecord, region_strains

REPOSITORY = Path(__file__).resolve().parents[2]
STEP = 0.05
HELD = Grasp(opening=0.01, grip_force=0.4, pull_force=0.1, friction_left=0.2, holds=True)
EMPTY = Grasp(opening=0.02, grip_force=0.0, pull_force=0.0, friction_left=0.0, holds=False)


@pytest.fixture(scope="module")
def shared():
    """One environment for tests that leave nothing behind but an episode."""
    return RetractEnv()


@pytest.fixture
def env(shared):
    shared.reset(seed=1)
    return shared


def act(env, velocity=(0.0, 0.0, 0.0), jaw=None, turning=None):
    return env.step(env.task.action(np.array(velocity), jaw=jaw, turning=turning).astype(np.float32))


class Told:
    """A task's verdicts on what it is told was seen and grasped; nothing moves."""

    def __init__(self, env, monkeypatch):
        self.task, self.simulation = env.task, env.simulation
        self.returned, self.verdict = 0.0, None
        monkeypatch.setattr(self.task, "_grasp", lambda _: HELD if self.holds else EMPTY)
        self.holds = False

    def step(self, visible=0.0, holds=False, force=0.0, pull=0.0, fault=""):
        self.holds, self.simulation.pull_peak = holds, pull
        self.task.begin(np.zeros(self.task.action_size))
        if not fault:
            self.task.visible_share = visible
        self.verdict = self.task.judge(self.simulation, force, fault)
        self.returned += sum(self.verdict.rewards.values())
        return self.verdict


@pytest.fixture
def told(env, monkeypatch):
    return Told(env, monkeypatch)


# ---- what it pays -----------------------------------------------------------------------------------------------


def test_the_weights_put_every_failure_below_every_full_episode():
    """The inequality of the table's comment."""
    w = RETRACT_WEIGHTS
    assert w["forgone"] == pytest.approx(w["time"] + w["soft_force"])
    for failure in ("torn", "hard_force", "fault"):
        margin = -HIDDEN_SHARE * w["visible"] + EPISODE_STEPS * w["soft_force"] - w["visible"] - w["grasped"]
        assert margin - w[failure] > 0.5


FAILURES = {"torn": {"pull": 1e9}, "hard_force": {"force": 1e9}, "fault": {"fault": "told so"}}


def worst_full_return(told):
    """A full episode that presses as hard as it may all the time and loses at its end what was seen at its start."""
    told.task._reached = {"visible": HIDDEN_SHARE, "grasped": 0.0}
    for _ in range(EPISODE_STEPS):
        verdict = told.step(force=told.task.force_limit)
    assert verdict.truncated and not verdict.terminated
    return told.returned


@pytest.mark.parametrize("failure", FAILURES)
def test_no_failed_episode_returns_more_than_the_worst_full_one(told, failure):
    """The best way to fail: all seen but never for long, grasped, without pressing; then, sooner or later, harm."""
    worst = worst_full_return(told)
    for step in (1, 2, 9, 100, 333, 599, 600):
        told.task.reset(np.random.default_rng(0))
        told.task._reached = {"visible": 0.0, "grasped": 0.0}
        told.returned = 0.0
        for before in range(1, step):
            # Never for SUCCESS_TIME on end.
            assert not told.step(visible=float(before % 10 > 0), holds=True).terminated
        verdict = told.step(visible=1.0, holds=True, **FAILURES[failure])
        assert verdict.terminated and verdict.rewards[failure] == RETRACT_WEIGHTS[failure]
        assert told.returned < worst


def test_seen_and_grasped_pay_once_however_often_they_come_and_go(told):
    for _ in range(40):
        told.step(visible=0.7, holds=True)
        told.step(visible=0.1, holds=False)
    assert told.returned == pytest.approx(80 * RETRACT_WEIGHTS["time"] + 0.1 * RETRACT_WEIGHTS["visible"])
    told.step(visible=0.7, holds=True)
    assert told.verdict.rewards["visible"] == pytest.approx(0.6 * RETRACT_WEIGHTS["visible"])
    assert told.verdict.rewards["grasped"] == RETRACT_WEIGHTS["grasped"]


def test_success_is_a_half_second_on_end(told):
    for _ in range(9):
        assert not told.step(visible=SUCCESS_SHARE).terminated
    assert not told.step(visible=SUCCESS_SHARE - 1e-6).terminated
    for _ in range(9):
        assert not told.step(visible=1.0).terminated
    verdict = told.step(visible=1.0)
    assert verdict.terminated and verdict.info["success"] and verdict.rewards["success"] == 10.0
    assert verdict.rewards["forgone"] == 0.0
    assert (SUCCESS_SHARE, HIDDEN_SHARE) == (0.8, 0.1)


def test_soft_force_costs_by_its_share_of_the_way_to_the_hard_limit(told):
    limits = told.task.limits
    middle = 0.5 * (limits.soft_force + limits.hard_force)
    for force, share in ((limits.soft_force, 0.0), (middle, 0.5), (limits.hard_force, 1.0)):
        assert told.step(force=force).rewards["soft_force"] == pytest.approx(share * RETRACT_WEIGHTS["soft_force"])


def test_time_runs_out_after_600_steps(told):
    for step in range(1, EPISODE_STEPS + 1):
        verdict = told.step()
        assert verdict.truncated == (step == EPISODE_STEPS)
    assert told.returned == pytest.approx(EPISODE_STEPS * RETRACT_WEIGHTS["time"], abs=0.5)


# ---- what ends it -----------------------------------------------------------------------------------------------


def test_a_step_that_tears_ends_in_its_very_haptic_step(shared):
    """Grasp the edge and pull it away, with tissue that bears less than the grip does."""
    shared.reset(seed=2)
    task, limits = shared.task, shared.task.limits
    task.limits = replace(limits, tear_force=0.08)
    try:
        info = grasp_and_pull(shared)
    finally:
        task.limits = limits
    assert info["torn"] and not info["hard_limit"] and not info["success"]
    assert info["reward_torn"] == RETRACT_WEIGHTS["torn"]
    assert 0.08 < info["pull_force_peak"] < 0.085
    steps = shared.simulation.time / STEP
    assert abs(steps - round(steps)) > 0.01


def test_the_hard_limit_ends_it(shared):
    shared.reset(seed=2)
    task, limits = shared.task, shared.task.limits
    task.limits = replace(limits, soft_force=0.02, hard_force=0.05)
    try:
        info = grasp_and_pull(shared)
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


def test_a_fault_ends_it_with_the_last_finite_observation_and_a_clean_reset(env):
    expected = env.reset(seed=6)[0]
    before = act(env)[0]
    env.simulation.organ_state.node_velocity[-1, 1] = np.nan
    observation, reward, terminated, _, info = act(env)
    assert terminated and "no longer finite" in info["sim_fault"]
    np.testing.assert_array_equal(observation, before)
    assert reward < RETRACT_WEIGHTS["fault"] + 598 * RETRACT_WEIGHTS["forgone"] + 1e-9
    np.testing.assert_array_equal(env.reset(seed=6)[0], expected)


# ---- what it draws ----------------------------------------------------------------------------------------------


def check_draws(env, seeds):
    """Everything in its range and nothing of the target in view; returns the draws."""
    table, endoscope = env.scene.retract, env.scene.endoscope
    drawn = []
    for seed in seeds:
        _, info = env.reset(seed=seed)
        one = env.task.drawn
        assert info["visible"] <= HIDDEN_SHARE
        assert table.scale[0] <= one.scale <= table.scale[1]
        assert table.youngs_modulus[0] <= one.youngs_modulus <= table.youngs_modulus[1]
        assert np.linalg.norm(np.subtract(one.eye, endoscope.position)) <= 0.005
        views = np.subtract(one.looks_at, one.eye), np.subtract(endoscope.target, endoscope.position)
        cosine = views[0] @ views[1] / np.linalg.norm(views[0]) / np.linalg.norm(views[1])
        assert math.degrees(math.acos(min(cosine, 1.0))) <= 5.0
        assert 0.015 <= one.target[1] <= 0.030
        points = env.simulation.organ_state.node_position
        top = points[env.task.tracked_nodes[:5]]
        np.testing.assert_allclose(top[:, 1], 0.052 * one.scale, atol=0.002)
        drawn.append(one)
    return drawn


def test_draws_are_in_their_ranges_and_hide_the_target(shared):
    drawn = check_draws(shared, range(15))
    assert len({one.to_json() for one in drawn}) == 15
    capsules = [one.capsule_stiffness > 0.0 for one in drawn]
    assert any(capsules) and not all(capsules)


@pytest.mark.slow
def test_a_hundred_draws_hide_the_target(shared):
    check_draws(shared, range(100))


def test_the_organ_is_the_one_that_was_drawn(shared):
    shared.reset(seed=3)
    drawn, model = shared.task.drawn, shared.simulation.organ_model
    extent = np.ptp(model.node_rest_position, axis=0)
    np.testing.assert_allclose(extent, np.array([0.08, 0.052, 0.012]) * drawn.scale, rtol=1e-12)
    held = model.node_inverse_mass == 0.0
    assert held.any() and (model.node_rest_position[held, 1] <= 1e-9).all()
    along = model.node_rest_position[held, 0]
    assert np.ptp(along) <= drawn.held_share * extent[0] * (1.0 + 1e-6)


def test_a_target_in_plain_view_is_drawn_again(shared, monkeypatch):
    seen = iter([0.5, 0.11, 0.02])
    monkeypatch.setattr(shared.task, "_look", lambda _: next(seen, 0.02))
    _, info = shared.reset(seed=4)
    assert info["visible"] == 0.02 and next(seen, None) is None
    monkeypatch.setattr(shared.task, "_look", lambda _: 1.0)
    with pytest.raises(ValueError, match="none of 20 draws"):
        shared.reset(seed=4)


# ---- what it observes and measures --------------------------------------------------------------------------------


def test_the_observation_is_what_its_table_says(env):
    tip = env.simulation.instrument.tip_position
    for _ in range(4):
        observation = act(env, (0.004, 0.0, 0.002), jaw=1.0)[0]
    # 6 numbers more than the table's 50, as the grasper turns.
    assert observation.shape == (56,)
    np.testing.assert_allclose(observation[:3], tip + np.array([0.004, 0.0, 0.002]) * 4 * STEP, atol=2e-4)
    np.testing.assert_allclose(observation[3:6], [0.004, 0.0, 0.002], atol=5e-4)
    axes = observation[6:12].reshape(2, 3)
    np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-6)
    assert observation[12] == pytest.approx(env.simulation.instrument.opening, abs=1e-6)
    bias = env.task.force_reading.bias
    np.testing.assert_allclose(observation[13:16], bias, atol=6 * env.scene.sensor.noise)
    np.testing.assert_array_equal(observation[13:16], env.task.sensed_force(observation).astype(np.float32))
    np.testing.assert_array_equal(observation[19:22], 0.0)
    nodes = env.simulation.organ_state.node_position[env.task.tracked_nodes]
    np.testing.assert_allclose(observation[22:52].reshape(-1, 3), nodes, atol=1e-7)
    place = env.task.drawn.target[:2]
    np.testing.assert_allclose(observation[52:], [0.0, *place, 1.0 - 4 / EPISODE_STEPS], atol=1e-6)


def test_an_action_is_read_as_it_was_made(env):
    velocity, turning = np.array([0.004, -0.008, 0.012]), np.array([0.2])
    action = env.task.action(velocity, turning=turning, jaw=0.3)
    np.testing.assert_allclose(action, [0.2, -0.4, 0.6, 0.4, 0.3])
    # What is not said stays: the jaw's last target, and no turning.
    act(env, jaw=0.3)
    np.testing.assert_allclose(env.task.action(np.zeros(3)), [0.0, 0.0, 0.0, 0.0, 0.3])


def test_wrist_turns_at_the_commanded_rate(env):
    before = env.simulation.instrument.pitch
    for _ in range(10):
        act(env, turning=np.array([0.4]))
    assert env.simulation.instrument.pitch - before == pytest.approx(0.4 * 10 * STEP, rel=0.05)


def test_path_and_peaks_are_the_episodes(env):
    for _ in range(10):
        info = act(env, (0.0, 0.006, 0.008))[-1]
    # The servo lags a little at its start.
    assert info["path_length"] == pytest.approx(0.01 * 9 * STEP, rel=0.03)
    assert info["pull_force_peak"] == info["grip_force_peak"] == info["pull_impulse"] == info["slips"] == 0.0


def test_forces_slips_and_impulse_are_counted_as_told():
    record, tip = RetractionRecord(), np.zeros(3)
    slipping, calm = replace(HELD, friction_left=0.0), [0.0, 0.0, 0.0]
    for grasp in (HELD, slipping, slipping, HELD, slipping, EMPTY, EMPTY):
        record.note(grasp, 0.15, tip, calm, closing=True, duration=STEP)
    info = record.info()
    # Two holds that began to slip, and one that was lost with the jaw closing.
    assert info["slips"] == 3.0
    assert info["grip_force_mean"] == pytest.approx(0.4) and info["grip_force_peak"] == 0.4
    assert info["pull_force_mean"] == pytest.approx(0.1) and info["pull_force_peak"] == 0.15
    assert info["pull_impulse"] == pytest.approx(0.1 * 5 * STEP)
    opened = RetractionRecord()
    for grasp in (HELD, EMPTY):
        opened.note(grasp, 0.1, tip, calm, closing=False, duration=STEP)
    assert opened.info()["slips"] == 0.0


def test_strains_are_those_of_a_stretched_lobe(env):
    """Stretched by 5 % along y in its free third and by 2 % elsewhere, edges along y strain by just that."""
    model = env.simulation.organ_model
    rest = model.node_rest_position
    length = rest[:, 1].max()
    moved = rest.copy()
    # From the first layer of nodes in that third on.
    moved[:, 1] += 0.02 * rest[:, 1] + 0.03 * np.maximum(rest[:, 1] - 9.0 / 13.0 * length, 0.0)
    np.testing.assert_allclose(region_strains(model, moved), [0.02, 0.02, 0.05], rtol=1e-6)
    np.testing.assert_allclose(region_strains(model, 0.9 * rest), 0.0)


# ---- pictures ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def opengl():
    try:
        gl.context()
    except gl.NoGLError as reason:
        pytest.skip(f"no OpenGL: {reason}")


def target_areas(env, camera, width, height):
    """For each pixel how much of the whole target it shows, from the camera's own rays; they sum to about 1.

    A pixel of depth z along the view covers an area of a plane in proportion to z^3.
    """
    disc, half = env.task.target, math.tan(math.radians(0.5 * camera.fov))
    column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    x, y = (column / width - 0.5) * 2.0 * half * width / height, (0.5 - row / height) * 2.0 * half
    rays = np.stack([x, y, -np.ones_like(x)], axis=-1) @ camera.rotation.T
    depth = (disc.centre[2] - camera.position[2]) / rays[..., 2]
    places = camera.position + depth[..., None] * rays
    area = np.where(np.linalg.norm(places - disc.centre, axis=-1) <= disc.radius, depth**3, 0.0)
    return area / area.sum()


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize(("width", "height", "tolerance"), [(640, 480, 0.015), (84, 84, 0.10)])
def test_what_is_seen_is_what_a_picture_shows(width, height, tolerance):
    """With the lobe half folded back; coarse pixels count the border to a pixel or so."""
    env = RetractEnv(render_mode="rgb_array", width=width, height=height, smooth_edges=False)
    env.reset(seed=6)
    nodes, rest = env.simulation.organ_state.node_position, env.simulation.organ_state.node_position.copy()
    compared, instrument = np.zeros(2, dtype=int), env.simulation.instrument
    # The lobe turned up about its held edge, as a plate on a hinge, the jaw far aside; then the jaw in the way.
    lifted = [(turn, 0.12) for turn in np.arange(0.12, 0.30, 0.02)]
    crossed = [(0.9, beside) for beside in np.arange(0.03, 0.08, 0.004)]
    for turn, beside in lifted + crossed:
        instrument.place(np.array([beside, 0.07, 0.006]))
        nodes[:, 1] = rest[:, 1] * math.cos(turn) - rest[:, 2] * math.sin(turn)
        nodes[:, 2] = rest[:, 1] * math.sin(turn) + rest[:, 2] * math.cos(turn)
        seen = env.task._look(env.simulation)
        labels = env.renderer.segmentation("endoscope")
        areas = target_areas(env, env.renderer.cameras["endoscope"], width, height)
        assert areas[labels == LABELS["target"]].sum() == pytest.approx(seen, abs=tolerance)
        compared[int(turn == 0.9)] += 0.02 < seen < 0.98
    assert (compared >= 2).all(), "some must be half covered to prove anything"
    env.close()


@pytest.mark.usefixtures("opengl")
def test_observing_pictures_changes_no_bit_of_the_episode():
    plain, seeing = RetractEnv(), RetractEnv(obs_mode="rgb")
    assert seeing.observation_space.shape == (84, 84, 3) and seeing.observation_space.dtype == np.uint8
    one, other = plain.reset(seed=5), seeing.reset(seed=5)
    assert seeing.observation_space.contains(other[0]) and np.ptp(other[0]) > 50
    for _ in range(5):
        one, other = act(plain, (0.0, -0.02, 0.0), jaw=-1.0), act(seeing, (0.0, -0.02, 0.0), jaw=-1.0)
    assert one[1:] == other[1:]
    assert plain.save_state() == seeing.save_state()
    seeing.close()


@pytest.mark.usefixtures("opengl")
def test_a_fault_shows_the_last_picture_before_it():
    """Not one of a lobe whose nodes are nowhere."""
    env = RetractEnv(obs_mode="rgb")
    env.reset(seed=6)
    before = act(env)[0]
    env.simulation.organ_state.node_velocity[100] = np.nan
    observation, _, terminated, _, info = act(env)
    assert terminated and "no longer finite" in info["sim_fault"]
    np.testing.assert_array_equal(observation, before)
    env.close()


@pytest.mark.usefixtures("opengl")
def test_scripts_feel_forces_where_pictures_are_observed(tmp_path):
    """The sensor's reading is a force, not rows of the picture, and a trace's table has no pictures in it."""
    env, felt = RetractEnv(obs_mode="rgb"), []
    wait = Until(Hold(0.2), lambda view: felt.append(view.sensed_force) or False)
    trace = run_script(env, [wait], seed=6)
    assert trace.observation.shape == (4, 84, 84, 3)
    bias, noise = env.task.force_reading.bias, env.scene.sensor.noise
    np.testing.assert_allclose(np.array(felt), np.tile(bias, (len(felt), 1)), atol=6 * noise)
    _, table = trace.to_csv(tmp_path / "run.csv")
    columns = table.read_text().splitlines()[0].split(",")
    assert columns[:3] == ["time_s", "step", "action_0"]
    env.close()


@pytest.mark.usefixtures("opengl")
def test_the_checker_accepts_pictures():
    from gymnasium.utils.env_checker import check_env

    env = RetractEnv(obs_mode="rgb")
    check_env(env)
    env.close()


def test_pictures_without_opengl_say_what_is_missing():
    code = """
import gymnasium as gym, surgsim_env
env = gym.make("SurgSim/Retract-v0", obs_mode="rgb").unwrapped
try:
    env.reset(seed=0)
except Exception as error:
    print(type(error).__name__)
"""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], cwd=REPOSITORY, env={**os.environ, gl.VARIABLE: "off"},
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.stdout.strip() == "NoGLError", done.stderr


# ---- what it refuses --------------------------------------------------------------------------------------------


def test_scenes_of_the_other_task_are_refused():
    with pytest.raises(ValueError, match=r"scene 'phantom' has no \[retract\] table.* such as 'lobe'"):
        RetractEnv(scene="phantom")
    with pytest.raises(ValueError, match=r"scene 'lobe' has no \[lesion\] table.* such as 'phantom'"):
        PalpateEnv(scene="lobe")


def test_instruments_without_a_jaw_are_refused():
    with pytest.raises(ValueError, match=r"'probe\.xml' has no jaw"):
        RetractEnv(instrument="probe")


def test_two_arms_are_refused():
    with pytest.raises(ValueError, match="'psm_pair' is two arms, and one is needed"):
        RetractEnv(instrument="psm_pair")


def test_unknown_observations_are_refused():
    with pytest.raises(ValueError, match="obs_mode 'pixels' is unknown; the modes are state, rgb"):
        RetractEnv(obs_mode="pixels")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"target_distance": (0.03, 0.02)}, r"retract.target_distance = \[0.03, 0.02\]"),
        ({"held_share": (0.5, 1.2)}, "no more than 1 can be held"),
        ({"target_radius": 0.0}, "target_radius is 0 m"),
        ({"capsule_share": 1.5}, "capsule_share is 1.5"),
        ({"start_lower": (1.0, 0.0, 0.0)}, "starts from x = 1"),
    ],
)
def test_impossible_draws_are_refused(change, words):
    table = make_scene("lobe").retract
    with pytest.raises(ValueError, match=words):
        replace(table, **change)


def test_impossible_cameras_and_limits_are_refused():
    scene = make_scene("lobe")
    with pytest.raises(ValueError, match=r"retract\.camera\.shift is -1"):
        replace(scene.retract.camera, shift=-1.0)
    with pytest.raises(ValueError, match=r"limits\.tear_force is -2 N"):
        replace(scene.limits, tear_force=-2.0)


def test_it_is_registered_with_its_time_limit():
    spec = gym.spec("SurgSim/Retract-v0")
    assert spec.max_episode_steps == EPISODE_STEPS
