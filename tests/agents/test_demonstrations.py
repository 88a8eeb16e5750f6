"""Episodes are recorded as Minari datasets, come back to the bit, and a policy is cloned from them in one script."""

import json

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console

import surgsim_env  # noqa: F401
from surgsim_env.rendering import gl

pytestmark = pytest.mark.agents
pytest.importorskip("torch", reason="needs the `agents` extra")
minari = pytest.importorskip("minari", reason="needs the `demonstrations` extra")

NAME = "surgsim/palpate/oracle-v0"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("minari")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(path))
        yield path


@pytest.fixture(scope="module")
def dataset(folder):
    """Two oracle episodes, written by the script."""
    from agents.record_demonstrations import main

    short = '{"max_episode_steps": 80}'
    main(["SurgSim/Palpate-v0", "--env-arguments", short, "--episodes", "2", "--first-seed", "3", "--dataset", NAME])
    return minari.load_dataset(NAME)


def test_an_episode_comes_back_to_the_bit(dataset):
    """The environment that the dataset names, its seed and its actions give what was observed."""
    env = dataset.recover_environment()
    assert env.spec.id == "SurgSim/Palpate-v0" and type(env.unwrapped).__name__ == "PalpateEnv"
    assert dataset.total_episodes == 2 and dataset.spec.env_spec.max_episode_steps == 80
    episode, metadata = dataset[1], next(iter(dataset.storage.get_episode_metadata([1])))
    assert metadata["seed"] == 4
    observation, info = env.reset(seed=metadata["seed"])
    np.testing.assert_array_equal(observation, episode.observations[0])
    for index, action in enumerate(episode.actions):
        observation, reward, terminated, truncated, info = env.step(action)
        np.testing.assert_array_equal(observation, episode.observations[index + 1])
        assert (reward, terminated, truncated) == (
            episode.rewards[index],
            episode.terminations[index],
            episode.truncations[index],
        )
        assert info["force_peak"] == episode.infos["force_peak"][index + 1]
    assert info["success"] and terminated and index == len(episode.actions) - 1


def test_a_policy_is_cloned_in_one_script(dataset, tmp_path, capsys):
    from agents.behaviour_cloning import main
    from surgsim_apps.training.policy_files import load_policy

    main([NAME, "--out", str(tmp_path / "clone.json"), "--updates", "600"])
    assert f"{NAME}: 2 episodes, {dataset.total_steps} steps" in capsys.readouterr().out
    policy = load_policy(tmp_path / "clone.json")
    policy.check_environment(dataset.recover_environment())
    seen = np.concatenate([episode.observations[:-1] for episode in dataset.iterate_episodes()])
    taken = np.concatenate([episode.actions for episode in dataset.iterate_episodes()])
    policy.reset(len(seen))
    # Ninety steps can be learned by heart.
    missed = policy.act(seen) - taken
    assert np.sqrt(np.square(missed).mean()) < 0.5 * np.sqrt(np.square(taken - taken.mean(axis=0)).mean())


def test_any_agent_is_recorded_and_failures_are_kept_if_asked(folder):
    from agents.record_demonstrations import Recorder, player, record, write_dataset

    env = gym.make("SurgSim/Palpate-v0", max_episode_steps=5)
    play = player(f"{__name__}:Idle", env, {})
    assert not list(record(env, play, range(2)))
    episodes = list(record(env, play, range(2), keep_failures=True))
    assert [episode.seed for episode in episodes] == [0, 1] and len(episodes[0].actions) == 5
    written = write_dataset(episodes, env, "surgsim/palpate/idle-v0", algorithm_name="nobody")
    assert list(written[0].truncations) == [False] * 4 + [True] and not written[0].terminations.any()
    assert written.recover_environment().spec.max_episode_steps == 5
    # An episode that is left is cut short; a reset alone is none.
    recorder = Recorder(env)
    recorder.reset(seed=0)
    recorder.reset(seed=1)
    recorder.step(np.zeros(4, dtype=np.float32))
    (left,) = recorder.episodes
    buffer = left.buffer(0, env.observation_space)
    assert left.seed == 1 and buffer.truncations == [True] and len(buffer.observations) == 2


