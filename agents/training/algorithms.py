"""Algorithms by name, and hyperparameters from YAML values."""

from typing import Any

import sb3_contrib
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import LinearSchedule

from agents.training.extractors import MemorySummary, PlaceAndForce
from agents.training.site_policy import SitePolicy
from surgsim_env.scene.load import nearest

EXTRACTORS = {"MemorySummary": MemorySummary, "PlaceAndForce": PlaceAndForce}
ACTIVATIONS = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU, "elu": torch.nn.ELU}


def algorithms() -> dict[str, type[BaseAlgorithm]]:
    """Every algorithm of stable-baselines3 and sb3-contrib by name."""
    found = {}
    for package in (stable_baselines3, sb3_contrib):
        for name in package.__all__:
            kind = getattr(package, name)
            if isinstance(kind, type) and issubclass(kind, BaseAlgorithm):
                found[name] = kind
    return found


def policy_class(name: str) -> str | type[BasePolicy]:
    """A policy of this project by name; other names are passed on to stable-baselines3."""
    return {"SitePolicy": SitePolicy}.get(name, name)


def algorithm_class(name: str) -> type[BaseAlgorithm]:
    """The class of an algorithm.

    Raises:
        ValueError: an unknown name (suggests the nearest).
    """
    known = algorithms()
    if name not in known:
        raise ValueError(f"algorithm {name!r} is unknown{nearest(name, sorted(known))} (known: {', '.join(known)})")
    return known[name]


def keywords(hyperparameters: dict[str, Any]) -> dict[str, Any]:
    """Hyperparameters as the algorithm's arguments: `{linear: x}` becomes a schedule, some names become classes.

    Raises:
        ValueError: an activation function or a features extractor that is unknown.
    """
    made = dict(hyperparameters)
    for name, value in hyperparameters.items():
        if isinstance(value, dict) and set(value) == {"linear"}:
            made[name] = LinearSchedule(float(value["linear"]), 0.0, 1.0)
    policy = dict(made.get("policy_kwargs") or {})
    for entry, known in (("activation_fn", ACTIVATIONS), ("features_extractor_class", EXTRACTORS)):
        if entry in policy:
            if policy[entry] not in known:
                raise ValueError(
                    f"hyperparameters.policy_kwargs.{entry} is {policy[entry]!r}; known are {', '.join(known)}"
                )
            policy[entry] = known[policy[entry]]
    return made | {"policy_kwargs": policy} if policy else made
