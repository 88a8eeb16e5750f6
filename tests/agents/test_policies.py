"""Policies: their files hold every bit, damaged ones are refused in a line, and actions follow from the episode."""

import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("safetensors", reason="needs the `agents` extra")
import torch

import surgsim_env  # noqa: F401
from surgsim_apps.scoring.episodes import agent_generator
from surgsim_apps.training.policy_files import (
    PolicyDescription,
    TrainedPolicy,
    load_policy,
    observation_declaration,
    save_policy,
)
from surgsim_apps.training.policy_network import NetworkLayout, PolicyNetwork, actor_of

pytestmark = pytest.mark.agents
ENV_ID = "SurgSim/Palpate-v0"
SIZES = (11, 8, 4)


def network(*, drawn: bool = False) -> PolicyNetwork:
    torch.manual_seed(0)
    made = PolicyNetwork(NetworkLayout("elu"), SIZES, normalised=True, drawn=drawn)
    made.normalise_by(np.random.default_rng(0).normal(1.0, 2.0, (50, SIZES[0])))
    return made


def seen(count: int) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(count, SIZES[0])).astype(np.float32)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """The files of a policy."""
    save_policy(network(), PolicyDescription(ENV_ID, seed=3), tmp_path / "p.json")
    return tmp_path / "p.json"


@pytest.mark.parametrize("drawn", [False, True])
def test_a_policy_comes_back_with_every_bit(tmp_path: Path, drawn: bool):
    before = save_policy(network(drawn=drawn), PolicyDescription(ENV_ID, action_repeat=2), tmp_path / "p.json")
    after = load_policy(tmp_path / "p.safetensors")
    assert after.description == before.description
    for policy in (before, after):
        policy.reset(4)
    for _ in range(3):
        assert before.act(seen(4)).tobytes() == after.act(seen(4)).tobytes()


def test_observations_are_normalised_by_their_own_mean_and_variance():
    made = PolicyNetwork(NetworkLayout(), SIZES, normalised=True)
    values = np.random.default_rng(0).normal(3.0, 0.1, (500, SIZES[0])).astype(np.float32)
    values[:, 1] = 7.0
    made.normalise_by(values)
    read = made.read(values).numpy()
    np.testing.assert_allclose(read.mean(axis=0), 0.0, atol=1e-4)
    np.testing.assert_allclose(read.std(axis=0), [1.0, 0.0, *[1.0] * (SIZES[0] - 2)], atol=1e-3)
    values[:, 1] += 1.0
    assert made.read(values)[0, 1] == pytest.approx(1.0), "an entry that never changed has the variance 1"


def test_sampled_actions_of_an_episode_do_not_depend_on_those_beside_it():
    policy = TrainedPolicy(network(drawn=True), PolicyDescription(ENV_ID))
    observations = seen(5)

    def played(count: int, at: int, episode: int) -> list[bytes]:
        policy.reset(count)
        for index in range(count):
            policy.begin(index, None, agent_generator(episode if index == at else 100 + index))
        return [policy.act(np.repeat(observation[None], count, axis=0))[at].tobytes() for observation in observations]

    assert played(1, 0, 7) == played(3, 2, 7) != played(3, 2, 8)


def test_a_decision_lasts_as_long_as_the_description_says():
    """With a repeat of two, each environment holds its action for the second step, counted from its own begin."""
    slow = TrainedPolicy(network(), PolicyDescription(ENV_ID, action_repeat=2))
    slow.reset(2)
    # The second one's episode ends after a step: from then on they decide in turns.
    begins = [[True, True], [False, True], [False, False], [False, False]]
    acts = [slow.act(seen(8)[2 * step :][:2], np.array(begun)) for step, begun in enumerate(begins)]
    assert (acts[1][0] == acts[0][0]).all() and (acts[2][1] == acts[1][1]).all() and (acts[3][0] == acts[2][0]).all()
    assert (acts[2][0] != acts[1][0]).any() and (acts[3][1] != acts[2][1]).any()


@pytest.mark.parametrize("drawn", [False, True])
def test_the_actor_of_stable_baselines3_acts_as_its_model(drawn: bool):
    stable_baselines3 = pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")
    model = stable_baselines3.PPO("MlpPolicy", gym.make(ENV_ID), n_steps=8, batch_size=8, seed=0, device="cpu")
    made = actor_of(model.policy, NetworkLayout("tanh"), drawn=drawn)
    wanted, _ = model.predict(seen(3), deterministic=True)
    acted = [made.actions(seen(3), [torch.Generator().manual_seed(n + draw) for n in range(3)]) for draw in range(200)]
    # Means of 200 draws of a unit normal, cut to [-1, 1], are off by 4 x 0.72 / 14 at most.
    np.testing.assert_allclose(np.mean(acted, axis=0), wanted, atol=0.21 if drawn else 1e-6)
    assert (np.std(acted, axis=0) > 0.6).all() == drawn


DAMAGES = {
    "entry": ({"netwerk": 3}, r"entry 'netwerk' is unknown there; did you mean 'network'"),
    "activation": ({"network": {"activation": "eval"}}, r"p\.safetensors: 'eval'"),
    "features": ({"network": {"features": "os"}}, r"p\.safetensors: 'os'"),
    "acquisition": ({"acquisition": [1.0], "network": None}, r"acquisition is \[1.0\]; the rule is 13 finite numbers"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_wrong_entry_is_named_in_one_line(path: Path, name: str):
    change, message = DAMAGES[name]
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(ValueError, match=message) as refused:
        load_policy(path)
    assert "\n" not in str(refused.value)


def test_files_that_are_missing_or_damaged_are_refused(path: Path):
    weights = path.with_suffix(".safetensors")
    content = weights.read_bytes()
    for wrong in (b"", content[: len(content) // 2]):
        weights.write_bytes(wrong)
        with pytest.raises(ValueError, match=r"policy .*p\.safetensors: "):
            load_policy(path)
    weights.unlink()
    with pytest.raises(ValueError, match=r"policy .*p\.safetensors: .*No such file"):
        load_policy(path)
    path.write_text("[1")
    with pytest.raises(ValueError, match=r"policy .*p\.json cannot be read"):
        load_policy(path)
    path.unlink()
    with pytest.raises(ValueError, match=r"policy .*p\.json cannot be read"):
        load_policy(path)


def test_a_policy_does_not_act_on_other_observations():
    env = gym.make(ENV_ID, scene="phantom_small")
    declared = observation_declaration(env)
    policy = TrainedPolicy(network(), PolicyDescription(ENV_ID, {"scene": "phantom_small"}, declared))
    policy.check_environment(env)
    with pytest.raises(ValueError, match="make the environment as the policy's file says"):
        policy.check_environment(gym.make(ENV_ID, scene="phantom_small", memory=True))
    with pytest.raises(ValueError, match=r"was trained on the scene 'phantom_small', .* cannot play 'phantom'"):
        policy.check_environment(gym.make(ENV_ID, scene="phantom"))
