"""Exact distances of capsules, and clearance of arms from organ, body wall and each other, as arrays.

A capsule is a segment with a radius: its clearance from anything is the distance of the segment less the radii. Of
segments that meet, the distance is 0 and the clearance is minus the radii: the depth of an overlap is not computed.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.mesh import FloatArray, IntArray
from surgsim_apps.arms.kinematics import BatchKinematics, Chain, cross, dot
from surgsim_apps.arms.ports import Ports
from surgsim_env.scene import Anatomy

# Triangles of one cluster; pairs of segment and triangle in one batch.
CLUSTER_SIZE = 24
PAIRS_AT_ONCE = 400_000
# Parts of an arm this near to the tip (and its ball) may touch the organ [m].
TIP_ZONE = 0.005
# Parts this near to the tip work on the organ, or on the other arm's tip: their contact is no lack of clearance [m].
WORKING_ZONE = 0.020


def segment_distance(first: ArrayLike, second: ArrayLike) -> FloatArray:
    """Distances between segments (..., 2, 3) and segments (..., 2, 3), broadcast [m]; points are segments too.

    Least |p0 + s u - q0 - t v| for 0 <= s, t <= 1: the pair of lines where both feet lie inside, else an end against
    the other segment (C. Ericson, Real-Time Collision Detection, 5.1.9).
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    u, v, w = a[..., 1, :] - a[..., 0, :], b[..., 1, :] - b[..., 0, :], a[..., 0, :] - b[..., 0, :]
    uu, uv, vv, uw, vw = dot(u, u), dot(u, v), dot(v, v), dot(u, w), dot(v, w)
    determinant = uu * vv - uv * uv
    with np.errstate(divide="ignore", invalid="ignore"):
        s, t = (uv * vw - vv * uw) / determinant, (uu * vw - uv * uw) / determinant
        inside = (determinant > 1e-14 * uu * vv) & (s > 0.0) & (s < 1.0) & (t > 0.0) & (t < 1.0)
    ends = np.minimum(
        np.minimum(point_segment_distance(a[..., 0, :], b), point_segment_distance(a[..., 1, :], b)),
        np.minimum(point_segment_distance(b[..., 0, :], a), point_segment_distance(b[..., 1, :], a)),
    )
    between = w + np.where(inside, s, 0.0)[..., None] * u - np.where(inside, t, 0.0)[..., None] * v
    return np.where(inside, np.minimum(np.sqrt(dot(between, between)), ends), ends)


