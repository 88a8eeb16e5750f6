"""Features of a small picture and the force readings beside it, for policies that see nothing else."""

import gymnasium as gym
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

# Channels of the three convolutions, and side of the coarse map that is read beside the places of features.
WIDTHS = (12, 24, 24)
COARSE_SIDE = 6


class PictureAndForce(BaseFeaturesExtractor):
    """Of obs_mode "rgb_force": where each feature of the picture lies, a coarse map of the features, and the force.

    The place of a feature is the mean of the pixels' places, weighted by the softmax of its map (Levine et al. 2016,
    "End-to-end training of deep visuomotor policies").
    """

    def __init__(self, observation_space: gym.spaces.Dict) -> None:
        """Make the convolutions.

        Raises:
            ValueError: an observation without a picture and a force (names what it has).
        """
        parts = observation_space.spaces if isinstance(observation_space, gym.spaces.Dict) else {}
        if set(parts) != {"picture", "force"}:
            raise ValueError(
                f"an observation of {', '.join(parts) or type(observation_space).__name__} has no picture and force: "
                'make the environment with obs_mode="rgb_force"'
            )
        depth, height, width = parts["picture"].shape or (0, 0, 0)
        force_count = int((parts["force"].shape or (0,))[0])
        first, second, third = WIDTHS
        super().__init__(observation_space, 2 * third + third * COARSE_SIDE**2 + force_count)
        self.convolutions = nn.Sequential(
            nn.Conv2d(depth, first, 5, stride=2),
            nn.ReLU(),
            nn.Conv2d(first, second, 4, stride=2),
            nn.ReLU(),
            nn.Conv2d(second, third, 3),
            nn.ReLU(),
        )
        self.sharpness = nn.Parameter(torch.ones(third))
        with torch.no_grad():
            _, _, rows, columns = self.convolutions(torch.zeros(1, depth, height, width)).shape
        places = torch.meshgrid(torch.linspace(-1.0, 1.0, rows), torch.linspace(-1.0, 1.0, columns), indexing="ij")
        self.places: torch.Tensor
        self.register_buffer("places", torch.stack([one.ravel() for one in places], dim=1), persistent=False)
        self.coarse = nn.AdaptiveAvgPool2d(COARSE_SIDE)

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """The features (n, n_feature) of pictures (n, 3, height, width) in [0, 1] and forces (n, n_force)."""
        maps = self.convolutions(observations["picture"] - 0.5)
        weight = torch.softmax(self.sharpness[:, None] * maps.flatten(2), dim=2)
        place = weight @ self.places
        return torch.cat([place.flatten(1), self.coarse(maps).flatten(1), observations["force"]], dim=1)
