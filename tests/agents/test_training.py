"""Training runs: what a configuration may say, a few hundred steps of three algorithms, kills, warm starts."""

import csv
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

pytestmark = pytest.mark.agents
pytest.importorskip("sb3_contrib", reason="needs the `agents` extra")
yaml = pytest.importorskip("yaml", reason="needs the `agents` extra")

CONFIGS = Path(__file__).parents[2] / "agents" / "configs"
ON_POLICY = {"n_steps": 16, "batch_size": 32, "n_epochs": 1}
SETTINGS = {
    "PPO": {"hyperparameters": {**ON_POLICY, "learning_rate": {"linear": 3.0e-4}}},
    "RecurrentPPO": {
        "policy": "MlpLstmPolicy",
        "hyperparameters": {**ON_POLICY, "policy_kwargs": {"lstm_hidden_size": 8, "activation_fn": "tanh"}},
    },
    "SAC": {"hyperparameters": {"learning_starts": 32, "batch_size": 16, "train_freq": 4, "buffer_size": 500}},
}


def table(algorithm: str = "PPO", **changes) -> dict:
    return {
        "name": "tiny",
        "algorithm": algorithm,
        "environment": {"id": "SurgSim/Palpate-v0", "kind": "surrogate", "count": 4, "kwargs": {"memory": False}},
        "total_steps": 320,
        "evaluation": {"every": 128, "episodes": 4},
        "checkpoint": {"every": 64},
        **SETTINGS[algorithm],
        **changes,
    }


def config(algorithm: str = "PPO", **changes):
    from surgsim_env.scene.load import fill
    from surgsim_env.training.config import TrainingConfig

    return fill(TrainingConfig, table(algorithm, **changes), "test")


# ---- configurations ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"algoritm": "PPO"}, "entry 'algoritm' is unknown there; did you mean 'algorithm'"),
        ({"environment": {"id": "x", "knd": "lanes"}}, "did you mean 'kind'"),
        ({"environment": {"id": "x", "kind": "library"}}, "a library file goes with kind"),
        ({"environment": {"id": "x", "count": 0}}, "environment.count is 0; it must be at least 1"),
        ({"warm_spread": 0.1}, "warm_spread is 0.1 and warm_start None"),
        ({"total_steps": "1e6"}, "'1e6' is not a whole number"),
        ({"hyperparameters": {"learning_rate": "3e-4"}}, r"hyperparameters.learning_rate is the text '3e-4'"),
    ],
)
def test_wrong_configurations_are_refused(tmp_path: Path, change: dict, message: str):
    from surgsim_env.training.config import read_config

    file = tmp_path / "wrong.yaml"
    file.write_text(yaml.safe_dump(table() | change))
    with pytest.raises(ValueError, match=message):
        read_config(file)


@pytest.mark.parametrize("file", sorted(CONFIGS.glob("*.yaml")), ids=lambda file: file.stem)
def test_a_run_of_each_shipped_configuration_begins(tmp_path: Path, monkeypatch, file: Path):
    from surgsim_env.training.config import config_text, read_config
    from surgsim_env.training.run import Run

    monkeypatch.chdir(CONFIGS.parents[1])
    read = read_config(file, seed=3)
    assert read.seed == 3 and f"name: {read.name}" in config_text(read)
    if read.warm_start is not None and read.warm_start.startswith("runs/"):
        # An earlier run leaves it.
        read = replace(read, warm_start=None, warm_spread=None)
    run = Run(replace(read, environment=replace(read.environment, count=4)), tmp_path / "run")
    assert run.model.num_timesteps == 0
    run.bare.close()


