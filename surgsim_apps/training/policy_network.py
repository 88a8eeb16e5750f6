"""The network of a policy: features of the observation, hidden layers, and the mean of the action."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from surgsim_apps.training.face_features import FaceSummary
from surgsim_apps.training.picture_features import PictureAndForce

ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU}
FEATURES: dict[str, type[nn.Module]] = {
    "FaceSummary": FaceSummary,
    "PictureAndForce": PictureAndForce,
}
# Defaults of stable-baselines3's VecNormalize: epsilon of variances and clip of observations.
VARIANCE_SLACK = 1e-8
CUT = 10.0


@dataclass(frozen=True)
class NetworkLayout:
    """The names of a network's parts.

    Args:
        activation: between the layers, a name of ACTIVATIONS.
        features: input of the layers, a name of FEATURES; the observation itself if None.
    """

    activation: str = "tanh"
    features: str | None = None


class PolicyNetwork(nn.Module):
    """A policy's network, from observations to mean actions."""

    def __init__(
        self, layout: NetworkLayout, sizes: Sequence[int], *, normalised: bool = False, drawn: bool = False
    ) -> None:
        """Make the network with torch's initial weights.

        Args:
            layout: names of its parts.
            sizes: of the layers' input, of each hidden layer and of the action.
            normalised: True to normalise observations first (`normalise_by`).
            drawn: True to draw actions around their mean, with standard deviations exp(`log_spread`).
        """
        super().__init__()
        self.layout = layout
        self.features = nn.Identity() if layout.features is None else FEATURES[layout.features]()
        parts: list[nn.Module] = []
        for inputs, outputs in pairwise(sizes):
            parts += [nn.Linear(inputs, outputs), ACTIVATIONS[layout.activation]()]
        self.layers = nn.Sequential(*parts[:-1])
        self.action_size = sizes[-1]
        self.mean: torch.Tensor | None
        self.variance: torch.Tensor | None
        self.log_spread: torch.Tensor | None
        for name in ("mean", "variance"):
            self.register_buffer(name, torch.ones(sizes[0], dtype=torch.float64) if normalised else None)
        self.register_buffer("log_spread", torch.zeros(self.action_size) if drawn else None)

    def normalise_by(self, observations: NDArray[np.floating]) -> None:
        """Set the normalisation to mean and variance of observations (n, n_observation).

        An entry that never changes gets the variance 1: its scale is unknown.
        """
        values = np.asarray(observations, dtype=np.float64)
        self.mean = torch.as_tensor(values.mean(axis=0))
        self.variance = torch.as_tensor(np.where(np.ptp(values, axis=0) == 0.0, 1.0, values.var(axis=0)))

    def read(self, observations: Any) -> Any:
        """The input of the features: normalised observations, or pictures in [0, 1], colours first, beside forces.

        Observations are an array (n, n_observation) or a dictionary of `picture` (n, height, width, 3) and `force`.
        """
        if isinstance(observations, dict):
            picture = torch.as_tensor(observations["picture"]).permute(0, 3, 1, 2)
            return {"picture": picture.float() / 255.0, "force": torch.as_tensor(observations["force"])}
        values = torch.as_tensor(observations)
        if self.mean is None or self.variance is None:
            return values
        scaled = (values.double() - self.mean) / (self.variance + VARIANCE_SLACK).sqrt()
        return scaled.clamp(-CUT, CUT).float()

    def forward(self, observations: Any) -> torch.Tensor:
        """Mean actions (n, n_action) for observations of `read`."""
        return self.layers(self.features(self.read(observations)))

    @torch.no_grad()
    def actions(self, observations: Any, generators: Sequence[torch.Generator]) -> NDArray[np.float32]:
        """Actions (n, n_action) in [-1, 1]; drawn ones by a generator for each row."""
        if self.log_spread is None:
            return self(observations).clamp(-1.0, 1.0).numpy()
        rows = []
        for index, generator in enumerate(generators):
            # Row by row: the bits of a product of matrices depend on the number of rows.
            row = slice(index, index + 1)
            alone = {name: part[row] for name, part in observations.items()} if isinstance(observations, dict) else None
            mean = self(observations[row] if alone is None else alone)
            noise = torch.randn(mean.shape, generator=generator)
            rows.append((mean + noise * self.log_spread.exp()).clamp(-1.0, 1.0))
        return torch.cat(rows).numpy()


def actor_of(policy: Any, layout: NetworkLayout, *, drawn: bool = False) -> PolicyNetwork:
    """The actor of a policy of stable-baselines3's PPO or A2C as a `PolicyNetwork`.

    Args:
        policy: an ActorCriticPolicy with hidden layers of one activation and without state-dependent exploration.
        layout: names of its parts.
        drawn: keep the standard deviation of its actions.
    """
    linear = [layer for layer in [*policy.mlp_extractor.policy_net, policy.action_net] if isinstance(layer, nn.Linear)]
    network = PolicyNetwork(layout, [linear[0].in_features, *(layer.out_features for layer in linear)], drawn=drawn)
    for own, trained in zip((layer for layer in network.layers if isinstance(layer, nn.Linear)), linear, strict=True):
        own.load_state_dict(trained.state_dict())
    network.features.load_state_dict(policy.features_extractor.state_dict())
    if drawn:
        network.log_spread = policy.log_std.detach().clone()
    return network
