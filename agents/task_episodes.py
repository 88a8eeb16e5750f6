"""Episodes of SurgSim/Palpate-v0 and Retract-v0, side by side, and what a policy is worth there."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_env.evaluation.palpation import Figure, with_intervals

# Actions (n, n_action) for observations (n, n_observation); where the second (n,) is true an episode begins.
Actor = Callable[[NDArray[Any], NDArray[np.bool_]], NDArray[Any]]


@dataclass
class TaskRecord:
    """One episode: its length in steps, what it returned, its largest forces a step [N] and how it ended."""

    steps: int
    total: float
    force_peaks: list[float]
    last: dict[str, Any]


def play_tasks(
    actor: Actor, envs: gym.vector.VectorEnv, seeds: Sequence[int], *, progress: Callable[[], None] = lambda: None
) -> list[TaskRecord]:
    """Play an episode of each seed, as many at once as there are environments; `progress` is called each step."""
    starts = range(0, len(seeds), envs.num_envs)
    rounds = [_round(actor, envs, seeds[start : start + envs.num_envs], progress) for start in starts]
    return [record for records in rounds for record in records]


def _round(
    actor: Actor, envs: gym.vector.VectorEnv, seeds: Sequence[int], progress: Callable[[], None]
) -> list[TaskRecord]:
    filled = [int(seed) for seed in [*seeds, *[seeds[-1]] * (envs.num_envs - len(seeds))]]
    observations, _ = envs.reset(seed=filled)
    records = [TaskRecord(0, 0.0, [], {}) for _ in filled]
    running, begins = np.ones(len(filled), dtype=bool), np.ones(len(filled), dtype=bool)
    while running[: len(seeds)].any():
        observations, rewards, terminated, truncated, infos = envs.step(actor(observations, begins))
        for index in np.flatnonzero(running):
            record = records[index]
            record.steps += 1
            record.total += float(rewards[index])
            record.force_peaks.append(float(infos["force_peak"][index]))
            if terminated[index] or truncated[index]:
                record.last = {name: values[index] for name, values in infos.items() if not name.startswith("_")}
        begins = terminated | truncated
        running &= ~begins
        progress()
    return records[: len(seeds)]


def task_figures(
    records: Sequence[TaskRecord], control_step: float, soft_force: float, rng: np.random.Generator
) -> dict[str, Figure]:
    """What a policy is worth, with bootstrap intervals over episodes.

    Args:
        records: at least one.
        control_step: [s].
        soft_force: [N]; an episode counts as gentle where no step's largest force passes it.
        rng: of the bootstrap.
    """
    succeeded = [bool(record.last["success"]) for record in records]
    columns = {
        "success": succeeded,
        # Of those that succeed: the others' time is the time limit's.
        "seconds": [
            record.steps * control_step if won else math.nan for record, won in zip(records, succeeded, strict=True)
        ],
        "return": [record.total for record in records],
        "force_peak": [max(record.force_peaks) for record in records],
        "under_soft_force": [max(record.force_peaks) <= soft_force for record in records],
        "hard_limit_share": [bool(record.last["hard_limit"]) for record in records],
        "fault_share": [bool(record.last["sim_fault"]) for record in records],
    }
    for name in ("torn", "visible"):
        if name in records[0].last:
            columns[name] = [float(record.last[name]) for record in records]
    if "error_mm" in records[0].last:
        errors = [float(record.last["error_mm"]) for record in records]
        columns["error_mm"] = [error if error >= 0.0 else math.nan for error in errors]
    return with_intervals({name: np.array(values, dtype=np.float64) for name, values in columns.items()}, rng)