class Leaver:
    """Plays whole episodes, and presses Ctrl-C in the third."""

    def __init__(self):
        self.begun = 0

    def __call__(self, env, seed):
        self.begun += 1
        env.reset(seed=seed)
        for step in range(4):
            if self.begun == 3 and step == 2:
                raise KeyboardInterrupt
            env.step(np.zeros(4, dtype=np.float32))


def test_a_recording_that_is_interrupted_is_written(folder, monkeypatch, capsys):
    """The episodes before the one that was cut short are in the data set; it is not."""
    from agents import record_demonstrations

    monkeypatch.setattr(record_demonstrations, "player", lambda *given, **options: Leaver())
    name = "surgsim/palpate/interrupted-v0"
    record_demonstrations.main(["SurgSim/Palpate-v0", "--episodes", "5", "--keep-failures", "--dataset", name])
    assert "stopped after 2 of 5 episodes" in capsys.readouterr().out
    written = minari.load_dataset(name)
    assert [episode["seed"] for episode in written.storage.get_episode_metadata([0, 1])] == [0, 1]
    assert written.total_episodes == 2 and written.total_steps == 8


def test_a_data_set_is_written_whole_or_not_at_all(folder, monkeypatch):
    from agents.record_demonstrations import player, record, write_dataset

    env = gym.make("SurgSim/Palpate-v0", max_episode_steps=2)
    episodes = list(record(env, player(f"{__name__}:Idle", env, {}), range(1), keep_failures=True))
    create, name = minari.create_dataset_from_buffers, "surgsim/palpate/killed-v0"

    def killed(*given, **options):
        create(*given, **options)
        raise KeyboardInterrupt

    monkeypatch.setattr(minari, "create_dataset_from_buffers", killed)
    with pytest.raises(KeyboardInterrupt):
        write_dataset(episodes, env, name, algorithm_name="nobody")
    assert name not in minari.list_local_datasets()
    monkeypatch.undo()
    assert write_dataset(episodes, env, name, algorithm_name="nobody").total_steps == 2


class Watching:
    """Commands nothing, and says what it was shown: an actor that takes batches, as policies do."""

    def begin(self, index, env, rng):
        self.shapes = []

    def end(self, index):
        pass

    def __call__(self, observations, begins):
        self.shapes.append({name: part.shape for name, part in observations.items()})
        return np.zeros((len(begins), 5), dtype=np.float32)


def test_dictionaries_of_observations_come_back_to_the_bit(folder):
    """Pictures and forces, played by an actor and by the oracle, whose script is cut short."""
    from agents.behaviour_cloning import main
    from agents.record_demonstrations import play_actor, play_oracle, record, write_dataset

    try:
        gl.context()
    except gl.NoGLError as error:
        pytest.skip(f"no pictures on this machine: {error}")
    env, watching = gym.make("SurgSim/Retract-v0", obs_mode="rgb_force", max_episode_steps=3), Watching()
    players = [lambda env, seed: play_actor(env, seed, watching), play_oracle]
    episodes = [next(record(env, play, [7], keep_failures=True)) for play in players]
    force = env.observation_space["force"].shape  # type: ignore[index]
    assert watching.shapes == [{"picture": (1, 84, 84, 3), "force": (1, *force)}] * 3
    written = write_dataset(episodes, env, "surgsim/retract/pictures-v0", algorithm_name="nobody")
    again = written.recover_environment()
    for episode in written.iterate_episodes():
        seen = [again.reset(seed=7)[0], *(again.step(action)[0] for action in episode.actions)]
        assert len(seen) == 4 and set(episode.observations) == {"picture", "force"}
        for name, stored in episode.observations.items():
            assert stored.dtype == seen[0][name].dtype
            np.testing.assert_array_equal(stored, [observation[name] for observation in seen])
    with pytest.raises(ValueError, match=r'observations are Dict\(.*record with obs_mode="state"'):
        main(["surgsim/retract/pictures-v0"])


def test_what_cannot_be_recorded_is_refused(folder):
    from agents.record_demonstrations import player, record, write_dataset

    env = gym.make("SurgSim/Palpate-v0")
    with pytest.raises(ValueError, match="seed 1000000 is reserved for scores"):
        list(record(env, lambda env, seed: None, [1_000_000]))
    with pytest.raises(ValueError, match="there is no episode to write"):
        write_dataset([], env, "surgsim/palpate/none-v0", algorithm_name="nobody")
    with pytest.raises(ValueError, match="--by is 'raster'; the rule is"):
        player("raster", env, {})


