"""The scripts in agents/ run and do what they say."""

import sys
from pathlib import Path

import gymnasium as gym
import pytest

import surgsim_env  # noqa: F401

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "agents"))


@pytest.mark.slow
def test_raster_agent_finds_the_lesion():
    import raster

    env = gym.make("SurgSim/Palpate-v0")
    record = raster.run_episode(env, raster.RasterAgent(), seed=1)
    assert record["declared"] and record["success"]
    assert record["error_mm"] < 5.0
    assert record["return"] > 7.0


@pytest.mark.agents
def test_ppo_learns_a_few_steps():
    stable_baselines3 = pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")
    env = gym.make("SurgSim/Palpate-v0")
    model = stable_baselines3.PPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, seed=0, device="cpu")
    model.learn(64)
    action, _ = model.predict(env.reset(seed=0)[0], deterministic=True)
    assert env.action_space.contains(action)
