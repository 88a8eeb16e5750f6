"""Features of a long observation of SurgSim/Palpate-v0 with memory, for learning from scratch."""

import torch
from torch import nn

from surgsim_env.palpation import MAP_CELL, MAP_SIDE
from surgsim_env.tasks import LENGTH_SCALE, PalpateTask, channel_slices

# Radius of the blocks' tip [m].
TIP_RADIUS = 0.008
# Reach of the search over unfelt sites, in the unit of positions.
SEARCH_REACH = 0.8
# A press is about a quarter of the soft limit, and a lesion about a quarter stiffer than the tissue around it.
GAIN = 4.0
# Channels of the observation in frame="world", in which those of frame="face" have no entry.
CHANNELS = channel_slices(
    PalpateTask,
    **dict.fromkeys(("tip_place", "tip_depth", "surface_normal", "face_force", "map_cell", "chart_share"), 0),
    **dict.fromkeys(("contrast", "visited", "face"), MAP_SIDE**2),
    stiffest=3,
)


class TouchSummary(nn.Module):
    """16 numbers of order 1.

    Tip position (3), force along z (1, times 4), time left (1), stiffest place and contrast (3), felt share of the face
    (1), 1 after the first touch (1), mean contrast c of felt sites (1), the excess of the stiffest over it,
    4 (c_max / c - 1) (1); the way from the tip to the stiffest place (2), and to the centroid of unfelt sites weighted
    by exp(-(d / 8 mm)^2 / 2) of their distance d, the direction of a search (2). Ways are about right on a block in the
    middle of the workspace, under a tip of 8 mm radius. The observation is not normalised.
    """

    features_dim = 16

    def __init__(self) -> None:
        super().__init__()
        steps = (torch.arange(MAP_SIDE, dtype=torch.float32) - MAP_SIDE // 2) * MAP_CELL * TIP_RADIUS / LENGTH_SCALE
        y, x = torch.meshgrid(steps, steps, indexing="ij")
        self.sites: torch.Tensor
        self.register_buffer("sites", torch.stack([x, y], dim=-1).reshape(-1, 2), persistent=False)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """The features (n, 16) of observations (n, n_observation)."""
        seen = {name: observations[:, part] for name, part in CHANNELS.items()}
        contrast, visited, face, stiffest = (seen[name] for name in ("contrast", "visited", "face", "stiffest"))
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
        excess = felt * (GAIN * (stiffest[:, 2] / mean.clamp(min=0.1) - 1.0)).clamp(-4.0, 4.0)
        share = count / face.sum(dim=1).clamp(min=1.0)
        tip = seen["tip_position"][:, :2]
        way = felt[:, None] * (half * stiffest[:, :2] - tip)
        distance = ((sites - tip[:, None]) ** 2).sum(dim=2)
        unfelt = face * (1.0 - visited) * torch.exp(-0.5 * distance / SEARCH_REACH**2)
        total = unfelt.sum(dim=1, keepdim=True)
        fresh = (total > 1e-6) * (unfelt @ sites / total.clamp(min=1e-6) - tip)
        read = [seen["tip_position"], GAIN * seen["contact_force"][:, 2:], seen["time_left"], stiffest]
        return torch.cat([*read, torch.stack([share, felt, mean, excess], dim=1), way, fresh], dim=1)
