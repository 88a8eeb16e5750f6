"""Feature extractors: the part of a long observation that a network reads."""

import math

import gymnasium as gym
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from surgsim_env.tasks.palpate import PalpateTask


class _Entries(BaseFeaturesExtractor):
    """Some entries of the observation."""

    def __init__(self, observation_space: gym.Space, entries: list[int]) -> None:
        super().__init__(observation_space, len(entries))
        self.entries: torch.Tensor
        self.register_buffer("entries", torch.tensor(entries))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """The chosen entries of normalised observations (n, n_observation)."""
        return observations[:, self.entries]


class MemorySummary(_Entries):
    """Of Palpate-v0 with memory: the tip's place, the force along z, the marks of the corners, the stiffest place.

    Velocity, friction, time and the other marks are left out: they reveal the last action, and a cloned network learns
    to repeat it (de Haan, Jayaraman & Levine 2019, "Causal confusion in imitation learning"); with them it stopped
    between rows.
    """

    def __init__(self, observation_space: gym.Space) -> None:
        """Choose the entries.

        Raises:
            ValueError: an observation that is not Palpate-v0's with memory.
        """
        assert observation_space.shape is not None
        length = observation_space.shape[0]
        site_count = (length - observation_length(0)) // 2
        side = math.isqrt(max(site_count, 0))
        if site_count < 1 or side**2 != site_count or length != observation_length(site_count):
            raise ValueError(
                f"an observation of {length} numbers is not that of Palpate-v0 with memory=True "
                f"({observation_length(0)} + 2 side^2): leave the features extractor out"
            )
        slices = PalpateTask.channel_slices(contrast=site_count, visited=site_count, stiffest=3)
        corners = (0, side - 1, site_count - side, site_count - 1)
        marks = [slices["visited"].start + corner for corner in corners]
        stiffest = slices["stiffest"]
        super().__init__(observation_space, [*place_and_force(slices), *marks, *range(stiffest.start, stiffest.stop)])


class PlaceAndForce(_Entries):
    """Of Palpate-v0 without memory: the tip's place and the force along z, for the reason given in `MemorySummary`."""

    def __init__(self, observation_space: gym.Space) -> None:
        """Choose the entries.

        Raises:
            ValueError: an observation that is not Palpate-v0's without memory.
        """
        length = max(part.stop for part in WITHOUT_MEMORY.values())
        if observation_space.shape != (length,):
            raise ValueError(
                f"an observation of shape {observation_space.shape} is not that of Palpate-v0 with memory=False "
                f"({length},): leave the features extractor out"
            )
        super().__init__(observation_space, place_and_force(WITHOUT_MEMORY))


# Channels of Palpate-v0's observation without memory.
WITHOUT_MEMORY = PalpateTask.channel_slices(contrast=0, visited=0, stiffest=0)


def observation_length(site_count: int) -> int:
    """Length of Palpate-v0's observation with a memory of `site_count` sites."""
    slices = PalpateTask.channel_slices(contrast=site_count, visited=site_count, stiffest=3)
    return max(part.stop for part in slices.values())


def place_and_force(slices: dict[str, slice]) -> list[int]:
    """Entries of the tip's position and of the contact force along z."""
    tip, force = slices["tip_position"], slices["contact_force"]
    return [*range(tip.start, tip.stop), force.stop - 1]
