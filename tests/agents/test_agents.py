"""Agents of other packages learn."""

import gymnasium as gym
import pytest

import surgsim_env  # noqa: F401


@pytest.mark.agents
def test_ppo_learns_a_few_steps():
    stable_baselines3 = pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")
    env = gym.make("SurgSim/Palpate-v0")
    model = stable_baselines3.PPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, seed=0, device="cpu")
    model.learn(64)
    action, _ = model.predict(env.reset(seed=0)[0], deterministic=True)
    assert env.action_space.contains(action)
