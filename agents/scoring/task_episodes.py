"""Play episodes of SurgSim/Palpate-v0 and Retract-v0 side by side and score a policy."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_env.palpation.scores import Figure, with_intervals

# Actions (n, n_action) for observations (n, n_observation); where the second (n,) is true an episode begins.
Actor = Callable[[NDArray[Any], NDArray[np.bool_]], NDArray[Any]]


@dataclass
class TaskRecord:
    """One episode: length in steps, return, largest force of each step [N] and last info."""

    steps: int
    total: float
    force_peaks: list[float]
    last: dict[str, Any]


def play_tasks(
    actor: Actor, envs: gym.vector.VectorEnv, seeds: Sequence[int], *, progress: Callable[[], None] = lambda: None
) -> list[TaskRecord]:
    """Play an episode of each seed; where one ends the next seed begins, and `progress` is called after each step.

    The environments need autoreset_mode="Disabled", so that each reset has its seed.
    """
    mode = AutoresetMode(envs.metadata["autoreset_mode"])
    if mode is not AutoresetMode.DISABLED:
        raise ValueError(f'autoreset_mode is {mode.value!r}; episodes of given seeds need "Disabled"')
    records = [TaskRecord(0, 0.0, [], {}) for _ in seeds]
    waiting = list(range(len(seeds)))
    # Index of the seed in each environment; a surplus environment plays the first one again, unrecorded.
    playing = [waiting.pop(0) if waiting else None for _ in range(envs.num_envs)]
    observations, _ = envs.reset(seed=[int(seeds[index or 0]) for index in playing])  # type: ignore[arg-type]
    begins = np.ones(envs.num_envs, dtype=np.bool_)
    while any(index is not None for index in playing):
        observations, rewards, terminated, truncated, infos = envs.step(actor(observations, begins))
        begins = terminated | truncated
        for env, index in enumerate(playing):
            if index is not None:
                _note(records[index], env, float(rewards[env]), infos, over=bool(begins[env]))
        for env in np.flatnonzero(begins):
            playing[env] = waiting.pop(0) if waiting else None
        if begins.any():
            following = [int(seeds[index or 0]) for index in playing]
            observations, _ = envs.reset(seed=following, options={"reset_mask": begins.copy()})  # type: ignore[arg-type]
        progress()
    return records


def _note(record: TaskRecord, env: int, reward: float, infos: dict[str, Any], *, over: bool) -> None:
    """Add one environment's step to its episode."""
    record.steps += 1
    record.total += reward
    record.force_peaks.append(float(infos["force_peak"][env]))
    if over:
        record.last = {name: values[env] for name, values in infos.items() if not name.startswith("_")}


def task_figures(
    records: Sequence[TaskRecord], control_step: float, soft_force: float, rng: np.random.Generator
) -> dict[str, Figure]:
    """The figures of a policy, with bootstrap intervals over episodes.

    Args:
        records: at least one.
        control_step: duration of a step [s].
        soft_force: [N]; an episode counts as gentle where no step's largest force passes it.
        rng: for the bootstrap.
    """
    succeeded = [bool(record.last["success"]) for record in records]
    columns = {
        "success": succeeded,
        # Of successful episodes; the others take the time limit.
        "seconds": [
            record.steps * control_step if won else math.nan for record, won in zip(records, succeeded, strict=True)
        ],
        "return": [record.total for record in records],
        "force_peak": [max(record.force_peaks) for record in records],
        "under_soft_force": [max(record.force_peaks) <= soft_force for record in records],
        "hard_limit_share": [bool(record.last["hard_limit"]) for record in records],
        "fault_share": [bool(record.last["sim_fault"]) for record in records],
    }
    for name in ("torn", "visible", "grip_force_peak", "pull_force_peak", "pull_force_mean", "slips", "path_length"):
        if name in records[0].last:
            columns[name] = [float(record.last[name]) for record in records]
    if "error_mm" in records[0].last:
        errors = [float(record.last["error_mm"]) for record in records]
        columns["error_mm"] = [error if error >= 0.0 else math.nan for error in errors]
    return with_intervals({name: np.array(values, dtype=np.float64) for name, values in columns.items()}, rng)
