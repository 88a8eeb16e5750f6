"""Record episodes of an oracle, an agent, a trained policy or a person as a Minari dataset.

    python -m agents.record_demonstrations SurgSim/Retract-v0 --episodes 100 --dataset surgsim/retract/oracle-v0
    python -m agents.record_demonstrations SurgSim/Palpate-v0 --by agents.raster:RasterAgent \
        --dataset surgsim/palpate/raster-v0

Datasets are stored in the folder MINARI_DATASETS_PATH, by default ~/.minari/datasets. Each episode is stored with its
seed: `dataset.recover_environment()`, reset with it and stepped with the actions, reproduces the observations to the
bit. A person plays with `agents/keyboard.py`. `Recorder` records any other code that steps an environment:

    env = Recorder(gym.make("SurgSim/Palpate-v0"))
    ...  # reset and step it
    write_dataset(env.episodes, env.env, "surgsim/palpate/mine-v0", algorithm_name="mine")
"""

import argparse
import copy
import json
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import surgsim_env  # noqa: F401  (registers the ids)
from agents.command_line import one_line_errors
from surgsim_env.palpation.scores import EVALUATION_SEEDS
from surgsim_env.scoring.evaluate import named_class
from surgsim_env.scripting import ScriptError, oracle_script, run_script

with one_line_errors(__name__, "agents", "demonstrations"):
    import minari
    from minari.data_collector.episode_buffer import EpisodeBuffer
    from tqdm import tqdm

CODE = "agents/record_demonstrations.py of surgsim"
POLICY_SUFFIXES = (".safetensors", ".zip")

# Plays one episode in an environment, reset with a seed.
Player = Callable[[gym.Env, int], None]


@dataclass
class RecordedEpisode:
    """A recorded episode, with one observation and one info more than actions."""

    seed: int | None
    observations: list[NDArray] = field(default_factory=list)
    infos: list[dict[str, float]] = field(default_factory=list)
    actions: list[NDArray] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    terminated: bool = False
    truncated: bool = False

    @property
    def success(self) -> bool:
        """Success according to the last info."""
        return bool(self.infos[-1].get("success", False))

    def buffer(self, index: int) -> EpisodeBuffer:
        """The episode in Minari's form; an unfinished episode counts as truncated."""
        ends = np.zeros((2, len(self.actions)), dtype=np.bool_)
        ends[:, -1] = self.terminated, self.truncated or not self.terminated
        return EpisodeBuffer(
            id=index,
            seed=self.seed,
            observations=list(self.observations),
            actions=list(self.actions),
            rewards=list(self.rewards),
            terminations=list(ends[0]),
            truncations=list(ends[1]),
            infos={name: [info[name] for info in self.infos] for name in self.infos[0]},
        )


