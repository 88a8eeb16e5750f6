"""Features of an observation of SurgSim/Palpate-v0 with memory=True and frame="face", the same for every organ."""

from dataclasses import dataclass

import torch
from torch import nn
from torch.nn.functional import max_pool2d

from surgsim_env.palpation import MAP_SIDE
from surgsim_env.tasks import PalpateTask, channel_slices

# Channels of the observation.
FACE = channel_slices(
    PalpateTask, contrast=MAP_SIDE**2, visited=MAP_SIDE**2, face=MAP_SIDE**2, stiffest=3, tip_place=3, tip_depth=1,
    surface_normal=3, face_force=3, map_cell=1, chart_share=2,
)  # fmt: skip
OBSERVATION_SIZE = max(part.stop for part in FACE.values())
# Largest distance between the rows of a search, and of the outermost ones from the border of the face [tip radii].
ROW_SPACING, BORDER = 2.4, 0.8
# Reach of the second search, across the rows, around the stiffest place [tip radii].
ACROSS_REACH = 2.0
# Distances of felt sites to both sides of a passed peak, along its row [tip radii].
PASSED = (0.8, 2.4)
# Longer displacements are shortened to this, in the same direction [tip radii].
WAY_MOST = 3.0
FAR = 1e6
# Least height of a normal for slopes.
UPRIGHT = 0.3
# Excess of a possible lesion, and the magnified range around it.
EXCESS_MIDDLE, EXCESS_NEAR = 0.3, 0.1
# Share of the time left below which it is an input.
LATE = 0.2
# Entries of `face_summary`, the distance near a way's end, and the depth in the middle of its range [tip radii].
SUMMARY_SIZE, WAY_NEAR, DEPTH_MIDDLE = 28, 0.4, 0.4


@dataclass(frozen=True, eq=False)
class FaceFeatures:
    """Features of n observations; lengths in tip radii, forces over the soft limit, on the axes of the face.

    Fields:
        depth: of the ball below the surface at rest                                                        (n,)
        force: along the normal there                                                                       (n,)
        normal: of the surface                                                                              (n, 3)
        begun: 1 after the first touch, else 0                                                              (n,)
        row_way, rows_left: to the next site of the rows; share of their remaining sites          (n, 2), (n,)
        across_way, across_left: to the next site across them, through the stiffest; 1 if there is one     (n, 2), (n,)
        stiffest_way: to the stiffest place                                                                 (n, 2)
        excess: contrast of the stiffest place over the median of felt sites, less 1                        (n,)
        passed: 1 after touches on both sides of the stiffest place along its row, else 0                   (n,)
        time_left: share                                                                                    (n,)
    """

    depth: torch.Tensor
    force: torch.Tensor
    normal: torch.Tensor
    begun: torch.Tensor
    row_way: torch.Tensor
    rows_left: torch.Tensor
    across_way: torch.Tensor
    across_left: torch.Tensor
    stiffest_way: torch.Tensor
    excess: torch.Tensor
    passed: torch.Tensor
    time_left: torch.Tensor


