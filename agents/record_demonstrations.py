"""Record episodes of an oracle, an agent or a trained policy as a Minari or LeRobot data set.

    python -m agents.record_demonstrations SurgSim/Retract-v0 --episodes 100 --dataset surgsim/retract/oracle-v0
    python -m agents.record_demonstrations SurgSim/Palpate-v0 --by my_agent:Descend --dataset surgsim/palpate/mine-v0
    python -m agents.record_demonstrations SurgSim/Palpate-v0 --format lerobot --dataset runs/palpate --episodes 100 \
        --images endoscope --keep-failures

With `--format lerobot` the data set is the folder `--dataset` (`agents/lerobot_dataset.py`, docs/datasets.md).

Minari's datasets are stored in the folder MINARI_DATASETS_PATH, by default ~/.minari/datasets. Each episode is stored
with its seed: `dataset.recover_environment()`, reset with it and stepped with the actions, reproduces the observations
to the bit. `Recorder` records any other code with an environment:

    env = Recorder(gym.make("SurgSim/Palpate-v0"))
    ...  # reset and step it
    write_dataset(env.episodes, env.env, "surgsim/palpate/mine-v0", algorithm_name="mine")
"""

import argparse
import copy
import json
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
from minari.data_collector.episode_buffer import EpisodeBuffer
from minari.storage.datasets_root_dir import get_dataset_path
from numpy.typing import NDArray
from tqdm import tqdm

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_apps.cli.main import exit_status
from surgsim_apps.reports.output_folder import lone_run, new_folder
from surgsim_apps.scoring.episodes import EpisodeActor, agent_generator
from surgsim_apps.scoring.evaluate import strangers_actor
from surgsim_apps.scoring.figures import EVALUATION_SEEDS
from surgsim_env.rendering import CAMERAS, NoGLError
from surgsim_env.scene import PHYSICS_VERSION
from surgsim_env.scripting import ScriptError, oracle_script, run_script, stacked_observations

CODE = "agents/record_demonstrations.py of surgsim"
POLICY_SUFFIXES = (".json", ".safetensors")

# Plays one episode in an environment, reset with a seed.
Player = Callable[[gym.Env, int], None]
# Reads additions to observation and info for a recording.
Reading = Callable[[gym.Env], dict[str, Any]]


@dataclass
class RecordedEpisode:
    """A recorded episode, with one observation, one info and one reading more than actions."""

    seed: int | None
    observations: list[Any] = field(default_factory=list)
    infos: list[dict[str, float]] = field(default_factory=list)
    actions: list[NDArray] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    readings: list[dict[str, Any]] = field(default_factory=list)
    terminated: bool = False
    truncated: bool = False

    @property
    def success(self) -> bool:
        """Success according to the last info."""
        return bool(self.infos[-1].get("success", False))

    def buffer(self, index: int, observation_space: gym.Space) -> EpisodeBuffer:
        """The episode in Minari's form; an unfinished episode counts as truncated."""
        ends = np.zeros((2, len(self.actions)), dtype=np.bool_)
        ends[:, -1] = self.terminated, self.truncated or not self.terminated
        return EpisodeBuffer(
            id=index,
            seed=self.seed,
            observations=stacked_observations(observation_space, self.observations),
            actions=list(self.actions),
            rewards=list(self.rewards),
            terminations=list(ends[0]),
            truncations=list(ends[1]),
            infos={name: [info[name] for info in self.infos] for name in self.infos[0]},
        )


class Recorder(gym.Wrapper):
    """Records every episode of an environment.

    Args:
        env: the environment.
        read: called with each observation.
    """

    def __init__(self, env: gym.Env, read: Reading | None = None) -> None:
        super().__init__(env)
        self._read = read
        self.all_episodes: list[RecordedEpisode] = []

    @property
    def episodes(self) -> list[RecordedEpisode]:
        """The episodes with at least one step."""
        return [episode for episode in self.all_episodes if episode.actions]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.all_episodes.append(RecordedEpisode(seed))
        self._see(observation, info)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment and record it."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        episode = self.all_episodes[-1]
        episode.actions.append(np.array(action, dtype=self.action_space.dtype))
        episode.rewards.append(float(reward))
        episode.terminated, episode.truncated = bool(terminated), bool(truncated)
        self._see(observation, info)
        return observation, reward, terminated, truncated, info

    def _see(self, observation: Any, info: dict[str, Any]) -> None:
        """Record observation and info; only numbers and booleans, as Minari stores infos as typed arrays."""
        episode = self.all_episodes[-1]
        episode.observations.append(copy.deepcopy(observation))
        if self._read is not None:
            episode.readings.append(self._read(self.env))
        episode.infos.append({name: value for name, value in info.items() if isinstance(value, bool | int | float)})


