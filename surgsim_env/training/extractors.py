"""Feature extractors: the part of a long observation that a network reads."""

import gymnasium as gym
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from surgsim_env.palpation.chart import MAP_CELL, MAP_SIDE
from surgsim_env.tasks.palpate import PalpateTask
from surgsim_env.tasks.task import LENGTH_SCALE

# Radius of the blocks' tip [m], for `TouchSummary`.
TIP_RADIUS = 0.008
# Reach of its search over sites that were not felt, in the unit of positions.
SEARCH_REACH = 0.8


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
        check_length(observation_space, WITH_MEMORY, memory=True)
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


class TouchSummary(_Entries):
    """Of Palpate-v0 with memory, for learning from scratch: 16 numbers of order 1.

    Tip position (3), force along z (1, times 4), time left (1), stiffest place and contrast (3), share of the face that
    was felt (1), whether anything was (1), mean contrast c of the sites felt (1), the excess of the stiffest over it,
    4 (c_max / c - 1) (1); the way from the tip to the stiffest place (2), and to the centroid of the sites not felt
    weighted by exp(-(d / 8 mm)^2 / 2) of their distance d, the direction of a search (2). Ways are about right on a
    block whose middle is that of the workspace, under a tip of 8 mm radius. Force and excess are multiplied because a
    press is about a quarter of the soft limit, and a lesion about a quarter stiffer than what surrounds it. The
    observation is that of the environment, not normalised.
    """

    def __init__(self, observation_space: gym.Space) -> None:
        """Choose the entries.

        Raises:
            ValueError: an observation that is not Palpate-v0's with memory.
        """
        check_length(observation_space, WITH_MEMORY, memory=True)
        time, stiffest = WITH_MEMORY["time_left"], WITH_MEMORY["stiffest"]
        entries = [*place_and_force(WITH_MEMORY), time.start, *range(stiffest.start, stiffest.stop)]
        super().__init__(observation_space, entries, added=8)
        gain = torch.ones(len(entries))
        gain[FORCE_PLACE] = 4.0
        self.gain: torch.Tensor
        self.register_buffer("gain", gain, persistent=False)
        steps = (torch.arange(MAP_SIDE, dtype=torch.float32) - MAP_SIDE // 2) * MAP_CELL * TIP_RADIUS / LENGTH_SCALE
        y, x = torch.meshgrid(steps, steps, indexing="ij")
        self.sites: torch.Tensor
        self.register_buffer("sites", torch.stack([x, y], dim=-1).reshape(-1, 2), persistent=False)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """The features (n, 16) of observations (n, n_observation)."""
        contrast, visited, face = (observations[:, WITH_MEMORY[name]] for name in ("contrast", "visited", "face"))
        # Half of the chart's sides, in the unit of positions: columns and rows of its sites, MAP_CELL tip radii apart.
        rows = face.reshape(-1, MAP_SIDE, MAP_SIDE)
        sides = torch.stack([rows.amax(dim=1).sum(dim=1), rows.amax(dim=2).sum(dim=1)], dim=1)
        half = 0.5 * (sides - 1.0) * MAP_CELL * TIP_RADIUS / LENGTH_SCALE
        # Most of the map lies beyond a small face.
        used = face.amax(dim=0) > 0.5
        contrast, visited, face, sites = contrast[:, used], visited[:, used], face[:, used], self.sites[used]
        count = visited.sum(dim=1)
        felt = (count > 0.5).to(observations.dtype)
        mean = (contrast * visited).sum(dim=1) / count.clamp(min=1.0)
        # A mean near 0 is noise: the excess is bounded there.
        stiffest = observations[:, WITH_MEMORY["stiffest"].stop - 1]
        excess = felt * (4.0 * (stiffest / mean.clamp(min=0.1) - 1.0)).clamp(-4.0, 4.0)
        share = count / face.sum(dim=1).clamp(min=1.0)
        place = observations[:, WITH_MEMORY["stiffest"].start : WITH_MEMORY["stiffest"].stop - 1]
        tip = observations[:, self.entries[:2]]
        way = felt[:, None] * (half * place - tip)
        distance = ((sites - tip[:, None]) ** 2).sum(dim=2)
        unfelt = face * (1.0 - visited) * torch.exp(-0.5 * distance / SEARCH_REACH**2)
        total = unfelt.sum(dim=1, keepdim=True)
        fresh = (total > 1e-6) * (unfelt @ sites / total.clamp(min=1e-6) - tip)
        added = torch.stack([share, felt, mean, excess], dim=1)
        return torch.cat([super().forward(observations) * self.gain, added, way, fresh], dim=1)


class PlaceAndForce(_Entries):
    """Of Palpate-v0 without memory: the tip's place and the force along z, for the reason given in `MemorySummary`."""

    def __init__(self, observation_space: gym.Space) -> None:
        """Choose the entries.

        Raises:
            ValueError: an observation that is not Palpate-v0's without memory.
        """
        check_length(observation_space, WITHOUT_MEMORY, memory=False)
        super().__init__(observation_space, place_and_force(WITHOUT_MEMORY))


# Sizes of the channels of frame="face" in frame="world".
WORLD = dict.fromkeys(("tip_place", "tip_depth", "surface_normal", "face_force", "map_cell", "chart_share"), 0)
# Channels of Palpate-v0's observation without and with memory.
WITHOUT_MEMORY = PalpateTask.channel_slices(contrast=0, visited=0, face=0, stiffest=0, **WORLD)
WITH_MEMORY = PalpateTask.channel_slices(
    contrast=MAP_SIDE**2, visited=MAP_SIDE**2, face=MAP_SIDE**2, stiffest=3, **WORLD
)
# Directions of the map's diagonals.
DIAGONALS = ((-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0))


# Place of the force along z among the entries of `place_and_force`.
FORCE_PLACE = 3


def check_length(observation_space: gym.Space, slices: dict[str, slice], *, memory: bool) -> None:
    """Refuse an observation that is not Palpate-v0's with or without memory.

    Raises:
        ValueError: another shape.
    """
    length = max(part.stop for part in slices.values())
    if observation_space.shape != (length,):
        raise ValueError(
            f"an observation of shape {observation_space.shape} is not that of Palpate-v0 with memory={memory} "
            f"({length},): leave the features extractor out"
        )


def place_and_force(slices: dict[str, slice]) -> list[int]:
    """Entries of the tip's position and of the contact force along z."""
    tip, force = slices["tip_position"], slices["contact_force"]
    return [*range(tip.start, tip.stop), force.stop - 1]
