"""Clearance of an arm from organ and body wall, and of two arms from each other, at given joint values."""

from dataclasses import dataclass

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.arm_study.clearance import ClusteredSurface, outside_ball, segment_distance
from surgsim_env.arm_study.kinematics import BatchKinematics, Chain, dot
from surgsim_env.arm_study.ports import Ports

# Parts of an arm this near to the tip (and its ball) may touch the organ [m].
TIP_ZONE = 0.005
# Parts of two arms this near to a common point are left out of their distance [m]: the tips meet there.
MEETING_ZONE = 0.020


@dataclass(frozen=True)
class Surroundings:
    """Obstacles of an arm: organ at rest and body wall; `ball` is the radius of its tip [m], which may touch."""

    organ: ClusteredSurface
    ports: Ports
    ball: float

    def organ_clearance(self, kinematics: BatchKinematics, chain: Chain, *, exact: bool) -> FloatArray:
        """Distance of all shapes outside the tip's zone from the organ [m], (n,).

        Not exact: 0 or more means clear, less means touching.
        """
        radius = kinematics.arm.shape_radius
        parts, left = outside_ball(chain.shape_ends, chain.tip[:, None], self.ball + TIP_ZONE)
        row, shape, part = np.nonzero(left)
        cap = np.inf if exact else float(radius.max())
        gaps = self.organ.distance(parts[row, shape, part], cap) - radius[shape]
        result = np.full(len(chain.tip), np.inf)
        np.minimum.at(result, row, gaps)
        return result

    def wall_clearance(self, kinematics: BatchKinematics, chain: Chain) -> FloatArray:
        """Distance of all shapes outside the port's hole from the body wall [m], (n,)."""
        gaps = self.ports.wall_clearance(chain.shape_ends, kinematics.trocar) - kinematics.arm.shape_radius
        return gaps.min(axis=1)


def split_at_trocar(kinematics: BatchKinematics, chain: Chain) -> tuple[FloatArray, FloatArray]:
    """Shapes inside and outside the body, each (n, n_shape, 2, 3) [m]; NaN where a shape has no part there.

    The shaft and the bodies beyond it are cut by the plane through the trocar across the shaft; all others are outside.
    """
    ends = chain.shape_ends
    height = dot(ends - chain.near[:, None, None], chain.along[:, None, None])
    span = height[..., 1] - height[..., 0]
    share = np.clip(-height[..., 0] / np.where(span == 0.0, 1.0, span), 0.0, 1.0)
    cut = ends[..., 0, :] + share[..., None] * (ends[..., 1, :] - ends[..., 0, :])
    inside, outside = ends.copy(), ends.copy()
    for end in (0, 1):
        beyond = height[..., end] > 0.0
        inside[..., end, :] = np.where(beyond[..., None], ends[..., end, :], cut)
        outside[..., end, :] = np.where(beyond[..., None], cut, ends[..., end, :])
    within, without = (height > 0.0).any(axis=-1), (height <= 0.0).any(axis=-1)
    inside[~(within & kinematics.distal)] = np.nan
    outside[:, ~kinematics.distal] = ends[:, ~kinematics.distal]
    outside[~without & kinematics.distal] = np.nan
    return inside, outside


def arm_distances(
    first: tuple[BatchKinematics, Chain], second: tuple[BatchKinematics, Chain], points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Smallest distances of two arms inside and outside the body [m], each (n,), their tips at the same points (n, 3).

    Each arm's own trocar divides its shapes into inside and outside; parts within MEETING_ZONE of the
    point are left out.
    """
    pieces = [split_at_trocar(*one) for one in (first, second)]
    radii = [one[0].arm.shape_radius for one in (first, second)]
    return (
        _least([_without_zone(piece[0], points) for piece in pieces], [np.repeat(radius, 2) for radius in radii]),
        _least([piece[1] for piece in pieces], radii),
    )


def _without_zone(segments: FloatArray, points: FloatArray) -> FloatArray:
    """Both parts of segments (n, k, 2, 3) outside the zone about points (n, 3), NaN where none is left."""
    parts, left = outside_ball(segments, points[:, None], MEETING_ZONE)
    parts[~left] = np.nan
    return parts.reshape(len(segments), -1, 2, 3)


def _least(segments: list[FloatArray], radii: list[FloatArray]) -> FloatArray:
    """Smallest clearance of two sets of capsules (n, k, 2, 3), (n, l, 2, 3) [m], (n,); inf where one set is empty."""
    with np.errstate(invalid="ignore"):
        gaps = segment_distance(segments[0][:, :, None], segments[1][:, None]) - radii[0][:, None] - radii[1]
    return np.where(np.isnan(gaps), np.inf, gaps).min(axis=(1, 2))