def play_oracle(env: gym.Env, seed: int) -> None:
    """Play the oracle with the true state; an error of its script counts as a failed episode."""
    env.reset(seed=seed)
    try:
        run_script(env, oracle_script(env))
    except ScriptError as failure:
        print(f"seed {seed}: {failure}")


def player(by: str, env: gym.Env, env_arguments: dict[str, Any]) -> Player:
    """The player of a name.

    Args:
        by: "oracle", a policy's file, or an agent's MODULE:CLASS (`surgsim evaluate`).
        env: its environment, made with gym.make.
        env_arguments: of the environment, for an agent; without those of the recording's pictures.

    Raises:
        ValueError: another name, a policy for another environment, or a class without a method of agents.
    """
    if by == "oracle":
        return play_oracle
    if by.endswith(POLICY_SUFFIXES):
        from surgsim_apps.training.policy_files import load_policy

        policy = load_policy(Path(by))
        policy.check_environment(env, f"policy {by}")
        policy.reset(1)
        return lambda env, seed: play_actor(env, seed, policy)
    if ":" not in by:
        raise ValueError(f"--by is {by!r}; the rule is oracle, a policy's NAME.json or MODULE:CLASS")
    assert env.spec is not None
    actor = strangers_actor(by, "--by", env.spec.id, env_arguments)
    return lambda env, seed: play_actor(env, seed, actor)


def play_actor(env: gym.Env, seed: int, actor: EpisodeActor) -> None:
    """Play one episode, with the random numbers of scores for this seed."""
    observation, _ = env.reset(seed=seed)
    actor.begin(0, env, agent_generator(seed))
    begins, over = np.ones(1, dtype=np.bool_), False
    while not over:
        seen = stacked_observations(env.observation_space, [observation])
        observation, _, terminated, truncated, _ = env.step(actor(seen, begins)[0])
        begins, over = np.zeros_like(begins), terminated or truncated
    actor.end(0)


def record(
    env: gym.Env, play: Player, seeds: Sequence[int], *, keep_failures: bool = False, read: Reading | None = None
) -> Iterator[RecordedEpisode]:
    """Play an episode for each seed; yields successful ones, or all.

    Ctrl-C ends it after the complete episodes.

    Raises:
        ValueError: seeds reserved for scores.
    """
    reserved = next((seed for seed in seeds if seed >= EVALUATION_SEEDS.start), None)
    if reserved is not None:
        first = EVALUATION_SEEDS.start
        raise ValueError(f"seed {reserved} is reserved for scores, as all from {first} on: record smaller ones")
    recorder, success_count = Recorder(env, read), 0
    with tqdm(seeds, unit="episode") as progress:
        for index, seed in enumerate(progress):
            recorder.all_episodes.clear()
            try:
                play(recorder, seed)
            except KeyboardInterrupt:
                print(f"stopped after {index} of {len(seeds)} episodes")
                return
            success_count += sum(episode.success for episode in recorder.episodes)
            progress.set_postfix(success=f"{success_count / (index + 1):.0%}")
            yield from (episode for episode in recorder.episodes if keep_failures or episode.success)