class Recorder(gym.Wrapper):
    """Records every episode that is played in an environment."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
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
        """Record observation and info; Minari stores infos as typed arrays, so only numbers and booleans are kept."""
        episode = self.all_episodes[-1]
        episode.observations.append(np.array(observation))
        episode.infos.append({name: value for name, value in info.items() if isinstance(value, bool | int | float)})


def play_oracle(env: gym.Env, seed: int) -> None:
    """Play the oracle, which knows the true state; an error of its script counts as a failed episode."""
    env.reset(seed=seed)
    try:
        run_script(env, oracle_script(env))
    except ScriptError as failure:
        print(f"seed {seed}: {failure}")


def player(by: str, env: gym.Env, *, trust_pickle: bool = False) -> Player:
    """The player of a name: "oracle", a policy's file, or MODULE:CLASS with `reset()` and `act(observation)`.

    Args:
        by: the name.
        env: where it plays.
        trust_pickle: the policy may be a zip of stable-baselines3, which runs any code that its author put there.
    """
    if by == "oracle":
        return play_oracle
    if by.endswith(POLICY_SUFFIXES):
        from surgsim_env.training.policy_files import load_policy

        policy = load_policy(Path(by), trust_pickle=trust_pickle)
        policy.check_environment(env, f"policy {by}")
        alone = SimpleNamespace(reset=lambda: policy.reset(1), act=lambda seen: policy.act(seen[None])[0])
        return lambda env, seed: play_agent(env, seed, alone)
    if ":" not in by:
        raise ValueError(f"--by is {by!r}; the rule is oracle, NAME.safetensors or MODULE:CLASS")
    agent = named_class(by, "--by")(env)
    return lambda env, seed: play_agent(env, seed, agent)


def play_agent(env: gym.Env, seed: int, agent: Any) -> None:
    """Play one episode of an agent with `reset()` and `act(observation)`."""
    observation, _ = env.reset(seed=seed)
    agent.reset()
    over = False
    while not over:
        observation, _, terminated, truncated, _ = env.step(agent.act(observation))
        over = terminated or truncated


def record(env: gym.Env, play: Player, seeds: Sequence[int], *, keep_failures: bool = False) -> list[RecordedEpisode]:
    """Play an episode for each seed; returns those that succeeded, or all.

    Raises:
        ValueError: seeds that are reserved for scores.
    """
    kept = next((seed for seed in seeds if seed in EVALUATION_SEEDS), None)
    if kept is not None:
        raise ValueError(f"seed {kept} is reserved for scores, as all in {EVALUATION_SEEDS}: record other seeds")
    recorder = Recorder(env)
    progress = tqdm(seeds, unit="episode")
    for seed in progress:
        play(recorder, seed)
        progress.set_postfix(success=f"{np.mean([episode.success for episode in recorder.episodes]):.0%}")
    return [episode for episode in recorder.episodes if keep_failures or episode.success]


def write_dataset(
    episodes: Sequence[RecordedEpisode], env: gym.Env, name: str, *, algorithm_name: str, author: str = "surgsim"
) -> minari.MinariDataset:
    """Write episodes as a Minari dataset with the spec of its environment.

    The dataset is the same as that of `minari.DataCollector`, which requires jax and stores failures.

    Args:
        episodes: at least one.
        env: of the episodes; made with gym.make.
        name: of the dataset, such as "surgsim/retract/oracle-v0".
        algorithm_name: of the player.
        author: of the dataset.

    Raises:
        ValueError: no episode, an environment that was not made with gym.make, or a name that is taken.
    """
    if not episodes:
        raise ValueError("there is no episode to write: none was played, or none succeeded (--keep-failures)")
    if env.spec is None:
        raise ValueError("the environment has no spec, so the dataset could not recover it: make it with gym.make")
    # The dataset may be used on a machine without a display.
    spec = copy.deepcopy(env.spec)
    spec.kwargs.pop("render_mode", None)
    with warnings.catch_warnings():
        # Minari warns that neither an email nor an environment for evaluation is given.
        warnings.filterwarnings("ignore", message=".*is set to None")
        return minari.create_dataset_from_buffers(
            name,
            [episode.buffer(index) for index, episode in enumerate(episodes)],
            env=spec,
            algorithm_name=algorithm_name,
            author=author,
            code_permalink=CODE,
            description=f"{len(episodes)} episodes of {spec.id} by {algorithm_name}",
            requirements=["surgsim"],
            jpeg_encoding=False,
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Play episodes and write the dataset."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env", help="the environment's id, such as SurgSim/Retract-v0")
    parser.add_argument("--env-arguments", type=json.loads, default={}, help='as JSON: \'{"scene": "phantom"}\'')
    parser.add_argument("--by", default="oracle", help="oracle, a policy's NAME.safetensors, or MODULE:CLASS")
    parser.add_argument("--trust-pickle", action="store_true", help="let --by be a zip, which runs code of its author")
    parser.add_argument("--episodes", type=int, default=10, help="number of episodes to play")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--keep-failures", action="store_true", help="write the episodes that failed too")
    parser.add_argument("--dataset", required=True, help="the dataset's name, such as surgsim/retract/oracle-v0")
    given = parser.parse_args(arguments)
    env = gym.make(given.env, **given.env_arguments)
    seeds = range(given.first_seed, given.first_seed + given.episodes)
    episodes = record(
        env, player(given.by, env, trust_pickle=given.trust_pickle), seeds, keep_failures=given.keep_failures
    )
    who = Path(given.by).stem if given.by.endswith(POLICY_SUFFIXES) else given.by
    dataset = write_dataset(episodes, env, given.dataset, algorithm_name=who)
    print(
        f"{given.dataset}: {dataset.total_episodes} episodes, {dataset.total_steps} steps, in {dataset.spec.data_path}"
    )


if __name__ == "__main__":
    with one_line_errors(__name__, "agents", "demonstrations"):
        main()
