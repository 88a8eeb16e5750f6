"""Policies as files: NAME.zip is stable-baselines3's, NAME.json states its environment and preprocessing.

A zip holds pickles: load only files that you trust.
"""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import sb3_contrib
import stable_baselines3
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from agents.scoring.site_agent import SiteFacts
from agents.training.environments import blinded
from agents.training.site_policy import SiteBelief
from surgsim_env.scene.load import nearest

# Defaults of VecNormalize: epsilon of variances and clip of observations.
VARIANCE_SLACK = 1e-8
CUT = 10.0


def algorithm_class(name: str) -> type[BaseAlgorithm]:
    """The class of an algorithm of stable-baselines3 or sb3-contrib.

    Raises:
        ValueError: an unknown name (suggests the nearest).
    """
    classes = [(one, getattr(package, one)) for package in (stable_baselines3, sb3_contrib) for one in package.__all__]
    known = {one: kind for one, kind in classes if isinstance(kind, type) and issubclass(kind, BaseAlgorithm)}
    if name not in known:
        raise ValueError(f"algorithm {name!r} is unknown{nearest(name, sorted(known))} (known: {', '.join(known)})")
    return known[name]


@dataclass(frozen=True)
class PolicyDescription:
    """Content of NAME.json.

    Fields:
        algorithm: class of the model in NAME.zip
        env_id, env_kwargs: environment of the policy
        action_repeat: control steps per decision
        force_entries: entries of the observation that are set to 0; empty for a policy with force
        belief: fields of `SiteFacts` for a policy on belief maps whose action is a site's number; else None
        observation_mean, observation_variance: of the normalisation; None without one
        trained_steps, seed, score: of its training
    """

    algorithm: str
    env_id: str
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    action_repeat: int = 1
    force_entries: list[int] = field(default_factory=list)
    belief: dict[str, Any] | None = None
    observation_mean: list[float] | None = None
    observation_variance: list[float] | None = None
    trained_steps: int = 0
    seed: int = 0
    score: float | None = None


def describe(model: BaseAlgorithm, normalisation: VecNormalize | None, **fields: Any) -> PolicyDescription:
    """The description of a model with its normalisation; `fields` are the other entries."""
    if normalisation is not None and normalisation.norm_obs:
        statistics: Any = normalisation.obs_rms
        fields |= {"observation_mean": statistics.mean.tolist(), "observation_variance": statistics.var.tolist()}
    return PolicyDescription(algorithm=type(model).__name__, **fields)


class TrainedPolicy:
    """A policy with its preprocessing and action repeat; `act` is called each control step.

    policy = load_policy(Path("agents/policies/NAME.zip"))
    policy.reset(env_count)
    actions = policy.act(observations, begins)
    """

    def __init__(self, model: BaseAlgorithm, description: PolicyDescription) -> None:
        self.model = model
        self.description = description
        self.belief = None if description.belief is None else SiteBelief(SiteFacts(**description.belief))
        self.reset(1)

    def reset(self, count: int) -> None:
        """Begin episodes in `count` environments."""
        self._state: Any = None
        self._since = np.zeros(count, dtype=np.int64)
        # Of the model, or places where the model returns a site's number.
        space: Any = self.model.action_space if self.belief is None else self.belief.action_space
        self._actions = np.zeros((count, *space.shape), dtype=space.dtype)

    def act(self, observations: NDArray[Any], begins: NDArray[np.bool_] | None = None) -> NDArray:
        """Deterministic actions (n, n_action) for raw observations (n, n_observation).

        An episode begins where `begins` (n,) is true; without it at the first call after `reset` alone.
        """
        begins = self._since == 0 if begins is None else begins
        self._since[begins] = 0
        deciding = self._since % self.description.action_repeat == 0
        self._since += 1
        if deciding.any():
            seen = self.seen(observations)
            actions, state = self.model.predict(seen, state=self._state, episode_start=begins, deterministic=True)
            if self.belief is not None:
                actions = self.belief.action(actions)
            self._actions[deciding] = actions[deciding]
            if self._state is not None and state is not None and not deciding.all():
                # The recurrent state (layers, n, size) is new where a decision was made.
                pairs = zip(self._state, state, strict=True)
                state = tuple(np.where(deciding[None, :, None], new, old) for old, new in pairs)
            self._state = state
        return self._actions.copy()

    def seen(self, observations: NDArray[Any]) -> NDArray[np.float32]:
        """Observations as the network reads them: force removed, then belief maps, then normalised."""
        one = self.description
        values = blinded(observations, one.force_entries) if one.force_entries else observations
        if self.belief is not None:
            values = self.belief.features(values)
        if one.observation_mean is None or one.observation_variance is None:
            return values
        scale = np.sqrt(np.asarray(one.observation_variance) + VARIANCE_SLACK)
        return np.clip((values - np.asarray(one.observation_mean)) / scale, -CUT, CUT).astype(np.float32)


def save_policy(model: BaseAlgorithm, description: PolicyDescription, path: Path) -> None:
    """Write NAME.zip and, beside it, NAME.json."""
    model.save(path.with_suffix(".zip"))
    text = json.dumps(asdict(description), indent=1)
    path.with_suffix(".json").write_text(text + "\n", encoding="utf-8")


def load_policy(path: Path) -> TrainedPolicy:
    """The policy of NAME.zip, which NAME.json describes.

    Raises:
        ValueError: one of the two files is missing.
    """
    for suffix in (".zip", ".json"):
        if not path.with_suffix(suffix).is_file():
            raise ValueError(f"policy {path}: there is no file {path.with_suffix(suffix).name} beside it")
    description = PolicyDescription(**json.loads(path.with_suffix(".json").read_text(encoding="utf-8")))
    model = algorithm_class(description.algorithm).load(path.with_suffix(".zip"), device="cpu")
    return TrainedPolicy(model, description)