def write_dataset(
    episodes: Sequence[RecordedEpisode], env: gym.Env, name: str, *, algorithm_name: str
) -> minari.MinariDataset:
    """Write episodes as a Minari dataset with the spec of its environment.

    `minari.DataCollector` would require jax and store failures; the dataset is the same.

    Args:
        episodes: at least one.
        env: of the episodes; made with gym.make.
        name: of the dataset, such as "surgsim/retract/oracle-v0".
        algorithm_name: of the player.

    Raises:
        ValueError: no episode, or a taken name.
    """
    if not episodes:
        raise ValueError("there is no episode to write: none was played, or none succeeded (--keep-failures)")
    assert env.spec is not None
    # The dataset may be used on a machine without a display.
    spec = copy.deepcopy(env.spec)
    spec.kwargs.pop("render_mode", None)
    with new_folder(get_dataset_path(name)), warnings.catch_warnings():
        # Minari warns that neither an email nor an environment for evaluation is given.
        warnings.filterwarnings("ignore", message=".*is set to None")
        return minari.create_dataset_from_buffers(
            name,
            [episode.buffer(index, env.observation_space) for index, episode in enumerate(episodes)],
            env=spec,
            algorithm_name=algorithm_name,
            author="surgsim",
            code_permalink=CODE,
            description=f"{len(episodes)} episodes of {spec.id} by {algorithm_name}",
            requirements=["surgsim"],
            jpeg_encoding=False,
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Play episodes and write the data set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env", help="the environment's id, such as SurgSim/Retract-v0")
    parser.add_argument("--env-arguments", type=json.loads, default={}, help='as JSON: \'{"scene": "phantom"}\'')
    parser.add_argument("--by", default="oracle", help="oracle, a policy's NAME.json, or MODULE:CLASS")
    parser.add_argument("--episodes", type=int, default=10, help="number of episodes to play")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--keep-failures", action="store_true", help="write the episodes that failed too")
    parser.add_argument(
        "--dataset", required=True, help="minari: a name, such as surgsim/retract/oracle-v0; else a folder"
    )
    parser.add_argument("--format", choices=("minari", "lerobot"), default="minari")
    lerobot = parser.add_argument_group("with --format lerobot")
    lerobot.add_argument("--images", nargs="+", choices=CAMERAS, default=[], help="cameras whose pictures are recorded")
    lerobot.add_argument("--image-size", nargs=2, type=int, default=(320, 240), metavar=("WIDTH", "HEIGHT"))
    options = parser.parse_args(arguments)
    with lone_run(get_dataset_path(options.dataset) if options.format == "minari" else Path(options.dataset)):
        _record(options)


def _record(options: argparse.Namespace) -> None:
    """Play and write by the options of the command line."""
    who = Path(options.by).stem if options.by.endswith(POLICY_SUFFIXES) else options.by
    if options.format == "lerobot":
        _record_lerobot(options, who)
        return
    if options.images:
        raise ValueError("--images is for --format lerobot: add it, or leave --images out")
    if get_dataset_path(options.dataset).exists():
        raise ValueError(f"--dataset {options.dataset} is there already: raise its version, or remove it")
    env = gym.make(options.env, **options.env_arguments)
    dataset = write_dataset(list(_episodes(options, env)), env, options.dataset, algorithm_name=who)
    counts = f"{dataset.total_episodes} episodes, {dataset.total_steps} steps"
    print(f"{options.dataset}: {counts}, in {dataset.spec.data_path}")


def _episodes(options: argparse.Namespace, env: gym.Env, read: Reading | None = None) -> Iterator[RecordedEpisode]:
    """Episodes of the command line."""
    seeds = range(options.first_seed, options.first_seed + options.episodes)
    play = player(options.by, env, options.env_arguments)
    return record(env, play, seeds, keep_failures=options.keep_failures, read=read)


def _record_lerobot(options: argparse.Namespace, who: str) -> None:
    """Record a data set of LeRobot."""
    from agents import lerobot_dataset
    from agents.envhub.env import observe

    width, height = options.image_size
    sight = {"show_force": False, "width": width, "height": height} if options.images else {}
    env = gym.make(options.env, **sight, **options.env_arguments)
    try:
        dataset = lerobot_dataset.write_dataset(
            Path(options.dataset),
            env,
            _episodes(options, env, lambda env: observe(env, options.images)),
            cameras=options.images,
            recorded={
                "env_id": options.env,
                "env_arguments": options.env_arguments,
                "recorded_by": who,
                "failures_kept": options.keep_failures,
                "physics_version": PHYSICS_VERSION,
            },
        )
    except NoGLError as error:
        raise ValueError(f"--images: {error}; or leave --images out") from None
    finally:
        env.close()
    print(f"{options.dataset}: {dataset.num_episodes} episodes, {dataset.num_frames} frames")


if __name__ == "__main__":
    sys.exit(exit_status(main))
