"""DAgger (Ross, Gordon & Bagnell 2011): the policy plays, the expert labels, the policy is fitted.

Cloning alone sees the states that the expert visits, but a policy's small errors lead it to others. Here each round
adds the states that the policy visited, labelled by the expert, and fits the policy to all rounds together.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import ArrayLike, NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from agents.training.cloning import CloningOptions, clone, is_recurrent, normalise_by

# Actions (n_env, n_action) for observations (n_env, n_observation); the second argument (n_env,) is true where an
# episode begins, for an expert with a state.
Expert = Callable[[NDArray, NDArray[np.bool_]], NDArray]


@dataclass(frozen=True)
class DaggerRound:
    """Results of a round."""

    index: int
    expert_share: float
    sample_count: int  # of all rounds together
    episode_count: int  # that ended in this round
    success_share: float  # of those with `success` in their last info; nan without one
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
    """Play and fit in turns; yields each round's results and changes `model` in place.

    Args:
        envs: with autoreset_mode="SameStep".
        expert: the imitated policy.
        model: PPO or SAC.
        rounds: number of rounds.
        steps: of each environment in a round.
        expert_share: function from the round's index to the share of steps in which the expert's action is played.
        disturbance: standard deviation of noise on the played actions, not on the labels (Laskey et al. 2017, DART), so
            that the policy can recover from the exploration noise of reinforcement learning.
        normalisation: recomputed each round from all observations so far.
        action_weight: shape (n_action,), as `clone` takes it.
        options: of each fit.
        seed: of the environments and of the choice of player.

    Raises:
        ValueError: another autoreset mode, or a recurrent policy.
    """
    mode = AutoresetMode(envs.metadata["autoreset_mode"])
    if mode is not AutoresetMode.SAME_STEP:
        raise ValueError(f'autoreset_mode is {mode.value!r}; DAgger needs "SameStep"')
    if is_recurrent(model):
        raise ValueError("DAgger labels single steps; clone a recurrent policy from whole episodes (cloning.py)")
    rng = np.random.default_rng(seed)
    seen: list[NDArray] = []
    labels: list[NDArray] = []
    play = _Play(envs, seed)
    for index in range(rounds):
        share = expert_share(index)
        endings: list[dict[str, Any]] = []
        for _ in range(steps):
            wanted = expert(play.observation, play.begun)
            seen.append(play.observation)
            labels.append(np.clip(wanted, -1.0, 1.0).astype(np.float32))
            taken = labels[-1]
            if share < 1.0:
                by_expert = rng.random(envs.num_envs) < share
                taken = np.where(by_expert[:, None], taken, _of_policy(model, normalisation, play.observation))
            endings += play.step(disturbed(taken, disturbance, rng))
        observations, actions = np.concatenate(seen), np.concatenate(labels)
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
    """The current policy's mean actions."""
    seen = observation if normalisation is None else normalisation.normalize_obs(observation)
    return model.predict(seen, deterministic=True)[0]


class _Play:
    """Episodes that continue from one round to the next."""

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
