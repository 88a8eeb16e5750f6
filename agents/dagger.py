"""DAgger (Ross, Gordon & Bagnell 2011): the policy plays, the expert says what it would have done, the policy learns.

Cloning alone sees the places that the expert comes to; a policy's small errors take it elsewhere. Here each round adds
the places that the policy came to, labelled by the expert, and fits the policy to all rounds together.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import ArrayLike, NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from agents.cloning import CloningOptions, clone, is_recurrent, normalise_by

# Actions (n_env, n_action) for observations (n_env, n_observation); the second argument (n_env,) says whose episode
# begins with this observation, for an expert with a memory.
Expert = Callable[[NDArray, NDArray[np.bool_]], NDArray]


@dataclass(frozen=True)
class DaggerRound:
    """What a round came to."""

    index: int
    expert_share: float
    sample_count: int  # of all rounds together
    episode_count: int  # that ended in this round
    success_share: float  # of those that say `success` in their last info; nan where there is none
    validation_loss: float


def halving(index: int) -> float:
    """The usual share of the expert's actions: 1, 1/2, 1/4, ..."""
    return 0.5**index


def dagger(
    envs: VectorEnv,
    expert: Expert,
    model: BaseAlgorithm,
    *,
    rounds: int,
    steps: int,
    expert_share: Callable[[int], float] = halving,
    disturbance: float = 0.0,
    normalisation: VecNormalize | None = None,
    action_weight: ArrayLike = 1.0,
    options: CloningOptions | None = None,
    seed: int = 0,
) -> Iterator[DaggerRound]:
    """Play and fit in turns; gives each round as it ends, and `model` is what came of it.

    Args:
        envs: with autoreset_mode="SameStep".
        expert: what is imitated.
        model: PPO or SAC, changed in place.
        rounds: how many.
        steps: of each environment in a round.
        expert_share: the share of steps in which the expert's action is played, from the round's index on.
        disturbance: standard deviation of noise on what is played, not on what is learned (Laskey et al. 2017, DART): a
            policy that has only seen calm episodes cannot bear the noise that reinforcement learning explores with.
        normalisation: begins anew each round from all observations so far.
        action_weight: shape (n_action,), as `clone` takes it.
        options: of each fit.
        seed: of the environments and of whose action is played.

    Raises:
        ValueError: environments that reset in another way, or a recurrent policy.
    """
    mode = AutoresetMode(envs.metadata["autoreset_mode"])
    if mode is not AutoresetMode.SAME_STEP:
        raise ValueError(f'autoreset_mode is {mode.value!r}; DAgger needs "SameStep"')
    if is_recurrent(model):
        raise ValueError("DAgger labels single steps; clone a recurrent policy from whole episodes (agents/cloning.py)")
    rng = np.random.default_rng(seed)
    seen: list[NDArray] = []
    told: list[NDArray] = []
    play = _Play(envs, seed)
    for index in range(rounds):
        share = expert_share(index)
        endings: list[dict[str, Any]] = []
        for _ in range(steps):
            wanted = expert(play.observation, play.begun)
            seen.append(play.observation)
            told.append(np.clip(wanted, -1.0, 1.0).astype(np.float32))
            taken = told[-1]
            if share < 1.0:
                by_expert = rng.random(envs.num_envs) < share
                taken = np.where(by_expert[:, None], taken, _of_policy(model, normalisation, play.observation))
            endings += play.step(disturbed(taken, disturbance, rng))
        observations, actions = np.concatenate(seen), np.concatenate(told)
        if normalisation is not None:
            normalise_by(normalisation, observations)
        curve = clone(
            model, observations, actions, action_weight=action_weight, normalisation=normalisation, options=options
        )
        won = [float(info["success"]) for info in endings if "success" in info]
        success = float(np.mean(won)) if won else float("nan")
        yield DaggerRound(index, share, len(actions), len(endings), success, curve.validation[curve.best])


def disturbed(actions: NDArray[np.float32], disturbance: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Actions with normal noise, within the bounds."""
    if disturbance == 0.0:
        return actions
    return np.clip(actions + rng.normal(scale=disturbance, size=actions.shape), -1.0, 1.0).astype(np.float32)


def _of_policy(model: BaseAlgorithm, normalisation: VecNormalize | None, observation: NDArray) -> NDArray[np.float32]:
    """The mean actions of the policy so far."""
    seen = observation if normalisation is None else normalisation.normalize_obs(observation)
    return model.predict(seen, deterministic=True)[0]


class _Play:
    """Episodes that go on from one round to the next."""

    def __init__(self, envs: VectorEnv, seed: int) -> None:
        self.envs = envs
        self.observation, _ = envs.reset(seed=seed)
        self.begun = np.ones(envs.num_envs, dtype=np.bool_)

    def step(self, actions: NDArray) -> list[dict[str, Any]]:
        """One step of all; the last infos of the episodes that ended."""
        self.observation, _, terminated, truncated, info = self.envs.step(actions)
        self.observation = self.observation.copy()
        self.begun = terminated | truncated
        final = info.get("final_info", {})
        return [_of_one(final, int(index)) for index in np.flatnonzero(self.begun)]


def _of_one(infos: dict[str, Any], index: int) -> dict[str, Any]:
    """One environment's part of a vector environment's infos."""
    return {
        name: values[index]
        for name, values in infos.items()
        if not name.startswith("_") and infos.get(f"_{name}", np.ones(index + 1, dtype=np.bool_))[index]
    }
