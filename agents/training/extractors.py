"""Feature extractors: the part of a long observation that a network reads."""

import gymnasium as gym
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from surgsim_env.palpation.chart import MAP_SIDE
from surgsim_env.tasks.palpate import PalpateTask


class _Entries(BaseFeaturesExtractor):
    """Some entries of the observation, and `added` features that a subclass computes."""

    def __init__(self, observation_space: gym.Space, entries: list[int], added: int = 0) -> None:
        super().__init__(observation_space, len(entries) + added)
        self.entries: torch.Tensor
        self.register_buffer("entries", torch.tensor(entries))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """The chosen entries of observations (n, n_observation)."""
        return observations[:, self.entries]


class MemorySummary(_Entries):
    """Of Palpate-v0 with memory: place of the tip, force along z, stiffest place, marks of the face's corners.

    The corners are the sites of the palpable face that are farthest along the map's diagonals. Velocity, friction, time
    and the other marks are left out: they reveal the last action, and a cloned network learns to repeat it (de Haan,
    Jayaraman & Levine 2019, "Causal confusion in imitation learning"); with them it stopped between rows.
    """

    def __init__(self, observation_space: gym.Space) -> None:
        """Choose the entries.

        Raises:
            ValueError: an observation that is not Palpate-v0's with memory.
        """
        assert observation_space.shape is not None
        length = max(part.stop for part in WITH_MEMORY.values())
        if observation_space.shape != (length,):
            raise ValueError(
                f"an observation of shape {observation_space.shape} is not that of Palpate-v0 with memory=True "
                f"({length},): leave the features extractor out"
            )
        stiffest = WITH_MEMORY["stiffest"]
        entries = [*place_and_force(WITH_MEMORY), *range(stiffest.start, stiffest.stop)]
        super().__init__(observation_space, entries, added=len(DIAGONALS))
        steps = torch.arange(MAP_SIDE, dtype=torch.float32) - MAP_SIDE // 2
        y, x = torch.meshgrid(steps, steps, indexing="ij")
        self.along: torch.Tensor
        self.register_buffer("along", torch.stack([a * x + b * y for a, b in DIAGONALS]).flatten(1), persistent=False)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """The features of observations (n, n_observation); marks and face are read as 0 or 1, so not normalised."""
        face, visited = (observations[:, WITH_MEMORY[name]] for name in ("face", "visited"))
        corner = torch.where(face[:, None] > 0.5, self.along, -torch.inf).argmax(dim=2)
        return torch.cat([super().forward(observations), visited.gather(1, corner)], dim=1)


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


# Channels of Palpate-v0's observation without and with memory.
WITHOUT_MEMORY = PalpateTask.channel_slices(contrast=0, visited=0, face=0, stiffest=0)
WITH_MEMORY = PalpateTask.channel_slices(contrast=MAP_SIDE**2, visited=MAP_SIDE**2, face=MAP_SIDE**2, stiffest=3)
# Directions of the map's diagonals.
DIAGONALS = ((-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0))


def place_and_force(slices: dict[str, slice]) -> list[int]:
    """Entries of the tip's position and of the contact force along z."""
    tip, force = slices["tip_position"], slices["contact_force"]
    return [*range(tip.start, tip.stop), force.stop - 1]
