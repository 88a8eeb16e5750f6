"""Whole episodes of a policy on the seeds of periodic evaluation, and their mean figures."""

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from agents.training.environments import EVALUATION_SEED
from agents.training.policy_files import TrainedPolicy


def play_episodes(policy: TrainedPolicy, envs: VecEnv, episodes: int, seed: int = EVALUATION_SEED) -> list[dict]:
    """The last infos of deterministic episodes, with their returns and lengths.

    Each environment plays an equal share, so that short episodes are not over-represented. Environments that repeat
    actions need a policy with action_repeat 1.
    """
    wanted = np.array([(episodes + index) // envs.num_envs for index in range(envs.num_envs)])
    envs.seed(seed)
    observations, begins = envs.reset(), np.ones(envs.num_envs, dtype=np.bool_)
    policy.reset(envs.num_envs)
    records: list[list[dict]] = [[] for _ in wanted]
    while any(len(done) < count for done, count in zip(records, wanted, strict=True)):
        observations, _, begins, infos = envs.step(policy.act(np.asarray(observations), begins))
        for index in np.flatnonzero(begins):
            if len(records[index]) < wanted[index]:
                records[index].append(infos[index])
    return [record for one in records for record in one]


def mean_figures(records: list[dict[str, Any]]) -> dict[str, float]:
    """Means over episodes of return, length and every number in the last info."""
    figures = {
        "return": float(np.mean([record["episode"]["r"] for record in records])),
        "length": float(np.mean([record["episode"]["l"] for record in records])),
    }
    for name, value in records[0].items():
        if isinstance(value, bool | int | float | np.number | np.bool_):
            figures[name] = float(np.mean([float(record[name]) for record in records]))
    return figures