def test_a_policy_that_was_trained_on_bell_curves_plays_the_environment(tmp_path: Path):
    """Its file declares the observation of the environment that the bell curves stand for."""
    from surgsim_env.training.config import read_config
    from surgsim_env.training.policy_files import load_policy
    from surgsim_env.training.run import train

    read = read_config(CONFIGS / "sites_ppo.yaml")
    small = {"n_steps": 5, "batch_size": 10, "n_epochs": 1}
    environment = replace(read.environment, count=2)
    train(
        replace(
            read,
            total_steps=10,
            environment=environment,
            evaluation=replace(read.evaluation, every=0),
            hyperparameters={**read.hyperparameters, **small},
        ),
        tmp_path,
    )
    (final,) = (tmp_path / "final").iterdir()
    policy, env = load_policy(final / "policy.safetensors"), gym.make(environment.id, scene="phantom_small")
    policy.check_environment(env)
    assert policy.act(env.reset(seed=0)[0][None])[0] in env.action_space


def test_an_unknown_algorithm_is_answered_with_the_nearest():
    from surgsim_env.training.networks import algorithm_class
    from surgsim_env.training.run import keywords

    with pytest.raises(ValueError, match="algorithm 'RecurentPPO' is unknown; did you mean 'RecurrentPPO'"):
        algorithm_class("RecurentPPO")
    with pytest.raises(ValueError, match="activation_fn is 'tanhh'"):
        keywords({"policy_kwargs": {"activation_fn": "tanhh"}})


