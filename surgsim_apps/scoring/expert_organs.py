"""A scripted expert for SurgSim/Palpate-v0 on any organ, with memory=True and frame="face".

It has no state: each action is a function of `surgsim_apps.training.face_features` of one observation, so that a
network can learn it (`agents/learn_palpate_organs.py`). The tip slides at a constant depth along rows of the face, less
deep near the soft limit of force. After a clearly stiffer place, or the last row, it searches across the row there,
goes to the stiffest place and declares it. Lengths are in tip radii and forces over the soft limit, so that the same
numbers suit all organs.
"""

import numpy as np
import torch
from numpy.typing import NDArray

from surgsim_apps.training.face_features import FACE, UPRIGHT, FaceFeatures, face_features

DEPTH = 0.42  # [tip radii] of the sliding ball
GAP = 0.15  # [tip radii] between tip and surface on the way to the first row
FORCE_MOST = 0.55  # [soft limits] above it the tip lifts
FORCE_GAIN = 6.0  # full speed upwards at an excess of 1/6 soft limit
SLOW = 0.3  # [tip radii] below this distance speed is proportional to it
DEPTH_SLOW = 0.2  # [tip radii] the same of depth
START_NEAR = 0.6  # [tip radii] from the first row's start the tip descends
DECLARE_NEAR = 0.2  # [tip radii] from the stiffest place it declares
EXCESS = 0.5  # least of a lesion: contrast over the median, less 1
LAST = 0.12  # share of the time left at the end of the search


def expert_actions(seen: FaceFeatures) -> torch.Tensor:
    """Actions (n, 4) for features: along the rows, then across them at the stiffest place, then there, and declare."""
    felt_lesion = (seen.excess > EXCESS) & (seen.passed > 0.5)
    over = (seen.rows_left == 0.0) | felt_lesion | ((seen.time_left < LAST) & (seen.begun > 0.5))
    refining = over & (seen.across_left > 0.5)
    way = torch.where(over[:, None], seen.stiffest_way, seen.row_way)
    way = torch.where(refining[:, None], seen.across_way, way)
    distance = way.abs().amax(dim=1)
    # In the air on the way to the first row.
    low = (seen.begun > 0.5) | (distance < START_NEAR)
    return _actions(seen, way, low, over & ~refining & (distance < DECLARE_NEAR))


def blind_actions(seen: FaceFeatures, place: torch.Tensor) -> torch.Tensor:
    """Actions (n, 4) for declaring in the middle of the face, for features and places (n, 2)."""
    distance = place.abs().amax(dim=1)
    return _actions(seen, -place, distance < START_NEAR, distance < DECLARE_NEAR)


def _actions(seen: FaceFeatures, way: torch.Tensor, low: torch.Tensor, declare: torch.Tensor) -> torch.Tensor:
    """Actions (n, 4) along the surface by a way (n, 2): in the tissue if `low` (n,), else above it."""
    sideways = (way / SLOW).clamp(-1.0, 1.0)
    wanted = torch.where(low, DEPTH, -GAP)
    rise = torch.maximum((seen.depth - wanted) / DEPTH_SLOW, FORCE_GAIN * (seen.force - FORCE_MOST)).clamp(-1.0, 1.0)
    # A slope that would need more than full speed slows the tip down.
    slope = -(seen.normal[:, :2] * sideways).sum(dim=1) / seen.normal[:, 2].clamp(min=UPRIGHT)
    along = torch.cat([sideways, slope[:, None]], dim=1) / slope.abs().clamp(min=1.0)[:, None]
    velocity = (along + rise[:, None] * seen.normal).clamp(-1.0, 1.0)
    return torch.cat([velocity, declare[:, None].to(velocity.dtype)], dim=1)


class OrganExpert:
    """Actions (n, 4) for observations (n, n_observation) of any organ."""

    def __init__(self, *, blind: bool = False) -> None:
        """Search, or with `blind` declare in the middle of the face."""
        self.blind = blind

    def act(self, observations: NDArray, begins: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
        """The next actions; `begins` is not used."""
        with torch.no_grad():
            read = torch.as_tensor(observations)
            seen = face_features(read)
            actions = blind_actions(seen, read[:, FACE["tip_place"]][:, :2]) if self.blind else expert_actions(seen)
            return actions.numpy().astype(np.float32)
