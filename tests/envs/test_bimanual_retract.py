"""SurgSim/BimanualRetract-v0: what counts as touched and exposed, what ends it, and what it pays."""

import numpy as np
import pytest

import surgsim_env  # noqa: F401
from surgsim_env.envs.ids import BimanualRetractEnv
from surgsim_env.instruments.arm.pair import Pair
from surgsim_env.instruments.instrument import Grasp
from surgsim_env.scene.load import pair_names
from surgsim_env.tasks.bimanual_retract import BimanualRetractTask
from surgsim_env.tasks.declaration import ControlStep, reward_weights
from surgsim_env.tasks.retract import EPISODE_STEPS, HIDDEN_SHARE

HELD = Grasp(opening=0.01, grip_force=0.4, pull_force=0.1, friction_left=0.2, holds=True)
EMPTY = Grasp(opening=0.02, grip_force=0.0, pull_force=0.0, friction_left=0.0, holds=False)


@pytest.fixture(scope="module")
def shared():
    return BimanualRetractEnv(scaled=False)


@pytest.fixture
def env(shared):
    shared.reset(seed=1)
    return shared


class Told:
    """A task's verdicts on what it is told was felt; nothing moves."""

    def __init__(self, env, monkeypatch):
        self.task, self.runtime, self.simulation = env.task, env.runtime, env.simulation
        self.returned = 0.0
        self._tell({})
        monkeypatch.setattr(type(self.simulation), "grasp", property(lambda _: HELD if self.holds else EMPTY))
        monkeypatch.setattr(self.task, "_feel", self._feel)
        monkeypatch.setattr(self.task, "_look", lambda _: self.uncovered)
        monkeypatch.setattr(self.task, "_from_target", lambda _: np.array([self.place, 0.0, 0.0]))
        monkeypatch.setattr(Pair, "collision_force", property(lambda _: self.collision))

    def _tell(self, changes):
        """Values felt from now on: all as success asks, but for the changes."""
        usual = {"holds": True, "place": 0.0, "uncovered": 1.0, "force": 0.5, "collision": 0.0}
        for name, value in {**usual, **changes}.items():
            setattr(self, name, value)

    def _feel(self, _):
        self.task.uncovered_share, self.task.touch_force = self.uncovered, self.force

    def step(self, count=1, force_peak=0.0, fault="", **changes):
        self._tell(changes)
        for _ in range(count):
            self.task.step_count += 1
            self._feel(None)
            step = ControlStep(self.simulation, force_peak, fault)
            if not fault:
                self.task.update(step)
            verdict = self.runtime.judge(step)
            self.returned += sum(verdict.rewards.values())
        return verdict


@pytest.fixture
def episode(env, monkeypatch):
    return Told(env, monkeypatch)


def test_success_is_a_gentle_touch_of_the_exposed_target_for_half_a_second(episode):
    assert not episode.step(9).terminated
    verdict = episode.step()
    assert verdict.terminated and verdict.info["success"] and verdict.rewards["success"] == 10.0


@pytest.mark.parametrize(
    "missing", [{"holds": False}, {"uncovered": 0.79}, {"force": 0.29}, {"force": 1.01}, {"place": 0.0081}]
)
def test_nothing_of_it_may_be_missing(episode, missing):
    """Neither all the time nor in one step of ten."""
    assert not episode.step(20, **missing).info["success"]
    episode.step(9)
    assert not episode.step(**missing).terminated
    assert not episode.step(9).terminated
    assert episode.step().info["success"]


@pytest.mark.parametrize(
    ("harm", "key"),
    [
        ({"collision": 2.1}, "collided"),
        ({"force": 2.1}, "hard_limit"),
        ({"force_peak": 2.1}, "hard_limit"),
        ({"fault": "told so"}, None),
    ],
)
def test_harm_ends_it_and_is_named(episode, harm, key):
    episode.step(9)
    verdict = episode.step(**harm)
    assert verdict.terminated and not verdict.info["success"]
    assert key is None or verdict.info[key]