def point_segment_distance(point: FloatArray, segment: FloatArray) -> FloatArray:
    """Distances of points (..., 3) from segments (..., 2, 3), broadcast [m]."""
    start, span = segment[..., 0, :], segment[..., 1, :] - segment[..., 0, :]
    length = dot(span, span)
    along = np.clip(dot(point - start, span) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
    gap = point - start - along[..., None] * span
    return np.sqrt(dot(gap, gap))


def segment_triangle_distance(segment: FloatArray, corners: FloatArray) -> FloatArray:
    """Distances of segments (n, 2, 3) from triangles (n, 3, 3) [m], (n,); 0 if they cross."""
    edges = corners[:, [[0, 1], [1, 2], [2, 0]]]
    least = segment_distance(segment[:, None], edges).min(axis=1)
    normal = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = normal / np.linalg.norm(normal, axis=1)[:, None]
    height = dot(segment - corners[:, :1], normal[:, None])
    for end in (0, 1):
        foot = segment[:, end] - height[:, end, None] * normal
        least = np.where(_within(foot, corners, normal), np.minimum(least, np.abs(height[:, end])), least)
    span = height[:, 0] - height[:, 1]
    share = height[:, 0] / np.where(span == 0.0, 1.0, span)
    crossing = segment[:, 0] + share[:, None] * (segment[:, 1] - segment[:, 0])
    crosses = (height[:, 0] * height[:, 1] <= 0.0) & (span != 0.0) & _within(crossing, corners, normal)
    return np.where(crosses, 0.0, least)


def _within(point: FloatArray, corners: FloatArray, normal: FloatArray) -> NDArray[np.bool_]:
    """Mask of points of the triangles' planes (n, 3) inside the triangles (n, 3, 3)."""
    inside = np.ones(len(point), dtype=bool)
    for start, end in ((0, 1), (1, 2), (2, 0)):
        inside &= dot(cross(corners[:, end] - corners[:, start], point - corners[:, start]), normal) >= 0.0
    return inside


class ClusteredSurface:
    """A triangle surface for distances, in clusters with bounding balls for early rejection."""

    def __init__(self, points: FloatArray, triangles: IntArray) -> None:
        """Take a surface's points (n, 3) [m] and triangles (m, 3)."""
        corners = points[triangles]
        order = _clustered(corners.mean(axis=1), np.arange(len(corners)))
        self._first = np.cumsum([0, *(len(cluster) for cluster in order)])
        self.corners = corners[np.concatenate(order)]
        self._centre, self._radius = _balls(self.corners[:, None])
        self._middle, self._extent = (part[0] for part in _balls(self.corners.reshape(1, 1, -1, 3)))
        parts = [self.corners[low:high].reshape(1, -1, 3) for low, high in zip(self._first[:-1], self._first[1:])]
        balls = [_balls(part[:, None]) for part in parts]
        self._cluster_centre = np.concatenate([centre for centre, _ in balls])
        self._cluster_radius = np.concatenate([radius for _, radius in balls])

    def distance(self, segments: FloatArray, cap: float = np.inf) -> FloatArray:
        """Distances of segments (n, 2, 3) from the surface [m], at most `cap`, (n,).

        A small cap is quick: triangles that are certainly further away are skipped.
        """
        result = np.full(len(segments), cap)
        near = np.flatnonzero(point_segment_distance(self._middle, segments) - self._extent < cap)
        chunk = max(1, PAIRS_AT_ONCE // len(self._cluster_radius))
        for low in range(0, len(near), chunk):
            rows = near[low : low + chunk]
            result[rows] = self._near(segments[rows], cap)
        return result

    def _near(self, segments: FloatArray, cap: float) -> FloatArray:
        to_centre = point_segment_distance(self._cluster_centre[None], segments[:, None])
        # Every ball contains points of the surface: the nearest is no further away than a ball's far side.
        most = np.minimum((to_centre + self._cluster_radius).min(axis=1), cap)
        row, cluster = np.nonzero(to_centre - self._cluster_radius < most[:, None])
        count = self._first[cluster + 1] - self._first[cluster]
        pair_row = np.repeat(row, count)
        offset = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        triangle = np.repeat(self._first[cluster], count) + offset
        result = np.full(len(segments), cap)
        to_ball = np.empty(len(pair_row))
        for low in range(0, len(pair_row), PAIRS_AT_ONCE):
            part = slice(low, low + PAIRS_AT_ONCE)
            to_ball[part] = point_segment_distance(self._centre[triangle[part]], segments[pair_row[part]])
        np.minimum.at(most, pair_row, to_ball + self._radius[triangle])
        kept = to_ball - self._radius[triangle] < most[pair_row]
        pair_row, triangle = pair_row[kept], triangle[kept]
        for low in range(0, len(pair_row), PAIRS_AT_ONCE):
            part = slice(low, low + PAIRS_AT_ONCE)
            distance = segment_triangle_distance(segments[pair_row[part]], self.corners[triangle[part]])
            np.minimum.at(result, pair_row[part], distance)
        return result


def _clustered(centres: FloatArray, members: NDArray) -> list[NDArray]:
    """Members split in halves along their longest side until few are left in each part."""
    if len(members) <= CLUSTER_SIZE:
        return [members]
    side = int(np.argmax(np.ptp(centres[members], axis=0)))
    order = members[np.argsort(centres[members, side], kind="stable")]
    half = len(order) // 2
    return [*_clustered(centres, order[:half]), *_clustered(centres, order[half:])]


def _balls(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Balls about points (n, 1, k, 3): middle of the box (n, 3) and distance of the furthest point (n,)."""
    flat = corners.reshape(len(corners), -1, 3)
    centre = 0.5 * (flat.min(axis=1) + flat.max(axis=1))
    # A little more than the furthest, so that rounding never rules out the nearest triangle.
    return centre, np.linalg.norm(flat - centre[:, None], axis=2).max(axis=1) * (1.0 + 1e-9) + 1e-12


def outside_ball(segments: FloatArray, centre: FloatArray, radius: float) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Parts of segments (..., 2, 3) outside balls about centres (..., 3) [m].

    Returns:
        parts (..., 2, 2, 3), before and after the ball, and a mask of the non-empty ones (..., 2).
    """
    start, span = segments[..., 0, :], segments[..., 1, :] - segments[..., 0, :]
    offset = start - centre
    a, b, c = dot(span, span), dot(span, offset), dot(offset, offset) - radius**2
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    safe = np.where(a > 0.0, a, 1.0)
    enter = np.where(a > 0.0, (-b - root) / safe, np.where(c < 0.0, -1.0, 2.0))
    leave = np.where(a > 0.0, (-b + root) / safe, 2.0)
    missed = (b * b - a * c <= 0.0) & (a > 0.0)
    before = np.where(missed, 1.0, np.clip(enter, 0.0, 1.0))
    after = np.where(missed, 1.0, np.clip(leave, 0.0, 1.0))
    low = np.stack([np.zeros_like(before), after], axis=-1)
    high = np.stack([before, np.ones_like(after)], axis=-1)
    parts = start[..., None, None, :] + np.stack([low, high], axis=-1)[..., None] * span[..., None, None, :]
    left = high > low
    left[..., 0] |= (a == 0.0) & (c >= 0.0)
    return parts, left


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Obstacles of an arm: organ, body wall and others; the tip may touch the organ.

    Fields:
        organ: its surface
        ports: with the wall
        ball: radius of the arm's tip [m]
        skin: surface of the wall; None for a dome or plate
        others: further surfaces
    """

    organ: ClusteredSurface
    ports: Ports
    ball: float = 0.0
    skin: ClusteredSurface | None = None
    others: tuple[ClusteredSurface, ...] = ()

    @classmethod
    def of(cls, anatomy: Anatomy, ports: Ports) -> "Obstacles":
        """Obstacles of a scene's organ at rest and of the surfaces of a ports file.

        Raises:
            MeshError: a surface that cannot be read.
        """
        mesh, skin = anatomy.mesh, ports.wall.skin
        return cls(
            ClusteredSurface(mesh.points, mesh.boundary_triangles),
            ports,
            skin=None if skin is None else ClusteredSurface(*skin.read()),
            others=tuple(ClusteredSurface(*source.read()) for source in ports.obstacles),
        )

    def clears_others(self, kinematics: BatchKinematics, shape_ends: FloatArray) -> NDArray[np.bool_]:
        """Mask of poses with shapes (n, n_shape, 2, 3) [m] clear of the further surfaces, (n,)."""
        clear = np.ones(len(shape_ends), dtype=bool)
        for surface in self.others:
            for shape, radius in enumerate(kinematics.arm.shape_radius):
                clear &= surface.distance(shape_ends[:, shape], radius) >= radius
        return clear

    def clears_organ(self, kinematics: BatchKinematics, chain: Chain) -> NDArray[np.bool_]:
        """Mask of poses that touch the organ with the tip's zone alone, (n,)."""
        cap = float(kinematics.arm.shape_radius.max())
        return self._organ_gap(kinematics, chain, TIP_ZONE, cap) >= 0.0

    def organ_clearance(self, kinematics: BatchKinematics, chain: Chain) -> FloatArray:
        """Distance of shaft and links, the tool's working zone left out, from the organ [m], (n,)."""
        return self._organ_gap(kinematics, chain, WORKING_ZONE)

    def _organ_gap(self, kinematics: BatchKinematics, chain: Chain, zone: float, cap: float = np.inf) -> FloatArray:
        radius = kinematics.arm.shape_radius
        parts, left = outside_ball(chain.shape_ends, chain.tip[:, None], self.ball + zone)
        row, shape, part = np.nonzero(left)
        gaps = self.organ.distance(parts[row, shape, part], cap) - radius[shape]
        result = np.full(chain.shape_ends.shape[:2], np.inf)
        np.minimum.at(result, (row, shape), gaps)
        return result.min(axis=1)

    def wall_clearance(self, kinematics: BatchKinematics, chain: Chain) -> FloatArray:
        """Distance of all shapes outside the port's hole from the body wall [m], (n,)."""
        return self.wall_gap(kinematics, chain.shape_ends, kinematics.trocar)

    def wall_gap(self, kinematics: BatchKinematics, shape_ends: FloatArray, trocar: FloatArray) -> FloatArray:
        """Distance of shapes (n, n_shape, 2, 3) from the wall [m], (n,), at a trocar (3,) or one a row (n, 1, 3)."""
        gaps = wall_clearance(self.ports, shape_ends, trocar, self.skin) - kinematics.arm.shape_radius
        return gaps.min(axis=1)


def wall_clearance(
    ports: Ports, segments: FloatArray, trocar: FloatArray, skin: ClusteredSurface | None = None
) -> FloatArray:
    """Distances of segments (..., 2, 3) from the wall [m]; negative within it, inf inside the hole.

    With heights from h0 to h1 above the wall's middle surface and a thickness t: max(h0 - t/2, -t/2 - h1), the gap, or
    minus the shortest move out of the wall. Of a skin: the distance from its surface less t/2.
    """
    wall, half = ports.wall, 0.5 * ports.wall.thickness
    parts, left = outside_ball(segments, trocar, wall.hole)
    if skin is not None:
        distance = np.full(left.shape, np.inf)
        distance[left] = skin.distance(parts[left])
        return distance.min(axis=-1) - half
    if wall.plate:
        middle = 0.5 * (np.array(ports.left.point) + np.array(ports.right.point))
        heights = (parts - middle) @ ports.wall_normal
        low, high = heights.min(axis=-1), heights.max(axis=-1)
    else:
        centre = ports.dome_centre
        low = point_segment_distance(centre, parts) - wall.radius
        high = np.sqrt(dot(parts - centre, parts - centre)).max(axis=-1) - wall.radius
    return np.where(left, np.maximum(low - half, -half - high), np.inf).min(axis=-1)


def split_at_trocar(kinematics: BatchKinematics, chain: Chain) -> tuple[FloatArray, FloatArray]:
    """Shapes inside and outside the body, each (n, n_shape, 2, 3) [m]; NaN for a shape without such a part.

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
    first: tuple[BatchKinematics, Chain],
    second: tuple[BatchKinematics, Chain],
    points: FloatArray,
    cap: float = np.inf,
) -> tuple[FloatArray, FloatArray]:
    """Smallest distances of two arms inside and outside the body, each (n,), their tips at the same points (n, 3) [m].

    At most `cap` [m]: a small one is quick.

    Each arm's own trocar divides its shapes into inside and outside; parts within WORKING_ZONE of the
    point are left out.
    """
    pieces = [split_at_trocar(*first), split_at_trocar(*second)]
    radii = [first[0].arm.shape_radius, second[0].arm.shape_radius]
    inside = []
    for segments, _ in pieces:
        parts, left = outside_ball(segments, points[:, None], WORKING_ZONE)
        parts[~left] = np.nan
        inside.append(parts.reshape(len(segments), -1, 2, 3))
    outside = [piece[1] for piece in pieces]
    return _least(inside, [np.repeat(radius, 2) for radius in radii], cap), _least(outside, radii, cap)


def _least(segments: list[FloatArray], radii: list[FloatArray], cap: float) -> FloatArray:
    """Smallest clearance of two sets of capsules (n, k, 2, 3), (n, l, 2, 3), at most `cap` [m], (n,); NaN are none."""
    middles = [ends.mean(axis=2) for ends in segments]
    # Half a capsule's length and its radius: no part is further from its middle.
    extents = [
        0.5 * np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2) + radius
        for ends, radius in zip(segments, radii, strict=True)
    ]
    between = np.linalg.norm(middles[0][:, :, None] - middles[1][:, None], axis=3)
    row, a, b = np.nonzero(between - extents[0][:, :, None] - extents[1][:, None] < cap)
    result = np.full(len(between), cap)
    np.minimum.at(result, row, segment_distance(segments[0][row, a], segments[1][row, b]) - radii[0][a] - radii[1][b])
    return result