class Idle:
    """Commands nothing."""

    def reset(self, rng, facts):
        self.size = facts.action_size

    def act(self, observation):
        return np.zeros(self.size, dtype=np.float32)


class Wanderer:
    """Presses where its random numbers say."""

    def reset(self, rng, facts):
        self.rng = rng

    def act(self, observation):
        return self.rng.uniform(-0.8, 0.8, 2).astype(np.float32)


class Seer(Idle):
    """Sees the lesion, and presses by its random numbers."""

    sees_truth = True

    def reset(self, rng, facts):
        self.rng, self.received = rng, (facts.env_id, facts.env_kwargs)

    def see(self, task):
        self.task = task

    def act(self, observation):
        assert self.received == ("SurgSim/Palpate-v0", {"scene": "phantom_small", "max_episode_steps": 15})
        assert self.task.drawn
        return np.array([*self.rng.uniform(-0.5, 0.5, 2), -1.0, -1.0], dtype=np.float32)


class OfEnvironment:
    """Asks for an environment, as no agent may."""

    def __init__(self, env):
        self.env = env


def test_a_recorded_episode_of_presses_is_the_one_that_is_scored():
    from agents.record_demonstrations import player, record
    from surgsim_apps.scoring.evaluate import evaluate, find_player
    from surgsim_apps.scoring.options import ScoringOptions

    options = ScoringOptions(scene="phantom_small", budget=4, seeds="3,4", envs=2)
    result = evaluate(find_player(f"{__name__}:Wanderer", options), options, Console(quiet=True))
    arguments = {"scene": "phantom_small", "level": "standard", "budget": 4}
    env = gym.make("SurgSim/PalpateSites-v0", **arguments)
    episodes = list(record(env, player(f"{__name__}:Wanderer", env, arguments), (3, 4), keep_failures=True))
    errors = [[info["error_mm"] for info in episode.infos[1:]] for episode in episodes]
    # A result has two decimals, and lanes of float32 round.
    np.testing.assert_allclose(errors, result.errors_mm, atol=0.01)


def test_a_recorded_episode_of_control_steps_is_the_one_that_is_scored_to_the_bit():
    from agents.record_demonstrations import player, record
    from surgsim_apps.scoring.episodes import make_envs, play_tasks
    from surgsim_apps.scoring.evaluate import find_player
    from surgsim_apps.scoring.options import ScoringOptions

    env_id, short = "SurgSim/Palpate-v0", {"scene": "phantom_small", "max_episode_steps": 15}
    options = ScoringOptions(env=env_id, env_arguments=json.dumps(short), seeds="3,4")
    actor = find_player(f"{__name__}:Seer", options).actor
    scored = play_tasks(actor, make_envs(env_id, 2, dtype="float64", **short), (3, 4))
    env = gym.make(env_id, **short)
    episodes = list(record(env, player(f"{__name__}:Seer", env, short), (3, 4), keep_failures=True))
    for episode, score in zip(episodes, scored, strict=True):
        assert [info["force_peak"] for info in episode.infos[1:]] == score.force_peaks
        assert max(score.force_peaks) > 0.0 and sum(episode.rewards) == score.total
    assert episodes[0].actions[0].tolist() != episodes[1].actions[0].tolist()


def test_a_class_that_is_no_agent_is_refused():
    from agents.record_demonstrations import player

    env = gym.make("SurgSim/Palpate-v0")
    with pytest.raises(ValueError, match=r"--by .*:OfEnvironment: it is made without arguments, and that failed: "):
        player(f"{__name__}:OfEnvironment", env, {})


def test_a_name_that_is_taken_is_refused_before_anything_is_played(folder, dataset, monkeypatch):
    from agents import record_demonstrations

    monkeypatch.setattr(record_demonstrations, "record", None)
    with pytest.raises(ValueError, match=f"--dataset {NAME} is there already"):
        record_demonstrations.main(["SurgSim/Palpate-v0", "--dataset", NAME])