def test_the_weights_put_every_failure_below_every_full_episode():
    """The inequality of the table's comment."""
    w = reward_weights(BimanualRetractTask)
    gains = w["visible"] + w["grasped"] + w["near"] + w["touched"]
    assert w["forgone"] == pytest.approx(w["time"] + w["soft_force"])
    for failure in ("torn", "hard_force", "collided", "fault"):
        assert -HIDDEN_SHARE * w["visible"] - w["near"] + EPISODE_STEPS * w["soft_force"] - gains - w[failure] > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("harm", [{"collision": 9.0}, {"force": 9.0}, {"force_peak": 9.0}, {"fault": "told so"}])
def test_no_failed_episode_returns_more_than_the_worst_full_one(episode, harm):
    start = {"visible": HIDDEN_SHARE, "grasped": 0.0, "near": 1.0, "touched": 0.0}
    episode.runtime._reached = dict(start)
    lost = {"holds": False, "uncovered": 0.0, "place": 1.0, "force": 0.0}
    assert episode.step(EPISODE_STEPS, force_peak=episode.runtime.force_limit, **lost).truncated
    worst, episode.returned = episode.returned, 0.0
    for steps in (1, 5, 300, 600):
        episode.runtime.draw(np.random.default_rng(0))
        episode.runtime._reached, episode.returned = dict.fromkeys(start, 0.0), 0.0
        for step in range(steps - 1):
            episode.step(force=0.0 if step % 9 == 8 else 0.5)
        assert episode.step(**harm).terminated
        assert episode.returned < worst


def test_both_arms_go_as_told_and_only_the_left_jaw_closes(env):
    pair = env.simulation.instrument
    tips = [pair.arms[side].tip_position for side in ("left", "right")]
    action = env.layout.action(np.array([0.0, 0.004, 0.0]), jaw=-1.0, right=np.array([0.002, 0.0, 0.004]))
    assert action.shape == (13,)
    for _ in range(10):
        observation = env.step(action.astype(np.float32))[0]
    moved = [pair.arms[side].tip_position - tip for side, tip in zip(("left", "right"), tips)]
    np.testing.assert_allclose(moved[0], [0.0, 0.002, 0.0], atol=2e-4)
    np.testing.assert_allclose(moved[1], [0.001, 0.0, 0.002], atol=2e-4)
    slices = env.observation_slices
    np.testing.assert_allclose(observation[slices["right_position"]], pair.arms["right"].tip_position, atol=1e-7)
    assert observation[slices["opening"]] < 0.010
    assert observation[slices["arm_distance"]] == pytest.approx(pair.distance, abs=1e-6)


def test_any_two_arms_are_a_pair(tmp_path):
    assert pair_names("psm_pair") == pair_names("psm_retractor+psm_palpator") == ("psm_retractor", "psm_palpator")
    assert pair_names("a+b/mine.toml+six_axis") == ("a+b/mine.toml", "six_axis")
    for model in ("psm_retractor", "my+arm.toml", "psm_retractor+", "+six_axis", "probe.xml"):
        assert pair_names(model) is None, model
    pair = BimanualRetractEnv(instrument="psm_retractor+six_axis").simulation.instrument
    assert [arm.arm.description.name for arm in pair.arms.values()] == ["psm_retractor", "six_axis"]


@pytest.mark.parametrize(
    ("offset", "force", "touches"),
    [
        ((0.0, 0.0, 0.0), 0.6, True),
        ((0.0079, 0.0, 0.0001), 0.3, True),
        ((0.0, 0.0081, 0.0), 0.6, False),
        ((0.0, 0.0, 0.0005), 0.6, False),  # the neck bears, the ball is lifted off
        ((0.0, 0.0, 0.0), 0.29, False),
        ((0.0, 0.0, 0.0), 1.01, False),
    ],
)
def test_target_is_touched_with_the_ball_alone(env, monkeypatch, offset, force, touches):
    """On the disc of 8 mm, the ball's lowest point down on it, with 0.3 to 1.0 N."""
    env.reset(seed=0)
    monkeypatch.setattr(env.task, "_from_target", lambda _: np.array(offset))
    monkeypatch.setattr(env.task, "touch_force", force)
    assert env.task.touches(env.simulation) is touches
