"""Strategies that are played side by side: cheats that may know everything, and honest agents that observe."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from surgsim_apps.scoring.episodes import AgentActor, TaskRecord, make_envs, play_tasks


class Now:
    """An episode as its strategy sees it: the environment, with all that it hides, and the last observation."""

    def __init__(self, env: Any, rng: np.random.Generator) -> None:
        self.env, self.task, self.scene, self.rng = env, env.task, env.scene, rng
        self.observation = np.zeros(env.observation_space.shape, dtype=np.float32)

    def __getitem__(self, channel: str) -> np.ndarray:
        """A channel's value now, in SI units."""
        return self.env.si_values(self.observation)[self.env.observation_slices[channel]]


# The actions of an episode, one after the other; `Now` is of the moment at which an action is asked for.
Strategy = Callable[[Now], Iterator[np.ndarray]]


class Player:
    """Plays one episode of a strategy."""

    def __init__(self, strategy: Strategy) -> None:
        self.strategy = strategy

    def reset(self, rng: np.random.Generator, env: gym.Env) -> None:
        self.now = Now(env.unwrapped, rng)
        self.actions = self.strategy(self.now)

    def act(self, observation: np.ndarray) -> np.ndarray:
        self.now.observation = observation
        return np.clip(next(self.actions), -1.0, 1.0).astype(np.float32)


def play(
    env_id: str, strategies: Mapping[str, Strategy], seeds: Sequence[int], *, lanes: int = 8, **settings: Any
) -> dict[str, list[TaskRecord]]:
    """Each strategy's episodes of the same seeds, several at a time."""
    if gym.spec(env_id).vector_entry_point:
        envs = make_envs(env_id, lanes, dtype="float64", **settings)
    else:
        arguments = {"vectorization_mode": "sync", "vector_kwargs": {"autoreset_mode": "Disabled"}}
        envs = gym.make_vec(env_id, 1, measure_tissue=True, **arguments, **settings)
    episodes = [(name, seed) for seed in seeds for name in strategies]
    players = iter([Player(strategies[name]) for name, _ in episodes])
    actor = AgentActor(lambda: next(players), facts=lambda env: env)
    records = play_tasks(actor, envs, [seed for _, seed in episodes])
    envs.close()
    return {
        name: [record for (played, _), record in zip(episodes, records, strict=True) if played == name]
        for name in strategies
    }


def mean_return(records: Sequence[TaskRecord]) -> float:
    return float(np.mean([record.total for record in records]))
