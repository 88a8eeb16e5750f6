"""Imitation: behaviour cloning, and DAgger (Ross, Gordon & Bagnell 2011).

Cloning fits the policy of a stable-baselines3 model to observations and the actions taken there. It sees the states
that the expert visits, but a policy's small errors lead it to others: each round of DAgger adds the states that the
policy visited, labelled by the expert, and fits the policy to all rounds together. The model is fitted in place, so
that reinforcement learning can continue from it:

    model = PPO("MlpPolicy", envs)
    normalise_by(envs, observations)  # envs is a VecNormalize, or leave it out
    curve = clone(model, observations, actions, normalisation=envs)
    model.learn(1_000_000)

Supported are PPO (any feed-forward policy on flat observations), SAC and sb3-contrib's RecurrentPPO.
"""

import math
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import ArrayLike, NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

# Weight of the deviation of a SAC actor's standard deviation from `CloningOptions.std` in the loss.
SPREAD_WEIGHT = 0.01


@dataclass(frozen=True)
class CloningOptions:
    """Options of a fit.

    Args:
        epochs: largest number of passes through the data.
        patience: stop after this many epochs without a better validation loss.
        batch_size: samples (for a recurrent policy: sequences) per step of Adam.
        learning_rate: of Adam.
        gradient_norm: gradients are clipped to this norm.
        validation_share: of the samples (sequences) held out, at least one.
        std: least standard deviation of the fitted policy's actions, for the exploration of PPO; larger where the
            error on the demonstrations is larger.
        value_weight: of the squared error of the critic if returns are given.
        seed: of the split and the order.
    """

    epochs: int = 100
    patience: int = 10
    batch_size: int = 256
    learning_rate: float = 1e-3
    gradient_norm: float = 1.0
    validation_share: float = 0.1
    std: float = 0.1
    value_weight: float = 0.5
    seed: int = 0


@dataclass
class CloningCurve:
    """Losses of each epoch; the model has the weights of the best one."""

    training: list[float] = field(default_factory=list)
    validation: list[float] = field(default_factory=list)

    @property
    def best(self) -> int:
        """The epoch with the least validation loss."""
        return int(np.argmin(self.validation))


def clone(
    model: BaseAlgorithm,
    observations: ArrayLike,
    actions: ArrayLike,
    *,
    action_weight: ArrayLike = 1.0,
    sample_weight: ArrayLike = 1.0,
    returns: ArrayLike | None = None,
    normalisation: VecNormalize | None = None,
    options: CloningOptions | None = None,
) -> CloningCurve:
    """Fit the mean of the policy to actions by weighted least squares with Adam and early stopping on held-out samples.

    Args:
        model: PPO, RecurrentPPO or SAC; its policy is changed in place.
        observations: shape (n, n_observation), as the environment returns them; for a recurrent policy whole episodes
            from their first step, shape (n, n_time, n_observation), padded at the end.
        actions: shape (n, n_action) or (n, n_time, n_action).
        action_weight: shape (n_action,), of each entry of the action.
        sample_weight: shape (n,) or (n, n_time), of each step; 0 in the padding.
        returns: shape (n,), of the reward that the algorithm sees; if given, the critic of PPO is fitted too.
        normalisation: of the observations, the same as in reinforcement learning.
        options: of the fit.

    Raises:
        ValueError: a wrong shape, a number that is not finite, weights that are negative or all zero, an unsupported
            policy (names it).
    """
    options = options or CloningOptions()
    data = _checked(model, observations, actions, action_weight, sample_weight, returns)
    if normalisation is not None:
        data["observation"] = normalisation.normalize_obs(data["observation"]).astype(np.float32)
    tensors = {name: torch.as_tensor(values, device=model.device) for name, values in data.items()}
    return _fit(model, tensors, options)


def normalise_by(normalisation: VecNormalize, observations: ArrayLike) -> None:
    """Initialise a normalisation with the mean and variance of observations (..., n).

    An entry that never changes gets the variance 1: its scale is unknown, and a variance near 0 would amplify its first
    change.

    Raises:
        ValueError: they have another length than the environment's, or are fewer than two.
    """
    values = np.asarray(observations, dtype=np.float64)
    shape = normalisation.observation_space.shape
    if values.shape[-1:] != shape or values.size < 2 * values.shape[-1]:
        raise ValueError(f"observations have shape {values.shape}; the rule is two or more of shape {shape}")
    values = values.reshape(-1, values.shape[-1])
    statistics = RunningMeanStd(shape=shape)
    statistics.mean, statistics.count = values.mean(axis=0), len(values)
    variance = values.var(axis=0)
    statistics.var = np.where(np.ptp(values, axis=0) == 0.0, 1.0, variance)
    normalisation.obs_rms = statistics


