"""Behaviour cloning finds policies that are known, and hands on a model that learns on."""

import gymnasium as gym
import numpy as np
import pytest

pytestmark = pytest.mark.agents
pytest.importorskip("sb3_contrib", reason="needs the `agents` extra")

GAIN = np.array([[0.5, -0.3], [0.2, 0.4], [-0.3, 0.1]])
SCALE = np.array([0.01, 1.0, 100.0])


class Steering(gym.Env):
    """Observations of very different scales; the best action is linear in them. The episode is ten steps long."""

    observation_space = gym.spaces.Box(-1000.0, 1000.0, (3,), dtype=np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return self._observe(), {}

    def step(self, action):
        missed = float(np.square(action - best(self.seen)).sum())
        self.count += 1
        return self._observe(), -missed, False, self.count == 10, {"success": missed < 0.01}

    def _observe(self):
        self.seen = (self.np_random.uniform(-1.0, 1.0, 3) * SCALE).astype(np.float32)
        return self.seen


def best(observation):
    return np.asarray(observation) / SCALE @ GAIN


def made(algorithm="PPO", normalised=True):
    import sb3_contrib
    import stable_baselines3
    import torch
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    torch.set_num_threads(1)
    envs = DummyVecEnv([Steering])
    normalisation = VecNormalize(envs, norm_reward=False) if normalised else None
    of = sb3_contrib if algorithm == "RecurrentPPO" else stable_baselines3
    policy = "MlpLstmPolicy" if algorithm == "RecurrentPPO" else "MlpPolicy"
    model = getattr(of, algorithm)(policy, normalisation or envs, seed=0, device="cpu")
    return model, normalisation


def demonstrations(count=2000, seed=0):
    observations = np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 3)) * SCALE
    return observations.astype(np.float32), best(observations).astype(np.float32)


def missed(model, normalisation):
    """Root mean square error on fresh observations."""
    observations, actions = demonstrations(500, seed=1)
    seen = normalisation.normalize_obs(observations) if normalisation else observations
    return float(np.sqrt(np.square(model.predict(seen, deterministic=True)[0] - actions).mean()))


@pytest.mark.parametrize("algorithm", ["PPO", "SAC"])
def test_a_known_policy_is_found(algorithm):
    from surgsim_env.training.imitation import CloningOptions, clone, normalise_by

    model, normalisation = made(algorithm)
    observations, actions = demonstrations()
    normalise_by(normalisation, observations)
    before = missed(model, normalisation)
    curve = clone(model, observations, actions, normalisation=normalisation, options=CloningOptions(epochs=20))
    # The actions' own spread is 0.3; of a smooth function of three numbers a small network misses little.
    assert before > 0.2 and missed(model, normalisation) < 0.05
    assert curve.validation[curve.best] == min(curve.validation) < 0.01 * curve.validation[0] + 0.003


def test_normalisation_is_the_data_s_own_and_goes_on():
    from surgsim_env.training.imitation import normalise_by

    _, normalisation = made()
    observations, _ = demonstrations()
    observations[:, 1] = 7.0
    normalise_by(normalisation, observations)
    seen = normalisation.normalize_obs(observations)
    np.testing.assert_allclose(seen.mean(axis=0), 0.0, atol=1e-5)
    # Observations of 0.01 have variance 3e-5, beside which the epsilon of VecNormalize, 1e-8, is a part in 3000.
    np.testing.assert_allclose(seen.std(axis=0), [1.0, 0.0, 1.0], rtol=1e-3)
    observations[:, 1] += 1.0
    assert normalisation.normalize_obs(observations)[0, 1] == pytest.approx(1.0)
    assert normalisation.obs_rms.count == 2000
    with pytest.raises(ValueError, match=r"shape \(2000, 2\); the rule"):
        normalise_by(normalisation, observations[:, :2])


def test_what_is_scarce_can_be_weighted():
    """Two actions for the same observation: the mean lies where the weights put it, for each number of the action."""
    from surgsim_env.training.imitation import CloningOptions, clone

    model, _ = made(normalised=False)
    observations = np.zeros((400, 3), dtype=np.float32)
    actions = np.zeros((400, 2), dtype=np.float32)
    actions[:100] = 0.8
    weight = np.where(np.arange(400) < 100, 9.0, 1.0)
    options = CloningOptions(epochs=60, batch_size=32)
    clone(model, observations, actions, sample_weight=weight, options=options)
    # (9 x 100 x 0.8) / (9 x 100 + 300) = 0.6; within what 40 held-out samples and Adam leave.
    assert model.predict(observations[0], deterministic=True)[0] == pytest.approx([0.6, 0.6], abs=0.06)
    clone(model, observations, 0 * actions - 0.4, action_weight=[1.0, 0.0], options=options)
    action = model.predict(observations[0], deterministic=True)[0]
    assert action[0] == pytest.approx(-0.4, abs=0.06) and action[1] > -0.2, "the second has no weight"


def test_spread_is_what_the_policy_misses():
    from surgsim_env.training.imitation import CloningOptions, clone, normalise_by

    model, normalisation = made()
    observations, actions = demonstrations(4000)
    normalise_by(normalisation, observations)
    noisy = actions + np.random.default_rng(2).normal(0.0, [0.4, 0.01], actions.shape)
    options = CloningOptions(epochs=15, std=0.1)
    clone(model, observations, noisy, normalisation=normalisation, options=options)
    spread = model.policy.log_std.exp().detach().numpy()
    # A standard deviation from 400 held-out samples is known to 1 / sqrt(800) = 3.5 %, here within four times that.
    assert spread[0] == pytest.approx(0.4, rel=0.14) and spread[1] == pytest.approx(0.1)


