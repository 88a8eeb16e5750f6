"""Learning from scratch: repeated actions, and a run that leaves a policy."""

from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.agents
pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")


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
    from agents.learn_from_scratch import RepeatedAction

    envs = RepeatedAction(Counting(), 4)
    envs.reset()
    observation, reward, done, infos = envs.step(np.ones((2, 1)))
    assert reward.tolist() == [1 + 2 + 3, 1 + 2 + 3 + 4] and done.tolist() == [True, False]
    assert envs.venv.received == [[1, 1]] * 3 + [[0, 1]]
    assert infos[0]["terminal_observation"].tolist() == [3, 3] and observation[:, 0].tolist() == [1, 4]
    _, reward, done, _ = envs.step(np.ones((2, 1)))
    assert reward.tolist() == [1 + 2 + 3, 5 + 6 + 7 + 8], "the zeros' reward counts for the episode that they began"


def test_a_run_leaves_checkpoints_and_a_policy_that_plays(tmp_path: Path):
    import gymnasium as gym

    from agents.learn_from_scratch import ENV_ID, SPREAD, train
    from surgsim_apps.training.policy_files import load_policy

    model = train(tmp_path, 3, count=2, decisions=16, rollout=8)
    assert model.num_timesteps == 16 and (tmp_path / "progress.csv").is_file()
    assert (tmp_path / "rl_model_16_steps.zip").is_file()
    policy = load_policy(tmp_path / "policy.json")
    assert policy.description.trained_steps == 16 and policy.description.action_repeat == 5
    np.testing.assert_allclose(policy.decider.log_spread.exp(), SPREAD, rtol=0.05)
    env = gym.make(ENV_ID)
    policy.check_environment(env)
    policy.reset(1)
    observation, _ = env.reset(seed=0)
    acted = [policy.act(observation[None]) for _ in range(5)]
    assert (np.abs(acted) <= 1.0).all() and (acted[0] == acted[4]).all()
