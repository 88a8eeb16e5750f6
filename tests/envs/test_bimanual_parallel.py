"""Two agents of one bimanual retraction, as PettingZoo has them: its own tests, and equality with the joint one."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

from surgsim_env.envs.bimanual_parallel import BimanualRetractParallelEnv
from surgsim_env.envs.ids import BimanualRetractEnv


@pytest.fixture(scope="module")
def env():
    return BimanualRetractParallelEnv()


def test_passes_pettingzoos_own_test(env):
    parallel_api_test(env, num_cycles=20)


def test_a_pickled_environment_goes_on_as_it_does(env):
    env.reset(seed=3)
    still = {agent: np.zeros(env.action_space(agent).shape, dtype=np.float32) for agent in env.agents}
    env.step(still)
    twin = pickle.loads(pickle.dumps(env))
    result, other = env.step(still), twin.step(still)
    assert result[0]["left"].tobytes() == other[0]["left"].tobytes() and result[1:] == other[1:]


def test_seeds_repeat():
    parallel_seed_test(BimanualRetractParallelEnv, num_cycles=8)


def test_it_is_the_joint_environment_cut_in_two(env):
    joint = BimanualRetractEnv()
    observations, infos = env.reset(seed=5)
    expected, info = joint.reset(seed=5)
    rng = np.random.default_rng(0)
    for _ in range(6):
        for agent in ("left", "right"):
            np.testing.assert_array_equal(observations[agent], expected)
            assert infos[agent] == info
        action = rng.uniform(-1.0, 1.0, 13).astype(np.float32)
        observations, rewards, ends, cuts, infos = env.step({"left": action[:7], "right": action[7:]})
        expected, reward, terminated, truncated, info = joint.step(action)
        assert rewards == {"left": reward, "right": reward}
        assert ends == dict.fromkeys(ends, terminated) and cuts == dict.fromkeys(cuts, truncated)


def test_an_end_ends_it_for_both_and_time_runs_out(env):
    env.reset(seed=1)
    still = {agent: np.zeros(env.action_space(agent).shape, dtype=np.float32) for agent in env.agents}
    env.joint.task.step_count = 598
    assert not any(env.step(still)[3].values()) and env.agents == ["left", "right"]
    assert all(env.step(still)[3].values()) and env.agents == []
    with pytest.raises(gym.error.ResetNeeded):
        env.step(still)
