"""Policies as files: read without pickle, equal to the bit, and refused in one line where they are damaged."""

import hashlib
import json
import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("sb3_contrib", reason="needs the `agents` extra")
import gymnasium as gym
import safetensors.torch
import sb3_contrib
import stable_baselines3
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from agents import convert_policy
from agents.convert_policy import convert
from surgsim_env.scoring.episodes import agent_generator
from surgsim_env.training.networks import MOST_WEIGHTS
from surgsim_env.training.policy_files import TrainedPolicy, describe, load_policy, save_policy
from surgsim_env.training.site_policy import CHOICE_SPACE, FEATURE_SPACE, SitePolicy

pytestmark = pytest.mark.agents
OBSERVATION, ACTION = 10, 3


class Spaces(gym.Env):
    """Just spaces: nothing here is stepped."""

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(np.float32([-np.inf, *[-2.0] * 9]), 2.0, (OBSERVATION,))
        self.action_space = gym.spaces.Box(-1.0, 1.0, (ACTION,))


class Sites(gym.Env):
    """Belief maps, and a site's number."""

    observation_space = FEATURE_SPACE
    action_space = CHOICE_SPACE


SMALL = {"net_arch": [8, 4]}
PARTS = {"net_arch": {"pi": [8], "vf": [4, 4]}, "activation_fn": torch.nn.ELU, "log_std_init": -2}
LSTM = {"net_arch": [4], "lstm_hidden_size": 6}
ROLLOUT, REPLAY = {"seed": 0, "n_steps": 8, "batch_size": 8}, {"seed": 0, "buffer_size": 8}


def ppo(**policy_kwargs: Any) -> Any:
    return stable_baselines3.PPO("MlpPolicy", normalised(), policy_kwargs=policy_kwargs, **ROLLOUT)


MODELS: dict[str, Callable[[], Any]] = {
    "PPO": lambda: ppo(**SMALL),
    "separate": lambda: stable_baselines3.PPO("MlpPolicy", normalised(), use_sde=True, policy_kwargs=PARTS, **ROLLOUT),
    "RecurrentPPO": lambda: sb3_contrib.RecurrentPPO("MlpLstmPolicy", normalised(), policy_kwargs=LSTM, **ROLLOUT),
    "SAC": lambda: stable_baselines3.SAC("MlpPolicy", normalised(), policy_kwargs=dict(SMALL), **REPLAY),
    "DQN": lambda: stable_baselines3.DQN("MlpPolicy", Sites(), policy_kwargs=dict(SMALL), **REPLAY),
    "SitePolicy": lambda: stable_baselines3.PPO(SitePolicy, Sites(), **ROLLOUT),
}


def normalised() -> VecNormalize:
    envs = VecNormalize(DummyVecEnv([Spaces]))
    envs.obs_rms.mean[:] = np.linspace(-1.0, 1.0, OBSERVATION)
    envs.obs_rms.var[:] = np.linspace(0.5, 2.0, OBSERVATION)
    return envs


def made(name: str) -> TrainedPolicy:
    model = MODELS[name]()
    belief = name == "SitePolicy"
    description = describe(model, model.get_vec_normalize_env(), env_id="SurgSim/Palpate-v0", belief=belief)
    return TrainedPolicy(model.policy, description)


@pytest.fixture(scope="module")
def shipped(tmp_path_factory) -> Path:
    """The files of one policy."""
    path = tmp_path_factory.mktemp("policy") / "p.safetensors"
    policy = made("PPO")
    save_policy(policy.networks, policy.description, path)
    return path


def copied(shipped: Path, folder: Path) -> Path:
    for file in (shipped, shipped.with_suffix(".json")):
        shutil.copy(file, folder)
    return folder / shipped.name


