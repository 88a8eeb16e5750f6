"""Features of a small picture and its force readings, for policies without other inputs."""

import torch
from torch import nn

# Side of the pictures of obs_mode "rgb_force" [pixels], and its force readings.
PICTURE_SIDE, FORCE_COUNT = 84, 8
# Channels of the three convolutions, and side of the coarse map beside the places of features.
WIDTHS = (12, 24, 24)
COARSE_SIDE = 6


class PictureAndForce(nn.Module):
    """Inputs of obs_mode "rgb_force": places of the picture's features, their coarse map, and the force.

    The place of a feature is the mean of the pixels' places, weighted by the softmax of its map (Levine et al. 2016,
    "End-to-end training of deep visuomotor policies").
    """

    def __init__(self) -> None:
        super().__init__()
        first, second, third = WIDTHS
        self.features_dim = 2 * third + third * COARSE_SIDE**2 + FORCE_COUNT
        self.convolutions = nn.Sequential(
            nn.Conv2d(3, first, 5, stride=2),
            nn.ReLU(),
            nn.Conv2d(first, second, 4, stride=2),
            nn.ReLU(),
            nn.Conv2d(second, third, 3),
            nn.ReLU(),
        )
        self.sharpness = nn.Parameter(torch.ones(third))
        with torch.no_grad():
            _, _, rows, columns = self.convolutions(torch.zeros(1, 3, PICTURE_SIDE, PICTURE_SIDE)).shape
        places = torch.meshgrid(torch.linspace(-1.0, 1.0, rows), torch.linspace(-1.0, 1.0, columns), indexing="ij")
        self.places: torch.Tensor
        self.register_buffer("places", torch.stack([axis.ravel() for axis in places], dim=1), persistent=False)
        self.coarse = nn.AdaptiveAvgPool2d(COARSE_SIDE)

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """The features (n, features_dim) of pictures (n, 3, height, width) in [0, 1] and forces (n, FORCE_COUNT)."""
        maps = self.convolutions(observations["picture"] - 0.5)
        weight = torch.softmax(self.sharpness[:, None] * maps.flatten(2), dim=2)
        place = weight @ self.places
        return torch.cat([place.flatten(1), self.coarse(maps).flatten(1), observations["force"]], dim=1)
