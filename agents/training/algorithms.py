"""Algorithms by name, and their hyperparameters from what YAML can say."""

from typing import Any

import sb3_contrib
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import LinearSchedule

from agents.site_policy import SitePolicy
from surgsim_env.toml_tables import nearest

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
    """A policy of this project by name; a name of stable-baselines3's as it is."""
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
    """Hyperparameters as the algorithm takes them: `{linear: x}` is a schedule, activation functions are classes.

    Raises:
        ValueError: an activation function that is unknown.
    """
    made = dict(hyperparameters)
    for name, value in hyperparameters.items():
        if isinstance(value, dict) and set(value) == {"linear"}:
            made[name] = LinearSchedule(float(value["linear"]), 0.0, 1.0)
    policy = made.get("policy_kwargs")
    if policy and "activation_fn" in policy:
        name = policy["activation_fn"]
        if name not in ACTIVATIONS:
            raise ValueError(
                f"hyperparameters.policy_kwargs.activation_fn is {name!r}; known are {', '.join(ACTIVATIONS)}"
            )
        made["policy_kwargs"] = {**policy, "activation_fn": ACTIVATIONS[name]}
    return made