# ---- runs ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ["PPO", "RecurrentPPO", "SAC"])
def test_a_run_leaves_checkpoints_curves_and_policies_that_play(tmp_path: Path, algorithm: str):
    from surgsim_env.training.environments import make_environments
    from surgsim_env.training.policy_files import load_policy
    from surgsim_env.training.run import play_episodes, train

    settings = config(algorithm)
    assert train(settings, tmp_path) == 320
    assert len(list((tmp_path / "checkpoints").iterdir())) == 2
    assert list(tmp_path.glob("events.out.tfevents*")) and list(tmp_path.glob("progress_*.csv"))
    with (tmp_path / "evaluations.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [int(row["steps"]) for row in rows] == [128, 256, 320]
    best = next((tmp_path / "best").iterdir())
    policy = load_policy(best / "policy.safetensors")
    assert policy.description.algorithm == algorithm
    assert policy.description.score == pytest.approx(max(float(row["return"]) for row in rows), rel=1e-5)
    # What was kept plays what it was kept for: weights and normalisation belong together.
    records = play_episodes(policy, make_environments(settings.environment, 4), 4)
    assert np.mean([record["episode"]["r"] for record in records]) == pytest.approx(policy.description.score, abs=1e-6)
    # A run that is over is over.
    assert train(settings, tmp_path) == 320


# Dies as by SIGKILL from outside, as soon as a checkpoint is there.
KILLED = """
import os, signal, sys
from surgsim_env.cli.main import main
from surgsim_env.training.run import Run

def save_and_die(run, save=Run.save):
    save(run)
    os.kill(os.getpid(), signal.SIGKILL)

Run.save = save_and_die
main(['train', *sys.argv[1:]])
"""


@pytest.mark.parametrize(("algorithm", "kills"), [("PPO", 2), ("SAC", 1)])
def test_a_killed_run_goes_on_and_ends_with_the_same_number_of_steps(tmp_path: Path, algorithm: str, kills: int):
    """A run that is killed with its first checkpoint, perhaps with its next one too, comes to its end."""
    # 5 rollouts of 4 x 16 steps, or of 4 x 4, and a bit: the end is the first whole rollout beyond.
    told = table(algorithm, total_steps=330, evaluation={"every": 0})
    file, folder = tmp_path / "killed.yaml", tmp_path / "run"
    file.write_text(yaml.safe_dump(told))
    given = [str(file), "--out", str(folder), "--no-progress"]
    here = Path(__file__).parents[2]
    settings = {"cwd": here, "env": {**os.environ, "PYTHONPATH": str(here)}, "stdout": subprocess.PIPE, "text": True}
    for _ in range(kills):
        killed = subprocess.run([sys.executable, "-c", KILLED, *given], **settings)
        assert killed.returncode == -signal.SIGKILL
    # A checkpoint that was being written when it was killed.
    (folder / "checkpoints" / "999999999999.unfinished").mkdir()
    last = subprocess.run([sys.executable, "-m", "surgsim_env.cli.main", "train", *given], check=True, **settings)
    assert "resuming from" in last.stdout
    wanted = 384 if algorithm == "PPO" else 336
    assert f"{wanted} steps" in last.stdout
    assert sorted(path.name for path in (folder / "final").iterdir()) == [f"{wanted:012d}"]
    assert not list((folder / "checkpoints").glob("*.unfinished"))


def test_a_folder_of_another_run_is_refused_and_a_longer_run_goes_on(tmp_path: Path):
    from surgsim_env.training.run import train

    train(config(total_steps=64, evaluation={"every": 0}), tmp_path)
    with pytest.raises(ValueError, match=r"holds a run with other settings .*seed: 0.* there.*seed: 1.* here"):
        train(config(total_steps=64, evaluation={"every": 0}, seed=1), tmp_path)
    assert train(config(total_steps=192, evaluation={"every": 0}), tmp_path) == 192


@pytest.mark.parametrize(
    "change",
    [
        {"hyperparameters": {"policy_kwargs": {"net_arch": [16, 8]}}},
        {"evaluation": {"every": 4096}, "checkpoint": {"every": 8192}},
        {"hyperparameters": {"use_sde": 1}},
    ],
)
def test_settings_that_hold_the_same_lines_of_yaml_are_told_apart(tmp_path: Path, change: dict):
    """The same lines in another order, one of them twice, and a number for a truth value."""
    from surgsim_env.training.run import Run

    before = {
        "hyperparameters": {"policy_kwargs": {"net_arch": [8, 16]}, "use_sde": True},
        "evaluation": {"every": 8192},
        "checkpoint": {"every": 4096},
    }
    Run(config(**before), tmp_path)
    Run(config(**before), tmp_path)
    with pytest.raises(ValueError, match=f"other settings .*{next(iter(change))}: "):
        Run(config(**{**before, **change}), tmp_path)


def test_episodes_of_dictionaries_are_evaluated():
    from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

    from surgsim_env.training.run import mean_figures, play_episodes

    class Parts(gym.Env):
        observation_space = gym.spaces.Dict({"a": gym.spaces.Box(0.0, 9.0, (2,)), "b": gym.spaces.Box(0.0, 9.0, (3,))})
        action_space = gym.spaces.Box(-1.0, 1.0, (1,))

        def reset(self, **given):
            super().reset(**given)
            self.count = 0
            return {"a": np.zeros(2, np.float32), "b": np.ones(3, np.float32)}, {}

        def step(self, action):
            self.count += 1
            return {"a": np.zeros(2, np.float32), "b": np.ones(3, np.float32)}, 1.0, self.count == 3, False, {}

    class Still:
        def reset(self, count):
            self.count = count

        def act(self, observations, begins):
            assert observations["b"].shape == (self.count, 3)
            return np.zeros((self.count, 1))

    figures = mean_figures(play_episodes(Still(), VecMonitor(DummyVecEnv([Parts] * 2)), 4))
    assert figures["return"] == figures["length"] == 3.0


def test_a_resumed_run_has_the_weights_normalisation_and_optimiser_it_had(tmp_path: Path):
    from surgsim_env.training.run import Run, train

    settings = config(evaluation={"every": 0})
    train(settings, tmp_path)
    one, other = Run(settings, tmp_path), Run(settings, tmp_path)
    assert one.model.num_timesteps == 320
    assert one.normalization.obs_rms.count > 300 and one.normalization.ret_rms.var > 0.0
    assert one.model.policy.optimizer.state_dict()["state"], "Adam's moments"
    for name, values in one.model.policy.state_dict().items():
        assert (values == other.model.policy.state_dict()[name]).all()
    assert Run(settings, tmp_path / "new").normalization.obs_rms.count < 1.0


# ---- warm starts ----------------------------------------------------------------------------------------------------


def test_a_warm_start_takes_weights_and_normalisation_and_the_value_learns_first(tmp_path: Path):
    from surgsim_env.training.policy_files import load_policy
    from surgsim_env.training.run import Run, train

    train(config(evaluation={"every": 0}), tmp_path / "first")
    file = next((tmp_path / "first" / "final").iterdir()) / "policy.safetensors"
    warm = config(evaluation={"every": 0}, warm_start=str(file), critic_first=10_000, warm_spread=0.25)
    run = Run(warm, tmp_path / "second")
    np.testing.assert_allclose(run.model.policy.log_std.detach().exp(), 0.25, rtol=1e-6)
    before = load_policy(file)
    np.testing.assert_array_equal(run.normalization.obs_rms.mean, before.description.observation_mean)
    observation = np.random.default_rng(0).normal(size=(5, 10)).astype(np.float32)
    begins = np.ones(5, dtype=bool)
    before.reset(5)
    expected = before.act(observation, begins)
    train(warm, tmp_path / "second")
    after = load_policy(next((tmp_path / "second" / "final").iterdir()) / "policy.safetensors")
    after.reset(5)
    np.testing.assert_allclose(after.act(observation, begins), expected, atol=1e-4)
    old, new = before.networks.state_dict(), after.networks.state_dict()
    changed = {name for name in old if (old[name] != new[name]).any()}
    assert changed > {"log_std"} and all("value" in name for name in changed - {"log_std"})


def test_warm_starts_that_do_not_fit_are_refused(tmp_path: Path):
    from surgsim_env.training.run import Run, train

    train(config(evaluation={"every": 0}), tmp_path / "first")
    file = str(next((tmp_path / "first" / "final").iterdir()) / "policy.safetensors")
    wider = {**SETTINGS["PPO"]["hyperparameters"], "policy_kwargs": {"net_arch": [8]}}
    with pytest.raises(ValueError, match="its networks are not those of this run"):
        Run(config(warm_start=file, hyperparameters=wider), tmp_path / "second")
    bare = {**table()["environment"], "normalize_observation": False}
    with pytest.raises(ValueError, match=r"set environment\.normalize_observation: true"):
        Run(config(warm_start=file, environment=bare), tmp_path / "third")


def test_a_warm_start_from_a_zip_needs_trust(tmp_path: Path):
    """The zip of a checkpoint; `surgsim train` names the flag in one line."""
    from surgsim_env.training.run import Run, train

    first = config(evaluation={"every": 0}, total_steps=64)
    train(first, tmp_path / "first")
    policy = next((tmp_path / "first" / "final").iterdir()) / "policy.json"
    zipped = tmp_path / "old.zip"
    shutil.copy(next((tmp_path / "first" / "checkpoints").iterdir()) / "model.zip", zipped)
    shutil.copy(policy, zipped.with_suffix(".json"))
    warm = config(evaluation={"every": 0}, total_steps=64, warm_start=str(zipped))
    with pytest.raises(ValueError, match=r"old\.zip is a zip of pickles.*--trust-pickle"):
        Run(warm, tmp_path / "second")
    with pytest.warns(UserWarning, match="is read with pickle"):
        run = Run(warm, tmp_path / "second", trust_pickle=True)
    from surgsim_env.training.policy_files import load_policy

    weights = load_policy(policy.with_suffix(".safetensors")).networks.state_dict()
    assert all((weights[name] == one).all() for name, one in run.model.policy.state_dict().items())


# ---- wrappers and files ---------------------------------------------------------------------------------------------


class Counting:
    """A vector environment of two that observe how often they were stepped; the first ends after three steps."""

    num_envs = 2

    def __init__(self):
        from gymnasium.spaces import Box

        self.observation_space, self.action_space = Box(-100, 100, (2,)), Box(-1, 1, (1,))
        self.count, self.told, self.render_mode = np.zeros(2), [], None
        self.reset_infos = [{}, {}]

    def reset(self):
        return np.stack([self.count, self.count], axis=1)

    def step(self, actions):
        self.told.append(actions[:, 0].tolist())
        self.count += 1
        done = self.count >= [3, 99]
        infos = [{"terminal_observation": np.full(2, self.count[0])} if done[0] else {}, {}]
        reward = self.count.copy()
        self.count[done] = 0
        return np.stack([self.count, self.count], axis=1), reward, done, infos

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        return self.step(self.actions)

    def get_attr(self, name, indices=None):
        return [getattr(self, name)] * 2


def test_a_repeated_action_sums_rewards_and_does_nothing_after_an_end():
    from surgsim_env.training.environments import RepeatedAction

    envs = RepeatedAction(Counting(), 4)
    envs.reset()
    observation, reward, done, infos = envs.step(np.ones((2, 1)))
    assert reward.tolist() == [1 + 2 + 3, 1 + 2 + 3 + 4] and done.tolist() == [True, False]
    assert envs.venv.told == [[1, 1]] * 3 + [[0, 1]]
    assert infos[0]["terminal_observation"].tolist() == [3, 3] and observation[:, 0].tolist() == [1, 4]
    _, reward, done, _ = envs.step(np.ones((2, 1)))
    assert reward.tolist() == [1 + 2 + 3, 5 + 6 + 7 + 8], "the zeros' reward counts for the episode that they began"


def test_without_force_blinds_all_that_is_observed():
    from surgsim_env.training.environments import WithoutForce

    envs = WithoutForce(Counting(), [1])
    assert envs.reset().tolist() == [[0, 0], [0, 0]]
    for _ in range(3):
        observation, _, _, infos = envs.step(np.ones((2, 1)))
    assert observation.tolist() == [[0, 0], [3, 0]]
    assert infos[0]["terminal_observation"].tolist() == [3, 0]


def test_the_task_says_which_entries_are_forces():
    from surgsim_env.training.environments import force_entries, make_environments

    settings = config().environment
    assert force_entries(make_environments(settings)) == [6, 7, 8]
    blind = make_environments(replace(settings, without_force=True))
    blind.seed(0)
    observation = blind.reset()
    assert not observation[:, 6:9].any() and observation[:, :6].any()


def test_a_policy_decides_as_often_as_it_was_trained_to(tmp_path: Path):
    """With a repeat of two, each environment holds its action for the second step, counted from its own begin."""
    from surgsim_env.training.policy_files import TrainedPolicy, load_policy
    from surgsim_env.training.run import train

    train(config("RecurrentPPO", evaluation={"every": 0}, total_steps=64), tmp_path)
    loaded = load_policy(next((tmp_path / "final").iterdir()) / "policy.safetensors")
    slow = TrainedPolicy(loaded.networks, replace(loaded.description, action_repeat=2))
    slow.reset(2)
    rng = np.random.default_rng(0)
    seen = [rng.normal(size=(2, 10)).astype(np.float32) for _ in range(4)]
    # The second one's episode ends after a step: from then on they decide in turns.
    begins = [[True, True], [False, True], [False, False], [False, False]]
    acts = [slow.act(rows, np.array(begun)) for rows, begun in zip(seen, begins, strict=True)]
    assert (acts[1][0] == acts[0][0]).all() and (acts[2][1] == acts[1][1]).all() and (acts[3][0] == acts[2][0]).all()
    fast = TrainedPolicy(loaded.networks, loaded.description)
    for index, decisions in ((0, (0, 2)), (1, (1, 3))):
        fast.reset(2)
        for step, begun in zip(decisions, (True, False), strict=True):
            expected = fast.act(seen[step], np.array([begun, begun]))[index]
            np.testing.assert_allclose(acts[step][index], expected, atol=1e-6)


def test_folders_are_whole_or_absent(tmp_path: Path):
    from surgsim_env.training.run import keep_newest, whole_folders, write_folder

    def broken(folder: Path) -> None:
        (folder / "half").write_text("half")
        raise KeyboardInterrupt

    write_folder(tmp_path, "1", lambda folder: (folder / "a").write_text("one"))
    with pytest.raises(KeyboardInterrupt):
        write_folder(tmp_path, "2", broken)
    assert [path.name for path in whole_folders(tmp_path)] == ["1"]
    write_folder(tmp_path, "1", lambda folder: (folder / "a").write_text("two"))
    write_folder(tmp_path, "3", lambda folder: (folder / "a").write_text("three"))
    assert (tmp_path / "1" / "a").read_text() == "two"
    keep_newest(tmp_path, 1)
    assert [path.name for path in tmp_path.iterdir()] == ["3"]