def rewritten(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change the entries of NAME.json in place."""
    table = json.loads(path.with_suffix(".json").read_text())
    change(table)
    path.with_suffix(".json").write_text(json.dumps(table))


# ---- what is written is what is read --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MODELS)
def test_a_policy_comes_back_with_every_bit(tmp_path: Path, name: str, monkeypatch):
    before, path = made(name), tmp_path / "p.safetensors"
    save_policy(before.networks, before.description, path)

    def unpickled(*arguments: Any, **more: Any) -> None:
        raise AssertionError("something was unpickled")

    for module, function in ((pickle, "load"), (pickle, "loads"), (pickle, "Unpickler"), (torch, "load")):
        monkeypatch.setattr(module, function, unpickled)
    state = torch.get_rng_state()
    after = load_policy(path)
    assert torch.equal(torch.get_rng_state(), state), "a warm start would change the run's random numbers"
    assert {**vars(after.description), "sha256": None} == vars(before.description)
    old, new = before.networks.state_dict(), after.networks.state_dict()
    assert list(old) == list(new) and all(torch.equal(old[one], new[one]) for one in old)
    rng = np.random.default_rng(0)
    for policy in (before, after):
        policy.reset(4)
    for step in range(3):
        # Above 0, as lengths that belief maps need are.
        seen = rng.uniform(0.1, 2.0, (4, *before.observation_shape)).astype(np.float32)
        begins = np.full(4, step == 0)
        assert before.act(seen, begins).tobytes() == after.act(seen, begins).tobytes()


# DQN has no distribution, and state-dependent exploration ("separate") draws its noise once for many steps.
@pytest.mark.parametrize("name", ["PPO", "RecurrentPPO", "SAC", "SitePolicy"])
def test_sampled_actions_of_an_episode_do_not_depend_on_those_beside_it(name: str):
    before = made(name)
    policy = TrainedPolicy(before.networks, replace(before.description, sampled=True))
    rng = np.random.default_rng(0)
    seen = rng.uniform(0.1, 2.0, (5, *policy.observation_shape)).astype(np.float32)

    def played(count: int, at: int, episode: int) -> list[bytes]:
        policy.reset(count)
        for index in range(count):
            policy.begin(index, None, agent_generator(episode if index == at else 100 + index))
        begins = np.ones(count, dtype=bool)
        return [policy(np.repeat(one[None], count, axis=0), begins & (one is seen[0]))[at].tobytes() for one in seen]

    assert played(1, 0, 7) == played(3, 2, 7) != played(3, 2, 8)


def test_networks_without_a_name_are_refused_before_training_ends():
    class Own(torch.nn.Tanh):
        """An activation function that no table has."""

    with pytest.raises(ValueError, match=r"activation_fn is .* which has no name .* known are tanh, relu, elu"):
        describe(ppo(activation_fn=Own), None, env_id="x")

    class OwnPolicy(SitePolicy):
        """A policy that no table has."""

    model = stable_baselines3.PPO(OwnPolicy, Sites(), **ROLLOUT)
    with pytest.raises(ValueError, match=r"the policy OwnPolicy has no name .* known are MlpPolicy, .*SitePolicy"):
        describe(model, None, env_id="x")


def test_another_suffix_is_refused(tmp_path: Path):
    policy = made("PPO")
    with pytest.raises(ValueError, match=r"policy .*old\.zip: the rule is NAME\.safetensors"):
        save_policy(policy.networks, policy.description, tmp_path / "old.zip")
    assert not list(tmp_path.iterdir())


# ---- damage ---------------------------------------------------------------------------------------------------------


def set_entry(*names: str, to: Any) -> Callable[[dict[str, Any]], None]:
    """Set an entry of NAME.json, named by its way there."""

    def change(table: dict[str, Any]) -> None:
        for name in names[:-1]:
            table = table[name]
        table[names[-1]] = to

    return change


ARGUMENTS, SEEN = ("network", "arguments"), ("network", "observation_space")
WRONG_ENTRIES = {
    "algorithm": (set_entry("algorithm", to="PPOO"), r"algorithm 'PPOO' is unknown; did you mean 'PPO'"),
    "no text": (set_entry("algorithm", to=3), 'field "algorithm"'),
    "unknown": (set_entry("netwerk", to=3), r"entry 'netwerk' is unknown there; did you mean 'network'"),
    "old": (lambda table: table.pop("network"), r"entry 'network' is missing; .*agents\.convert_policy"),
    "policy": (set_entry("network", "policy", to="os.system"), r"network\.policy is 'os\.system'; known for PPO are "),
    "activation": (set_entry(*ARGUMENTS, "activation_fn", to="eval"), r"activation_fn is 'eval'; known are tanh, relu"),
    "argument": (
        set_entry(*ARGUMENTS, "net_arc", to=[3]),
        r"'net_arc' is unknown to MlpPolicy.*did you mean",
    ),
    "optimiser": (set_entry(*ARGUMENTS, "optimizer_class", to="Adam"), r"'optimizer_class' is unknown to MlpPolicy"),
    "wide": (set_entry(*ARGUMENTS, "net_arch", to=[90_000, 90_000]), rf"at most {MOST_WEIGHTS}"),
    "deep": (set_entry(*ARGUMENTS, "net_arch", to=[1] * 10_000), r"net_arch has 10000 entries; the rule is at most 64"),
    "width": (set_entry(*ARGUMENTS, "net_arch", to=[8, -4]), r"net_arch holds -4; the rule is 1 to "),
    "other": (set_entry(*ARGUMENTS, "net_arch", to=[8, 5]), r"tensor mlp_extractor\.policy_net\.2\.weight has shape"),
    "layers": (set_entry(*ARGUMENTS, "net_arch", to=[8]), r"tensor 'mlp_extractor\.policy_net\.2\.bias' is unknown"),
    "huge": (set_entry(*SEEN, "shape", to=[10**12]), r"observation_space\.shape is \(1000000000000,\); the rule is "),
    "bounds": (set_entry(*SEEN, "low", to=[1.0]), r"observation_space\.low has 1 entries; the shape \(10,\) needs one"),
    "crossed": (set_entry(*SEEN, "low", to=3.0), r"observation_space\.low is 3\.0 where .*high is 2\.0"),
    "text": (set_entry(*SEEN, "high", to="1"), r"observation_space\.high\[0\] is '1'; the rule is a number, or null"),
    "dtype": (set_entry(*SEEN, "dtype", to="object"), r"observation_space\.dtype is 'object'; known are float32"),
    "kind": (
        set_entry(*SEEN, "kind", to="Graph"),
        r"space\.kind is 'Graph'; the rule is 'Box' or 'Discrete'",
    ),
    "mean": (set_entry("observation_mean", to=[0.0] * 9), r"observation_mean has 9 entries; the networks read \(10,\)"),
    "nan": (
        set_entry("observation_mean", to=[float("nan")] * 10),
        r"observation_mean\[0\] is nan; the rule is",
    ),
    "large": (set_entry("observation_mean", to=[1e308] * 10), r"observation_mean\[0\] is 1e\+308; the rule is"),
    "variance": (set_entry("observation_variance", to=[-1.0] * 10), r"observation_variance\[0\] is -1\.0; the rule is"),
    "half": (set_entry("observation_variance", to=None), r"observation_mean and observation_variance go together"),
    "force": (set_entry("force_entries", to=[10]), r"force_entries\[0\] is 10; the observation has entries 0 to 9"),
    "repeat": (set_entry("action_repeat", to=0), r"action_repeat is 0; it must be 1 to 10000"),
    "repeats": (set_entry("action_repeat", to=2**64), r"action_repeat is 18446744073709551616; it must be 1 to 10000"),
    "belief": (
        set_entry("belief", to=True),
        r"belief is true, for which networks read",
    ),
    "digest": (set_entry("sha256", to="0" * 64), r"its SHA-256 is [0-9a-f]{64}, p\.json has '0{64}'"),
}


@pytest.mark.parametrize("name", WRONG_ENTRIES)
def test_a_wrong_entry_is_named_in_one_line(shipped: Path, tmp_path: Path, name: str):
    path = copied(shipped, tmp_path)
    change, message = WRONG_ENTRIES[name]
    rewritten(path, change)
    with pytest.raises(ValueError, match=message) as refused:
        load_policy(path)
    assert "\n" not in str(refused.value) and len(str(refused.value)) < 600
    assert "p." in str(refused.value) or name == "algorithm"


TEXTS = {
    "empty": (b"", "is not valid JSON"),
    "cut": (b'{"algorithm": "PPO", ', "is not valid JSON"),
    "bytes": (bytes(range(256)), "is not valid JSON"),
    "nested": (b"[" * 100_000, "is not valid JSON"),
    "list": (b"[1, 2]", r"must hold a table of entries, not \[1, 2\]"),
}


@pytest.mark.parametrize("name", TEXTS)
def test_a_text_that_is_no_description_is_refused(shipped: Path, tmp_path: Path, name: str):
    path = copied(shipped, tmp_path)
    content, message = TEXTS[name]
    path.with_suffix(".json").write_bytes(content)
    with pytest.raises(ValueError, match=message) as refused:
        load_policy(path)
    assert "\n" not in str(refused.value) and "p.json" in str(refused.value)


def signed(path: Path, content: bytes) -> None:
    """Replace the weights, and the digest that NAME.json has of them."""
    path.write_bytes(content)
    rewritten(path, set_entry("sha256", to=hashlib.sha256(content).hexdigest()))


def changed_tensor(change: Callable[[dict[str, torch.Tensor]], Any]) -> Callable[[bytes], bytes]:
    def make(content: bytes) -> bytes:
        tensors = safetensors.torch.load(content)
        change(tensors)
        return safetensors.torch.save(tensors)

    return make


def put(name: str, value: float) -> Callable[[dict[str, torch.Tensor]], None]:
    return lambda tensors: tensors[name].view(-1)[0].fill_(value)


WRONG_WEIGHTS: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "empty": (lambda content: b"", "is not a file of safetensors"),
    "cut": (lambda content: content[: len(content) // 2], "is not a file of safetensors"),
    "zeros": (lambda content: bytes(1000), "is not a file of safetensors|tensor"),
    "header": (lambda content: (10**15).to_bytes(8, "little") + content[8:], "is not a file of safetensors"),
    "nan": (changed_tensor(put("log_std", float("nan"))), r"tensor log_std holds nan at \(0,\); every number must be"),
    "long shape": (
        changed_tensor(lambda tensors: tensors.update(log_std=torch.zeros([1] * 2000))),
        r"tensor log_std has shape \(1, 1, .*\.\.\.; the description needs",
    ),
    "long word": (
        lambda content: (3010).to_bytes(8, "little") + b'{"a":"' + b"x" * 3000 + b'"}  ',
        "is not a file of safetensors: .{1,200}$",
    ),
    "large": (
        changed_tensor(put("log_std", 1e30)),
        r"tensor log_std holds 1e\+30 at \(0,\); the rule is at most 1e\+06",
    ),
    "missing": (changed_tensor(lambda tensors: tensors.pop("log_std")), "tensor log_std is missing"),
    "more": (changed_tensor(lambda tensors: tensors.update(x=torch.zeros(1))), "tensor 'x' is unknown"),
    "type": (
        changed_tensor(lambda tensors: tensors.update(log_std=tensors["log_std"].double())),
        r"tensor log_std has type torch\.float64; the description needs torch\.float32",
    ),
}


@pytest.mark.parametrize("name", WRONG_WEIGHTS)
def test_wrong_weights_are_refused_in_one_line(shipped: Path, tmp_path: Path, name: str):
    path = copied(shipped, tmp_path)
    change, message = WRONG_WEIGHTS[name]
    signed(path, change(path.read_bytes()))
    with pytest.raises(ValueError, match=message) as refused:
        load_policy(path)
    assert "\n" not in str(refused.value) and "p.safetensors" in str(refused.value) and len(str(refused.value)) < 700


def test_a_flipped_bit_of_the_weights_is_noticed(shipped: Path, tmp_path: Path):
    path = copied(shipped, tmp_path)
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"its SHA-256 is .* the two are not of one policy, or one is damaged"):
        load_policy(path)


def test_an_index_that_the_architecture_fixes_is_not_taken_from_the_file(tmp_path: Path):
    from surgsim_env.training.extractors import PlaceAndForce

    model = ppo(features_extractor_class=PlaceAndForce, **SMALL)
    path = tmp_path / "p.safetensors"
    save_policy(model.policy, describe(model, None, env_id="x"), path)
    load_policy(path)
    signed(path, changed_tensor(put("features_extractor.entries", 900))(path.read_bytes()))
    with pytest.raises(ValueError, match=r"tensor features_extractor\.entries holds 900 at \(0,\); .* is 0"):
        load_policy(path)


def test_files_that_are_missing_are_named(shipped: Path, tmp_path: Path):
    path = copied(shipped, tmp_path)
    with pytest.raises(ValueError, match=r"there is no file p\.zip there; p\.safetensors is"):
        load_policy(path.with_suffix(".zip"), trust_pickle=True)
    path.with_suffix(".json").unlink()
    with pytest.raises(ValueError, match=r"there is no file p\.json there"):
        load_policy(path)
    with pytest.raises(ValueError, match=r"the rule is NAME\.safetensors"):
        load_policy(tmp_path / "p.pt")


def test_an_environment_of_another_shape_is_refused(shipped: Path):
    policy = load_policy(shipped)
    policy.check_environment(Spaces())
    with pytest.raises(ValueError, match=r"the policy has observations of shape \(10,\), SurgSim/Palpate-v0 with"):
        policy.check_environment(Sites())


# ---- zips of stable-baselines3 --------------------------------------------------------------------------------------


class Payload:
    """Makes a file when it is unpickled."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.file,)


@pytest.fixture
def zipped(shipped: Path, tmp_path: Path) -> Path:
    """A zip that runs code when it is read, with a description as an earlier version wrote it."""
    path = copied(shipped, tmp_path).with_suffix(".zip")
    rewritten(path, lambda table: [table.pop(name) for name in ("network", "sha256")])
    path.with_suffix(".safetensors").unlink()
    model = MODELS["PPO"]()
    model.payload = Payload(tmp_path / "ran")
    model.save(path)
    return path


def test_a_zip_is_read_only_where_it_is_trusted(zipped: Path):
    ran = zipped.with_name("ran")
    for read in (load_policy, convert):
        with pytest.raises(ValueError, match=r"zip of pickles, which runs any code .* or --trust-pickle if you trust"):
            read(zipped)
    assert not ran.exists(), "its code ran"
    with pytest.warns(UserWarning, match="is read with pickle, which runs any code"):
        policy = load_policy(zipped, trust_pickle=True)
    assert ran.exists(), "the control: this zip runs code"
    assert policy.act(np.zeros((1, OBSERVATION), dtype=np.float32)).shape == (1, ACTION)


def test_a_zip_is_converted_with_every_bit(zipped: Path):
    with pytest.warns(UserWarning, match="is read with pickle"):
        path = convert(zipped, trust_pickle=True)
        before = load_policy(zipped, trust_pickle=True)
    after = load_policy(path)
    seen = np.random.default_rng(1).normal(size=(50, OBSERVATION)).astype(np.float32)
    for policy in (before, after):
        policy.reset(50)
    assert before.act(seen).tobytes() == after.act(seen).tobytes()


def test_a_zip_of_a_policy_on_belief_maps_is_converted(tmp_path: Path):
    policy, model = made("SitePolicy"), MODELS["SitePolicy"]()
    save_policy(policy.networks, policy.description, tmp_path / "p.safetensors")
    (tmp_path / "p.safetensors").unlink()
    model.save(tmp_path / "p.zip")
    with pytest.warns(UserWarning, match="is read with pickle"):
        assert load_policy(convert(tmp_path / "p.zip", trust_pickle=True)).description.belief
    assert sorted(path.name for path in tmp_path.iterdir()) == ["p.json", "p.safetensors", "p.zip"]


def test_a_policy_that_acts_otherwise_is_not_kept(zipped: Path, monkeypatch: pytest.MonkeyPatch):
    described = zipped.with_suffix(".json").read_bytes()
    monkeypatch.setattr(convert_policy, "load_policy", lambda path: made("SAC"))
    with (
        pytest.warns(UserWarning, match="is read with pickle"),
        pytest.raises(ValueError, match=r"p\.zip is not converted: .* it acts differently"),
    ):
        convert(zipped, trust_pickle=True)
    assert zipped.with_suffix(".json").read_bytes() == described
    assert not zipped.with_suffix(".safetensors").exists()


def test_a_damaged_zip_is_refused_in_one_line(zipped: Path):
    zipped.write_bytes(zipped.read_bytes()[:200])
    with (
        pytest.warns(UserWarning, match="is read with pickle"),
        pytest.raises(ValueError, match=r"policy .*p\.zip cannot be read as a PPO: ") as refused,
    ):
        load_policy(zipped, trust_pickle=True)
    assert "\n" not in str(refused.value)
