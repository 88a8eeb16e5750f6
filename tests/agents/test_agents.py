"""Agents play and learn."""

import gymnasium as gym
import pytest

import surgsim_env  # noqa: F401
from surgsim_env.scoring.results import load_results
from tests.agents.commands import surgsim


@pytest.mark.slow
def test_raster_agent_finds_the_lesion(tmp_path):
    place = ["--env", "SurgSim/Palpate-v0", "--scene", "phantom", "--seeds", "1", "--results", str(tmp_path)]
    surgsim("evaluate", "--agent", "agents.raster:RasterAgent", *place)
    (result,) = load_results(tmp_path)
    assert result.figures["success"].value == 1.0
    assert result.figures["error_mm"].value < 5.0
    assert result.figures["return"].value > 7.0


@pytest.mark.agents
def test_ppo_learns_a_few_steps():
    stable_baselines3 = pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")
    env = gym.make("SurgSim/Palpate-v0")
    model = stable_baselines3.PPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, seed=0, device="cpu")
    model.learn(64)
    action, _ = model.predict(env.reset(seed=0)[0], deterministic=True)
    assert env.action_space.contains(action)