def pad(episodes: list[NDArray], length: int | None = None) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Episodes (n_time_i, n) as one array (n_episode, n_time, n), and weights (n_episode, n_time), 0 in the padding."""
    length = length or max(len(episode) for episode in episodes)
    filled = np.zeros((len(episodes), length, episodes[0].shape[1]), dtype=np.float32)
    weight = np.zeros((len(episodes), length), dtype=np.float32)
    for index, episode in enumerate(episodes):
        if len(episode) > length:
            raise ValueError(f"episode {index} has {len(episode)} steps, more than {length}")
        filled[index, : len(episode)], weight[index, : len(episode)] = episode, 1.0
    return filled, weight


# ---- what is fitted ---------------------------------------------------------------------------------------------


def policy_mean(model: BaseAlgorithm) -> Callable[[torch.Tensor], torch.Tensor]:
    """The mean action of a model's policy as a function of normalised observations, in the environment's units."""
    policy: Any = model.policy
    if isinstance(model, SAC):
        return lambda observation: torch.tanh(policy.actor.get_action_dist_params(observation)[0])
    if is_recurrent(model):
        return lambda observation: _recurrent_mean(policy, observation)
    if isinstance(policy, ActorCriticPolicy) and hasattr(policy, "log_std"):
        return lambda observation: policy.get_distribution(observation).distribution.mean
    raise ValueError(
        f"{type(model).__name__} with {type(policy).__name__} cannot be cloned; known are PPO and RecurrentPPO with "
        "continuous actions, and SAC"
    )


def is_recurrent(model: BaseAlgorithm) -> bool:
    """Whether the policy is recurrent."""
    return hasattr(model.policy, "lstm_actor")


def _recurrent_mean(policy: Any, observation: torch.Tensor) -> torch.Tensor:
    """Mean actions (n, n_time, n_action) along sequences (n, n_time, n_observation) from a zero LSTM state."""
    count, length = observation.shape[:2]
    lstm = policy.lstm_actor
    empty = torch.zeros(lstm.num_layers, count, lstm.hidden_size, device=observation.device)
    began = torch.zeros(count * length, device=observation.device)
    mean = policy.get_distribution(observation.flatten(0, 1), (empty, empty), began)[0].distribution.mean
    return mean.unflatten(0, (count, length))


def _loss(model: BaseAlgorithm, batch: dict[str, torch.Tensor], options: CloningOptions) -> torch.Tensor:
    """Weighted mean squared error of the actions, plus the terms of standard deviation and value."""
    missed = (policy_mean(model)(batch["observation"]) - batch["action"]).square()
    loss = (missed * batch["weight"]).mean()
    if isinstance(model, SAC):
        spread = model.policy.actor.get_action_dist_params(batch["observation"])[1]
        loss = loss + SPREAD_WEIGHT * (spread - math.log(options.std)).square().mean()
    if "value" in batch:
        value = model.policy.predict_values(batch["observation"]).squeeze(-1)
        loss = loss + options.value_weight * (value - batch["value"]).square().mean()
    return loss


def _fit(model: BaseAlgorithm, data: dict[str, torch.Tensor], options: CloningOptions) -> CloningCurve:
    """Adam on minibatches until the validation loss no longer falls; keeps the best weights."""
    rng = np.random.default_rng(options.seed)
    order = rng.permutation(len(data["action"]))
    held = max(1, round(options.validation_share * len(order)))
    valid, train = order[:held], order[held:]
    adam = torch.optim.Adam(model.policy.parameters(), lr=options.learning_rate)
    curve, best = CloningCurve(), deepcopy(model.policy.state_dict())
    for epoch in range(options.epochs):
        model.policy.set_training_mode(True)
        losses = []
        for rows in np.array_split(rng.permutation(train), math.ceil(len(train) / options.batch_size)):
            loss = _loss(model, _rows(data, rows), options)
            adam.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(model.policy.parameters(), options.gradient_norm)
            adam.step()
            losses.append(loss.item())
        curve.training.append(float(np.mean(losses)))
        curve.validation.append(_validate(model, data, valid, options))
        if curve.best == epoch:
            best = deepcopy(model.policy.state_dict())
        elif epoch - curve.best >= options.patience:
            break
    model.policy.load_state_dict(best)
    model.policy.set_training_mode(False)
    _set_spread(model, data, valid, options)
    return curve


@torch.no_grad()
def _validate(model: BaseAlgorithm, data: dict[str, torch.Tensor], rows: NDArray, options: CloningOptions) -> float:
    model.policy.set_training_mode(False)
    parts = np.array_split(rows, math.ceil(len(rows) / options.batch_size))
    losses = [_loss(model, _rows(data, part), options).item() for part in parts]
    return float(np.average(losses, weights=[len(part) for part in parts]))


@torch.no_grad()
def _set_spread(model: BaseAlgorithm, data: dict[str, torch.Tensor], rows: NDArray, options: CloningOptions) -> None:
    """Set a Gaussian policy's standard deviation to its error on held-out actions, at least `options.std`.

    It is the maximum likelihood estimate for that mean: the root mean square error.
    """
    if isinstance(model, SAC):
        return
    total, count = torch.zeros((), device=model.device), torch.zeros((), device=model.device)
    for part in np.array_split(rows, math.ceil(len(rows) / options.batch_size)):
        batch = _rows(data, part)
        counted = (batch["weight"].amax(-1, keepdim=True) > 0.0).float()
        missed = (policy_mean(model)(batch["observation"]) - batch["action"]).square() * counted
        total, count = total + missed.flatten(0, -2).sum(0), count + counted.sum()
    model.policy.log_std.copy_((total / count).sqrt().clamp(min=options.std).log())


def _rows(data: dict[str, torch.Tensor], rows: NDArray) -> dict[str, torch.Tensor]:
    return {name: values[rows] for name, values in data.items()}


def _checked(
    model: BaseAlgorithm,
    observations: ArrayLike,
    actions: ArrayLike,
    action_weight: ArrayLike,
    sample_weight: ArrayLike,
    returns: ArrayLike | None,
) -> dict[str, NDArray[np.float32]]:
    """The arrays of a fit, with weights broadcast to the actions; refuses arrays that do not match the model."""
    policy_mean(model)
    observation, action = np.asarray(observations, dtype=np.float32), np.asarray(actions, dtype=np.float32)
    steps = observation.shape[:-1]
    wanted = "(n, n_time, ...)" if is_recurrent(model) else "(n, ...)"
    if len(steps) != (2 if is_recurrent(model) else 1) or len(observation) < 2:
        raise ValueError(f"observations have shape {observation.shape}; the rule is {wanted} with n of 2 or more")
    for name, values, shape in (
        ("observations", observation, (*steps, *model.observation_space.shape)),  # type: ignore[misc]
        ("actions", action, (*steps, *model.action_space.shape)),  # type: ignore[misc]
    ):
        if values.shape != shape:
            raise ValueError(f"{name} have shape {values.shape}; the rule is {shape}")
    weight = np.asarray(sample_weight, dtype=np.float32)[..., None] * np.asarray(action_weight, dtype=np.float32)
    data = {"observation": observation, "action": action, "weight": np.broadcast_to(weight, action.shape).copy()}
    if returns is not None:
        if is_recurrent(model) or isinstance(model, SAC):
            raise ValueError(f"returns fit the critic of PPO; {type(model).__name__} takes none")
        data["value"] = np.broadcast_to(np.asarray(returns, dtype=np.float32), steps).copy()
    for name, values in data.items():
        if not np.isfinite(values).all():
            raise ValueError(f"{name} holds {values[~np.isfinite(values)][0]}; every number must be finite")
    if data["weight"].min() < 0.0 or data["weight"].max() == 0.0:
        raise ValueError(f"weights go from {data['weight'].min()}; they must not be negative, nor all zero")
    data["weight"] /= data["weight"].mean()
    return data


# ---- DAgger ---------------------------------------------------------------------------------------------------------

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
        raise ValueError("DAgger labels single steps; clone a recurrent policy from whole episodes")
    rng = np.random.default_rng(seed)
    seen: list[NDArray] = []
    labels: list[NDArray] = []
    observation, _ = envs.reset(seed=seed)
    begun = np.ones(envs.num_envs, dtype=np.bool_)
    for index in range(rounds):
        share = expert_share(index)
        # Of the episodes that ended in this round; nan where the last info has no `success`.
        won: list[float] = []
        for _ in range(steps):
            wanted = expert(observation, begun)
            seen.append(observation)
            labels.append(np.clip(wanted, -1.0, 1.0).astype(np.float32))
            taken = labels[-1]
            if share < 1.0:
                by_expert = rng.random(envs.num_envs) < share
                shown = observation if normalisation is None else normalisation.normalize_obs(observation)
                taken = np.where(by_expert[:, None], taken, model.predict(shown, deterministic=True)[0])
            if disturbance:
                noise = rng.normal(scale=disturbance, size=taken.shape)
                taken = np.clip(taken + noise, -1.0, 1.0).astype(np.float32)
            observation, _, terminated, truncated, info = envs.step(taken)
            observation, begun = observation.copy(), terminated | truncated
            final, ended = info.get("final_info", {}), np.flatnonzero(begun)
            known = final.get("_success", np.full(envs.num_envs, "success" in final))
            won += [float(final["success"][index]) if known[index] else math.nan for index in ended]
        observations, actions = np.concatenate(seen), np.concatenate(labels)
        if normalisation is not None:
            normalise_by(normalisation, observations)
        curve = clone(
            model, observations, actions, action_weight=action_weight, normalisation=normalisation, options=options
        )
        told = [one for one in won if not math.isnan(one)]
        success = float(np.mean(told)) if told else math.nan
        yield DaggerRound(index, share, len(actions), len(won), success, curve.validation[curve.best])