def face_features(observations: torch.Tensor) -> FaceFeatures:
    """Features of observations (n, n_observation).

    The rows lie along the first axis of the face, equally far apart, at most ROW_SPACING. The next site is the nearest
    remaining one of the first unfinished row, or the nearer end of a fresh row; rows follow each other from the first
    or the last one, the nearer to the tip at the begin.
    """
    part = {name: observations[:, place] for name, place in FACE.items()}
    count, place = len(observations), part["tip_place"]
    cell = part["map_cell"]
    steps = torch.arange(MAP_SIDE, dtype=observations.dtype) - MAP_SIDE // 2
    visited = part["visited"].reshape(-1, MAP_SIDE, MAP_SIDE) > 0.5
    face = part["face"].reshape(-1, MAP_SIDE, MAP_SIDE) > 0.5
    # A site with a visited neighbour counts as felt.
    felt = max_pool2d(visited.to(observations.dtype)[:, None], 3, 1, 1)[:, 0] > 0.5
    gap_u = steps * cell - place[:, :1]
    gap_v = steps * cell - place[:, 1:2]
    distance = torch.maximum(gap_u[:, None, :].abs(), gap_v[:, :, None].abs())

    # ---- the rows ----
    is_row = _rows(face, cell)
    row_sites = face & is_row[:, :, None]
    open_sites = row_sites & ~felt
    row_open, row_felt = open_sites.any(dim=2), (row_sites & felt).any(dim=2)
    numbers = torch.arange(MAP_SIDE).expand(count, -1)
    first = torch.where(is_row, numbers, MAP_SIDE).amin(dim=1)
    last = torch.where(is_row, numbers, -1).amax(dim=1)
    first_felt, last_felt = (row_felt.gather(1, outer[:, None])[:, 0] for outer in (first, last.clamp(min=0)))
    upward = gap_v.gather(1, first[:, None].clamp(max=MAP_SIDE - 1)).abs() <= gap_v.gather(1, last[:, None]).abs()
    upward = first_felt | (~last_felt & upward[:, 0])
    order = torch.where(upward[:, None], numbers, MAP_SIDE - numbers)
    row = torch.where(row_open, order, 2 * MAP_SIDE).argmin(dim=1)
    here = open_sites[torch.arange(count), row]
    fresh = ~row_felt.gather(1, row[:, None])[:, 0]
    # Ends of a fresh row.
    low = torch.where(here, numbers, MAP_SIDE).amin(dim=1).clamp(max=MAP_SIDE - 1)
    high = torch.where(here, numbers, -1).amax(dim=1).clamp(min=0)
    nearer_low = gap_u.gather(1, low[:, None]).abs() <= gap_u.gather(1, high[:, None]).abs()
    end = torch.where(nearer_low[:, 0], low, high)
    nearest = torch.where(here, gap_u.abs(), FAR).argmin(dim=1)
    column = torch.where(fresh, end, nearest)
    any_open = row_open.any(dim=1)
    row_way = torch.cat([gap_u.gather(1, column[:, None]), gap_v.gather(1, row[:, None])], dim=1)
    rows_left = open_sites.sum(dim=(1, 2)) / row_sites.sum(dim=(1, 2)).clamp(min=1)

    # ---- the stiffest place ----
    begun = visited.any(dim=2).any(dim=1)
    half = part["chart_share"] * (MAP_SIDE // 2) * cell
    stiffest = part["stiffest"][:, :2] * half
    top_u, top_v = ((steps * cell) - stiffest[:, axis : axis + 1] for axis in (0, 1))
    in_column = (top_u.abs() <= 0.5 * cell + 1e-6)[:, None, :] & (top_v.abs() <= ACROSS_REACH)[:, :, None]
    across = face & in_column & ~felt & begun[:, None, None]
    across_distance = torch.where(across, distance, FAR).flatten(1)
    across_site = across_distance.argmin(dim=1)
    across_left = across.flatten(1).any(dim=1)
    across_way = torch.stack(
        [
            gap_u.gather(1, (across_site % MAP_SIDE)[:, None])[:, 0],
            gap_v.gather(1, (across_site // MAP_SIDE)[:, None])[:, 0],
        ],
        dim=1,
    )
    contrast = torch.where(part["visited"] > 0.5, part["contrast"], torch.nan)
    typical = contrast.nanmedian(dim=1).values.nan_to_num(1.0)
    excess = (part["stiffest"][:, 2] / typical.clamp(min=0.1) - 1.0).clamp(-1.0, 3.0) * begun
    near_row = (top_v.abs() <= 0.5 * ROW_SPACING)[:, :, None]
    sides = []
    for side in (-1.0, 1.0):
        reach = (side * top_u >= PASSED[0]) & (side * top_u <= PASSED[1])
        area = near_row & reach[:, None, :]
        # At the border of the face there is nothing to feel on one side.
        sides.append((area & visited).flatten(1).any(dim=1) | ~(area & face).flatten(1).any(dim=1))
    passed = sides[0] & sides[1] & begun

    real = observations.dtype
    normal = part["surface_normal"]
    return FaceFeatures(
        depth=part["tip_depth"][:, 0],
        force=(part["face_force"] * normal).sum(dim=1),
        normal=normal,
        begun=begun.to(real),
        row_way=_way(row_way) * any_open[:, None],
        rows_left=rows_left.to(real),
        across_way=_way(across_way) * across_left[:, None],
        across_left=across_left.to(real),
        stiffest_way=_way(stiffest - place[:, :2]) * begun[:, None],
        excess=excess,
        passed=passed.to(real),
        time_left=part["time_left"][:, 0],
    )


class FaceSummary(nn.Module):
    """`face_features` as SUMMARY_SIZE numbers of order 1 (`face_summary`)."""

    features_dim = SUMMARY_SIZE

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """The features (n, SUMMARY_SIZE) of observations (n, n_observation)."""
        return face_summary(face_features(observations))


def face_summary(seen: FaceFeatures) -> torch.Tensor:
    """Features as the entries of a network's input, shape (n, SUMMARY_SIZE).

    Ways and the excess are given twice, as they are and magnified: ways near their ends, for a tip that slows down, and
    with their climbs along the surface. Depth and force are centred at those of a sliding tip.
    """
    ways = torch.stack([seen.row_way, seen.across_way, seen.stiffest_way], dim=1)
    near = (ways / WAY_NEAR).clamp(-1.0, 1.0)
    normal = seen.normal
    climbs = -(near * normal[:, None, :2]).sum(dim=2) / normal[:, 2:].clamp(min=UPRIGHT)
    late = (LATE - seen.time_left).clamp(min=0.0) / LATE
    parts = [
        *((seen.depth - DEPTH_MIDDLE) * 4.0, seen.force * 2.0, seen.begun, seen.rows_left, seen.across_left),
        *((seen.rows_left == 0.0).to(ways.dtype), seen.excess * 2.0, seen.passed, late),
        ((seen.excess - EXCESS_MIDDLE) / EXCESS_NEAR).clamp(-1.0, 1.0),
    ]
    others = torch.stack(parts, dim=1).clamp(-3.0, 3.0)
    return torch.cat([ways.flatten(1) / WAY_MOST, near.flatten(1), climbs, others, normal], dim=1)


def _rows(face: torch.Tensor, cell: torch.Tensor) -> torch.Tensor:
    """Mask of the search's rows of the map (n, MAP_SIDE), for faces (n, MAP_SIDE, MAP_SIDE) and cells (n, 1)."""
    numbers = torch.arange(MAP_SIDE)
    there = face.any(dim=2)
    low = torch.where(there, numbers, MAP_SIDE).amin(dim=1, keepdim=True).to(cell.dtype)
    high = torch.where(there, numbers, -1).amax(dim=1, keepdim=True).to(cell.dtype)
    edge = torch.minimum((BORDER / cell).round(), torch.div(high - low, 2, rounding_mode="floor"))
    low, high = low + edge, high - edge
    count = torch.ceil((high - low) * cell / ROW_SPACING - 1e-4).clamp(min=1.0)
    # Row k of count + 1 lies at low + k (high - low) / count, rounded.
    k = torch.round((numbers - low) * count / (high - low).clamp(min=1.0)).clamp(min=0.0)
    k = torch.minimum(k, count)
    return (torch.round(low + k * (high - low) / count) == numbers) & (numbers >= low) & (numbers <= high)


def _way(gap: torch.Tensor) -> torch.Tensor:
    """Ways (n, 2) shortened to WAY_MOST in their larger part."""
    size = gap.abs().amax(dim=1, keepdim=True).clamp(min=1e-6)
    return gap * torch.clamp(WAY_MOST / size, max=1.0)
