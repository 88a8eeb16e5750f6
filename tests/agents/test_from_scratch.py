"""Learning from scratch: rewards of a curriculum, repeated actions, the touch summary, a run that is resumed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.agents
pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")


def environments(stage: dict | None, count: int = 3):
    """Environments with the rewards of a stage, or bare ones."""
    from surgsim_apps.training.curriculum import Stage, StagedRewards
    from surgsim_apps.training.palpate_surrogate import PalpateSurrogate
    from surgsim_env.envs.stable_baselines import VectorEnvForStableBaselines

    bare = VectorEnvForStableBaselines(PalpateSurrogate(count))
    return bare if stage is None else StagedRewards(bare, Stage(**stage))


def pressed_down(stage: dict | None):
    """Rewards and sites felt, (n_step, n_env) each, and the last infos, of a way straight down to the hard limit."""
    envs = environments(stage)
    envs.seed(3)
    envs.reset()
    visited = envs.get_attr("unwrapped", indices=[0])[0].observation_slices["visited"]
    rewards, felt, last = [], [], [{}] * envs.num_envs
    down = np.tile(np.array([0.0, 0.0, -0.5, 0.0], dtype=np.float32), (envs.num_envs, 1))
    for _ in range(60):
        observation, reward, done, infos = envs.step(down)
        rewards.append(reward)
        felt.append(np.asarray(observation)[:, visited].sum(axis=1))
        last = [info if over else old for info, over, old in zip(infos, done, last, strict=True)]
        if all(last):
            break
    return np.array(rewards), np.array(felt), last


def test_a_stage_pays_its_share_of_a_failure_and_nothing_else():
    bare, _, ends = pressed_down(None)
    full, _, _ = pressed_down({})
    none, _, _ = pressed_down({"failure": 0.0})
    some, _, _ = pressed_down({"failure": 0.25})
    assert all(end["hard_limit"] for end in ends)
    np.testing.assert_array_equal(full, bare)
    # A failure costs 5 and 0.015 for each control step left; what remains are time and force, at most 0.015 a step.
    assert bare.min() < -12.0 and none.min() >= -0.0151
    np.testing.assert_allclose(some, none + 0.25 * (bare - none), atol=1e-5)
    assert (none[bare > -1.0] == bare[bare > -1.0]).all()


def test_each_site_pays_once_in_an_episode():
    bare, felt, _ = pressed_down(None)
    paid, _, _ = pressed_down({"novelty": 0.5})
    before = np.vstack([np.zeros(felt.shape[1]), felt[:-1]])
    ended = bare < -1.0
    new = np.where(ended, 0.0, felt - before)
    assert new.sum() == felt.shape[1]  # straight down: one site each
    np.testing.assert_allclose(paid - bare, 0.5 * new, atol=1e-6)


@pytest.mark.parametrize(("near", "paid_as_right"), [(0.0, False), (0.05, True)])
def test_a_near_declaration_is_paid_as_a_right_one(near: float, paid_as_right: bool):
    envs = environments({"failure": 0.5, "near": near})
    bare = environments(None)
    rewards, ends = [], []
    for vector in (envs, bare):
        vector.seed(4)
        vector.reset()
        # Down into the tissue, and the lesion declared at once: on 30 mm no place is 50 mm away.
        act = np.tile(np.array([0.0, 0.0, -0.5, 1.0], dtype=np.float32), (3, 1))
        seen = [vector.step(act) for _ in range(20)]
        rewards.append(np.array([reward for _, reward, _, _ in seen]))
        ends.append([(done, infos) for _, _, done, infos in seen])
    wrong = 0
    for step, (done, infos) in enumerate(ends[0]):
        for index in np.flatnonzero(done):
            assert infos[index]["declared"]
            if infos[index]["success"]:
                continue
            wrong += 1
            cost = infos[index]["reward_wrong"] + infos[index]["reward_forgone"]
            # A right declaration pays 10 and costs nothing; a wrong one costs half here.
            added = 10.0 - cost if paid_as_right else -0.5 * cost
            assert cost < -5.0 and rewards[0][step, index] == pytest.approx(rewards[1][step, index] + added, abs=1e-4)
    assert wrong


class Counting:
    """A vector environment of two that observe how often they were stepped; the first ends after three steps."""

    num_envs = 2

    def __init__(self):
        from gymnasium.spaces import Box

        self.observation_space, self.action_space = Box(-100, 100, (2,)), Box(-1, 1, (1,))
        self.count, self.received, self.render_mode = np.zeros(2), [], None
        self.reset_infos = [{}, {}]

    def reset(self):
        return np.stack([self.count, self.count], axis=1)

    def step(self, actions):
        self.received.append(actions[:, 0].tolist())
        self.count += 1
        done = self.count >= [3, 99]
        infos = [{"terminal_observation": np.full(2, self.count[0])} if done[0] else {}, {}]
        reward = self.count.copy()
        self.count[done] = 0
        return np.stack([self.count, self.count], axis=1), reward, done, infos

    def get_attr(self, name, indices=None):
        return [getattr(self, name)] * 2


def test_a_repeated_action_sums_rewards_and_does_nothing_after_an_end():
    from surgsim_apps.training.curriculum import RepeatedAction

    envs = RepeatedAction(Counting(), 4)
    envs.reset()
    observation, reward, done, infos = envs.step(np.ones((2, 1)))
    assert reward.tolist() == [1 + 2 + 3, 1 + 2 + 3 + 4] and done.tolist() == [True, False]
    assert envs.venv.received == [[1, 1]] * 3 + [[0, 1]]
    assert infos[0]["terminal_observation"].tolist() == [3, 3] and observation[:, 0].tolist() == [1, 4]
    _, reward, done, _ = envs.step(np.ones((2, 1)))
    assert reward.tolist() == [1 + 2 + 3, 5 + 6 + 7 + 8], "the zeros' reward counts for the episode that they began"


def test_the_touch_summary_is_what_it_says():
    import torch

    from surgsim_apps.training.touch_features import TouchSummary

    envs = environments(None, count=8)
    envs.seed(5)
    observation = np.asarray(envs.reset())
    rng = np.random.default_rng(0)
    extractor = TouchSummary()
    assert (extractor(torch.tensor(observation))[:, 8:10] == 0.0).all()
    for step in range(40):
        way = np.column_stack([rng.uniform(-1.0, 1.0, (8, 2)), np.full(8, -0.3 if step < 25 else 0.0), np.zeros(8)])
        observation = np.asarray(envs.step(way.astype(np.float32))[0])
    features = extractor(torch.tensor(observation)).numpy()
    assert features.shape == (8, extractor.features_dim) == (8, 16)
    env = envs.get_attr("unwrapped", indices=[0])[0]
    channel = {name: env.si_values(observation)[:, part] for name, part in env.layout.observation_slices.items()}
    felt = channel["visited"].sum(axis=1)
    assert (felt > 0).any()
    for row in np.flatnonzero(felt):
        sites = channel["visited"][row] > 0.5
        mean, most = channel["contrast"][row][sites].mean(), channel["stiffest"][row, 2]
        share = felt[row] / channel["face"][row].sum()
        np.testing.assert_allclose(features[row, 8:11], [share, 1.0, mean], rtol=1e-4)
        np.testing.assert_allclose(features[row, 11], np.clip(4.0 * (most / max(mean, 0.1) - 1.0), -4, 4), atol=1e-3)
        # The outermost sites lie up to half a cell, 2 mm, nearer to the middle than the summary takes them to be.
        place = env.task.memory.chart.plane_point(channel["stiffest"][row, :2])
        np.testing.assert_allclose(features[row, 12:14], (place - channel["tip_position"][row, :2]) / 0.01, atol=0.21)
        # The mean way to sites not felt, of the touch map's own sites.
        sites = env.task.memory.chart.plane_point(env.task.memory.map.places)
        tip = channel["tip_position"][row, :2]
        unfelt = channel["face"][row] * (1.0 - channel["visited"][row])
        unfelt = unfelt * np.exp(-0.5 * ((sites - tip) ** 2).sum(axis=1) / 0.008**2)
        np.testing.assert_allclose(features[row, 14:], (unfelt @ sites / unfelt.sum() - tip) / 0.01, atol=0.21)
    np.testing.assert_allclose(features[:, 3], 4.0 * channel["contact_force"][:, 2] / 0.5, rtol=1e-4, atol=1e-4)
    assert np.abs(features).max() < 8.0


def test_a_run_leaves_a_policy_that_plays_and_is_resumed(tmp_path: Path, monkeypatch):
    from agents import learn_from_scratch
    from agents.learn_from_scratch import RECIPES, train
    from surgsim_apps.training.curriculum import Stage
    from surgsim_apps.training.policy_files import load_policy

    recipe = RECIPES["palpate"]
    stages = (recipe.stages[0], Stage(256, novelty=0.1))
    recipe = replace(recipe, stages=stages, settings={**recipe.settings, "n_steps": 8, "batch_size": 32, "n_epochs": 1})
    monkeypatch.setattr(learn_from_scratch, "ENVS", 4)
    monkeypatch.setattr(learn_from_scratch, "EPISODES", 4)
    model = train(recipe, tmp_path, 0, decisions=64, every=64)
    assert model.num_timesteps == 64 and model.get_env().venv.stage == stages[0]
    again = train(recipe, tmp_path, 0, decisions=288, every=288)
    assert again.num_timesteps == 288 and again.get_env().venv.stage == stages[1]
    assert (tmp_path / "from_64" / "progress.csv").is_file() and (tmp_path / "from_0" / "evaluations.npz").is_file()
    # A run that ended is not trained again, a lost policy comes back, and a checkpoint without its scales is none.
    (tmp_path / "policy.json").unlink()
    (tmp_path / "checkpoint_9999_steps.zip").write_bytes(b"half")
    assert train(recipe, tmp_path, 0, decisions=288, every=288).num_timesteps == 288
    with pytest.raises(ValueError, match="seed"):
        train(recipe, tmp_path, 1, decisions=288, every=288)
    policy = load_policy(tmp_path / "policy.json")
    assert policy.description.trained_steps == 288 and policy.description.action_repeat == 5
    envs = environments(None)
    policy.check_environment(envs.get_attr("unwrapped", indices=[0])[0])
    policy.reset(3)
    acted = np.array([policy.act(np.asarray(envs.reset())) for _ in range(5)])
    assert acted.shape == (5, 3, 4) and (np.abs(acted) <= 1.0).all() and (acted[0] == acted[4]).all()


def test_a_new_policy_begins_with_the_actions_of_its_recipe():
    from agents.learn_from_scratch import RECIPES, begin

    recipe, envs = RECIPES["palpate"], environments(None)
    policy = begin(recipe, envs, 0).policy
    np.testing.assert_allclose(policy.log_std.detach().exp(), recipe.spread, rtol=1e-6)
    # Orthogonal weights of gain 0.01 on 64 features in [-1, 1]: means lie near the bias.
    action = policy.predict(np.asarray(envs.reset()), deterministic=True)[0]
    np.testing.assert_allclose(action, np.tile(recipe.action, (3, 1)), atol=0.08)
