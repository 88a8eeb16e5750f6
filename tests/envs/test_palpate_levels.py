"""SurgSim/Palpate-v0 with a level: one lesion whatever the level says, the rest as it says; the cost."""

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401

ID = "SurgSim/Palpate-v0"
DOWN = np.array([0.0, 0.0, -0.6, 0.0], dtype=np.float32)


@pytest.mark.parametrize("level", ["easy", "standard", "hard"])
def test_there_is_one_lesion_whatever_the_level(level: str):
    env = gym.make(ID, scene="phantom_small", level=level).unwrapped
    drawn = []
    for seed in range(8):
        env.reset(seed=seed)
        drawn.append(env.task.drawn)
        assert len(env.task.lesions) == 1 and env.task.lesion is env.task.lesions[0]
    assert len({draw.background for draw in drawn}) == 8
    assert any(draw.capsule_stiffness > 0.0 for draw in drawn) == (level != "easy")


def test_without_a_level_the_scene_is_as_it_is():
    env = gym.make(ID, scene="phantom_small").unwrapped
    env.reset(seed=0)
    assert (env.task.drawn.background, env.task.drawn.capsule_stiffness) == (1.0, 0.0)
    assert not env.scene.timing.mass_scaling and env.scene.sensor.noise == 0.005
    with pytest.raises(ValueError, match=r"level 'normal' is unknown.*easy, standard, hard"):
        gym.make(ID, level="normal")


def test_cost_is_the_force_beyond_the_soft_limit():
    """0 at the soft limit, 1 at the hard one, beyond it in the step that passes it; the reward's share ends at 1."""
    env = gym.make(ID, scene="phantom_small").unwrapped
    env.reset(seed=1)
    limits, costs, over = env.scene.limits, [], False
    while not over:
        _, _, over, _, info = env.step(DOWN)
        expected = max(0.0, (info["force_peak"] - limits.soft_force) / (limits.hard_force - limits.soft_force))
        assert info["cost"] == pytest.approx(expected)
        assert info["reward_soft_force"] == pytest.approx(-0.01 * min(expected, 1.0))
        costs.append(info["cost"])
    assert costs[0] == 0.0 and costs[-1] > 1.0 and any(0.0 < cost < 1.0 for cost in costs)
