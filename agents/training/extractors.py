"""What networks see of long observations."""

import math

import gymnasium as gym
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

# Entries of Palpate-v0's observation before the memory's grids, and behind them.
BEFORE, BEHIND = 10, 3
# Of the former: the tip's place and the force along z.
SEEN = (0, 1, 2, 8)


class MemorySummary(BaseFeaturesExtractor):
    """Of Palpate-v0 with memory: the tip's place, the force along z, the marks of the corners, the stiffest place.

    Velocity, friction, time and the other marks are left out: they tell what was done last, and a network that is
    taught what an expert does learns to do that again instead (de Haan, Jayaraman & Levine 2019, "Causal confusion in
    imitation learning"); with them it came to stand still between rows.
    """

    def __init__(self, observation_space: gym.Space) -> None:
        """Choose the entries.

        Raises:
            ValueError: an observation that is not Palpate-v0's with memory.
        """
        assert observation_space.shape is not None
        length = observation_space.shape[0]
        site_count = (length - BEFORE - BEHIND) // 2
        side = math.isqrt(max(site_count, 0))
        if site_count < 1 or side**2 != site_count or length != BEFORE + 2 * site_count + BEHIND:
            raise ValueError(
                f"an observation of {length} numbers is not that of Palpate-v0 with memory=True "
                f"({BEFORE} + 2 side^2 + {BEHIND}): leave the features extractor out"
            )
        corners = (0, side - 1, site_count - side, site_count - 1)
        marks = [BEFORE + site_count + corner for corner in corners]
        entries = [*SEEN, *marks, *range(length - BEHIND, length)]
        super().__init__(observation_space, len(entries))
        self.entries: torch.Tensor
        self.register_buffer("entries", torch.tensor(entries))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """The chosen entries of normalised observations (n, n_observation)."""
        return observations[:, self.entries]


class PlaceAndForce(BaseFeaturesExtractor):
    """Of Palpate-v0 without memory: the tip's place and the force along z, as `MemorySummary` says why."""

    def __init__(self, observation_space: gym.Space) -> None:
        """Choose the entries.

        Raises:
            ValueError: an observation that is not Palpate-v0's without memory.
        """
        if observation_space.shape != (BEFORE,):
            raise ValueError(
                f"an observation of shape {observation_space.shape} is not that of Palpate-v0 with memory=False "
                f"({BEFORE},): leave the features extractor out"
            )
        super().__init__(observation_space, len(SEEN))
        self.entries: torch.Tensor
        self.register_buffer("entries", torch.tensor(SEEN))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """The chosen entries of normalised observations (n, 10)."""
        return observations[:, self.entries]
