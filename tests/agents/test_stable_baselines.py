"""Vector environments behind the interface of stable-baselines3."""

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401

pytestmark = pytest.mark.agents
pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")


def vector(mode: str = "SameStep"):
    return gym.make_vec(
        "SurgSim/Palpate-v0", num_envs=3, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}
    )


def adapted():
    from surgsim_env.envs.stable_baselines import VectorEnvForStableBaselines

    return VectorEnvForStableBaselines(vector())


def test_other_ways_of_resetting_are_refused():
    from surgsim_env.envs.stable_baselines import VectorEnvForStableBaselines

    with pytest.raises(ValueError, match="autoreset_mode is 'NextStep'"):
        VectorEnvForStableBaselines(vector("NextStep"))


def test_options_are_refused_as_by_one_environment():
    envs = adapted()
    for options in ({"anything": 1}, [{}, {"anything": 1}, {}]):
        envs.set_options(options)
        with pytest.raises(ValueError, match="anything"):
            envs.reset()
    envs.set_options()
    envs.reset()
    envs.close()


def test_seeds_actions_and_ends_go_through():
    """Two press down until the hard limit ends an episode, one stands still."""
    envs, single = adapted(), gym.make("SurgSim/Palpate-v0")
    envs.seed(5)
    observation = envs.reset()
    for index in range(3):
        np.testing.assert_array_equal(observation[index], single.reset(seed=5 + index)[0])
    assert not np.array_equal(envs.reset(), observation), "seeds are used once"
    down = np.tile(np.array([0.0, 0.0, -1.0, 0.0], dtype=np.float32), (3, 1))
    down[1] = 0.0
    before = envs.reset()
    for _ in range(60):
        observation, reward, done, infos = envs.step(down)
        assert reward.shape == done.shape == (3,) and len(infos) == 3
        if done[0]:
            break
        before = observation
    assert done[0] and infos[0]["hard_limit"] and not infos[0]["TimeLimit.truncated"]
    assert np.abs(infos[0]["terminal_observation"][:3] - before[0][:3]).max() < 0.2, "the last place, not the next"
    assert np.abs(observation[0][:3] - before[0][:3]).max() > 0.2, "the next episode's start"
    assert not done[1] and "terminal_observation" not in infos[1]
    assert envs.env_method("get_wrapper_attr", "scene", indices=[2])[0].name == "phantom"
    assert envs.get_attr("render_mode") == [None] * 3 and envs.env_is_wrapped(gym.Wrapper) == [False] * 3
    envs.close()


def test_pictures_go_through():
    from surgsim_env.envs.stable_baselines import VectorEnvForStableBaselines
    from surgsim_env.rendering import gl

    try:
        gl.context()
    except gl.NoGLError as error:
        pytest.skip(f"no pictures on this machine: {error}")
    many = gym.make_vec(
        "SurgSim/Palpate-v0",
        num_envs=3,
        vectorization_mode="vector_entry_point",
        autoreset_mode="SameStep",
        render_mode="rgb_array",
        width=64,
        height=48,
    )
    envs = VectorEnvForStableBaselines(many)
    envs.reset()
    assert envs.render_mode == "rgb_array"
    assert [frame.shape for frame in envs.get_images()] == [(48, 64, 3)] * 3
    # stable-baselines3 puts three into a square of four.
    assert envs.render().shape == (96, 128, 3)
    envs.close()


def test_ppo_learns_on_them():
    from stable_baselines3 import PPO

    model = PPO("MlpPolicy", adapted(), n_steps=16, batch_size=24, n_epochs=1, seed=0, device="cpu")
    model.learn(48)
    assert model.num_timesteps == 48
