"""Rewards changed for training: a share of failures, and a potential paid per change."""

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_env.tasks.declaration import ControlStep

PALPATE = {"scene": "phantom_small", "memory": "summary", "episode_steps": 20}


def wrong_declaration(**changed):
    """Rewards and potentials of each control step of a wrong declaration, and its last info."""
    env = gym.make("SurgSim/Palpate-v0", **PALPATE, **changed)
    inner = env.unwrapped
    _, info = env.reset(seed=3)
    rewards, potentials, over = [], [inner.task.potential(ControlStep(inner.simulation))], False
    while not over:
        _, reward, over, truncated, info = env.step(np.array([0.0, 0.0, -0.9, 1.0], dtype=np.float32))
        assert not truncated
        rewards.append(reward)
        potentials.append(inner.task.potential(ControlStep(inner.simulation)))
    assert info["declared"] and not info["success"]
    return np.array(rewards), np.array(potentials), info


def test_shaping_adds_the_change_of_the_potential_and_nothing_else():
    plain, _, _ = wrong_declaration()
    shaped, potentials, info = wrong_declaration(shaping=10.0)
    # Sums of terms near 10 in float64.
    np.testing.assert_allclose(shaped - plain, 10.0 * np.diff(potentials), atol=1e-12)
    assert info["reward_shaping"] == pytest.approx(shaped[-1] - plain[-1], abs=1e-12)
    assert np.abs(np.diff(potentials)).min() > 0.0


def test_failure_share_scales_the_terms_of_a_failure_alone():
    plain, _, info = wrong_declaration()
    less, _, _ = wrong_declaration(failure_share=0.25)
    cost = info["reward_wrong"] + info["reward_forgone"]
    np.testing.assert_allclose(less - plain, [*np.zeros(len(plain) - 1), -0.75 * cost], atol=1e-12)
    assert cost < -5.0


@pytest.mark.parametrize(
    ("env_id", "given", "named"),
    [("SurgSim/Retract-v0", {"shaping": 1.0}, "potential"), ("SurgSim/Palpate-v0", {"failure_share": 1.5}, "1.5")],
)
def test_impossible_changes_are_refused(env_id, given, named):
    with pytest.raises(ValueError, match=named):
        gym.make(env_id, **given)