def test_critic_is_fitted_to_returns():
    from surgsim_env.training.imitation import CloningOptions, clone, normalise_by

    model, normalisation = made()
    observations, actions = demonstrations()
    normalise_by(normalisation, observations)
    returns = 3.0 + observations[:, 1]
    options = CloningOptions(epochs=60)
    clone(model, observations, actions, returns=returns, normalisation=normalisation, options=options)
    seen, _ = model.policy.obs_to_tensor(normalisation.normalize_obs(observations))
    value = model.policy.predict_values(seen).detach().numpy()[:, 0]
    assert np.sqrt(np.square(value - returns).mean()) < 0.15 < returns.std() / 3


def test_recurrent_policy_remembers():
    """The action is what was seen in the episode's first step: nothing that a policy without memory could know."""
    from surgsim_env.training.imitation import CloningOptions, clone, pad

    model, _ = made("RecurrentPPO", normalised=False)
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(300):
        episode = np.zeros((rng.integers(3, 7), 3), dtype=np.float32)
        episode[0, :2] = rng.uniform(-1.0, 1.0, 2)
        episodes.append(episode)
    observations, weight = pad(episodes)
    actions = np.repeat(observations[:, :1, :2], observations.shape[1], axis=1)
    for index, episode in enumerate(episodes):
        actions[index, len(episode) :] = 1.0  # not to be learned
        assert weight[index].sum() == len(episode)
    options = CloningOptions(epochs=60, batch_size=32, learning_rate=3e-3)
    clone(model, observations, actions, sample_weight=weight, options=options)
    memory, began = None, np.array([True])
    for step in range(3):
        seen = np.array([0.5, -0.5, 0.0]) if step == 0 else np.zeros(3)
        action, memory = model.predict(seen[None], state=memory, episode_start=began, deterministic=True)
        began = np.array([False])
    np.testing.assert_allclose(action[0], [0.5, -0.5], atol=0.15)


def test_reinforcement_learning_goes_on_from_the_clone(tmp_path):
    """Saved and loaded with its normalisation, the clone acts as before, and a rollout of PPO does not undo it."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    from surgsim_env.training.imitation import CloningOptions, clone, normalise_by

    model, normalisation = made()
    observations, actions = demonstrations()
    normalise_by(normalisation, observations)
    clone(model, observations, actions, normalisation=normalisation, options=CloningOptions(epochs=5))
    model.save(tmp_path / "steer.zip")
    normalisation.save(str(tmp_path / "steer.pkl"))
    envs = VecNormalize.load(str(tmp_path / "steer.pkl"), DummyVecEnv([Steering]))
    loaded = PPO.load(tmp_path / "steer.zip", env=envs, device="cpu")
    np.testing.assert_array_equal(missed(loaded, envs), missed(model, normalisation))
    loaded.learn(2048)
    assert loaded.num_timesteps == 2048 and missed(loaded, envs) < missed(model, normalisation) + 0.1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"observations": np.zeros((9, 2))}, r"observations have shape \(9, 2\); the rule is \(9, 3\)"),
        ({"observations": np.zeros((9, 4, 3))}, r"the rule is \(n, ...\)"),
        ({"actions": np.zeros((8, 2))}, r"actions have shape \(8, 2\); the rule is \(9, 2\)"),
        ({"actions": np.full((9, 2), np.nan)}, "action holds nan; every number must be finite"),
        ({"sample_weight": np.zeros(9)}, "nor all zero"),
        ({"action_weight": [1.0, -1.0]}, "must not be negative"),
    ],
)
def test_what_does_not_fit_is_refused(change, said):
    from surgsim_env.training.imitation import clone

    model, _ = made(normalised=False)
    given = {"observations": np.zeros((9, 3)), "actions": np.zeros((9, 2)), **change}
    with pytest.raises(ValueError, match=said):
        clone(model, given.pop("observations"), given.pop("actions"), **given)


def test_dagger_learns_from_its_own_places():
    from surgsim_env.training.imitation import dagger

    envs = gym.vector.SyncVectorEnv([Steering] * 4, autoreset_mode="SameStep")
    model, normalisation = made()
    began = []

    def expert(observation, begun):
        began.append(begun)
        return best(observation)

    rounds = list(dagger(envs, expert, model, rounds=3, steps=100, normalisation=normalisation))
    assert [item.sample_count for item in rounds] == [400, 800, 1200]
    assert [item.expert_share for item in rounds] == [1.0, 0.5, 0.25]
    assert [item.episode_count for item in rounds] == [40, 40, 40]
    assert rounds[0].success_share == 1.0, "the expert alone"
    assert np.array(began).sum() == 4 * 30 and np.all(began[0]) and not np.any(began[1]) and np.all(began[10])
    assert missed(model, normalisation) < 0.06
    with pytest.raises(ValueError, match="'NextStep'; DAgger needs"):
        next(dagger(gym.vector.SyncVectorEnv([Steering]), expert, model, rounds=1, steps=1))


def test_a_disturbance_is_played_and_not_learned():
    """The expert alone plays, and fails by what is added; its words are learned as ever."""
    from surgsim_env.training.imitation import dagger

    envs = gym.vector.SyncVectorEnv([Steering] * 4, autoreset_mode="SameStep")
    model, normalisation = made()
    settings = {"rounds": 1, "steps": 200, "disturbance": 0.3}
    (only,) = dagger(envs, lambda seen, begun: best(seen), model, normalisation=normalisation, **settings)
    assert only.expert_share == 1.0 and only.success_share < 0.3
    assert missed(model, normalisation) < 0.06
