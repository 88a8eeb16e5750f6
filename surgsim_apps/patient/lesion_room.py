"""Room of an organ for hidden lesions of given ranges, by a sample of its palpable face."""

import math
from dataclasses import dataclass

import numpy as np

from msdm_core.arithmetic import norm
from msdm_core.mesh import FloatArray
from surgsim_env.scene import LESION_GAP, LEVELS, REFERENCE_TIP, Anatomy, LesionDraw

# Sampled points of the face.
POINTS = 200
# Least share of the points with room for the largest lesion: all 200 draws of a lesion then fail once in 3500 times.
SHARE_LEAST = 0.04
# Random orders of lesions placed beside each other, and least share of orders with a place for all: the up to 200 draws
# of a level then fail once in 10^9 times, and once in 3000 at a share of 0.04.
ORDERS, ORDERS_LEAST = 40, 0.1


@dataclass(frozen=True, eq=False)
class FaceSample:
    """Random points of a palpable face.

    Fields:
        anatomy: of the face
        points, normals: on the face [m], and unit outward normals      (n, 3)
        thick: true for a point with enough organ below to be pressed    (n,)
        rim: distance from the face's border [m]                         (n,)
    """

    anatomy: Anatomy
    points: FloatArray
    normals: FloatArray
    thick: np.ndarray
    rim: FloatArray


def sample_face(anatomy: Anatomy) -> FaceSample:
    """Sample of POINTS points of an anatomy's palpable face, the same each time."""
    face = anatomy.face
    points, normals, thickness = face.random_points(np.random.default_rng(0), POINTS)
    rim = np.array([face.rim_distance(point) for point in points])
    return FaceSample(anatomy, points, normals, thickness >= face.thickness_smallest, rim)


def lack_of_room(sample: FaceSample, draw: LesionDraw) -> str:
    """Reason for ranges of lesions that do not fit at every level; empty for a fit.

    At each level the largest lesion under the thickest cover must fit below SHARE_LEAST of the points, and all lesions
    of the level, of the middle size, must fit beside each other in ORDERS_LEAST of some random orders.
    """
    scene, order = sample.anatomy.scene, np.random.default_rng(0)
    gap = LESION_GAP * scene.instrument.tip_radius / REFERENCE_TIP
    # A draw without a level has the scene's own ranges; levels may exceed them.
    levels = [(len(level.lesion_count_weights) - 1, level.ranges(draw)) for level in LEVELS.values()]
    for count, ranges in [(1, draw), *levels]:
        allowed = sample.thick & (sample.rim >= ranges.rim_distance)
        fitting = _centres(sample, allowed, ranges.radius[1], ranges.cover[1])
        if len(fitting) < SHARE_LEAST * POINTS:
            return (
                f"a ball of {ranges.radius[1] * 1e3:.3g} mm radius under {ranges.cover[1] * 1e3:.3g} mm of tissue fits "
                f"below {len(fitting)} of {POINTS} points of the palpable face; "
                f"{math.ceil(SHARE_LEAST * POINTS)} are needed"
            )
        if count > 1:
            radius, cover = float(np.mean(ranges.radius)), float(np.mean(ranges.cover))
            centres = _centres(sample, allowed, radius, cover)
            fits = [_placed(order.permutation(centres), count, 2.0 * radius + gap) == count for _ in range(ORDERS)]
            if np.mean(fits) < ORDERS_LEAST:
                return (
                    f"{count} balls of {radius * 1e3:.3g} mm radius, {gap * 1e3:.2g} mm apart, fit beside each other "
                    f"in {sum(fits)} of {ORDERS} tries"
                )
    return ""


def _centres(sample: FaceSample, allowed: np.ndarray, radius: float, cover: float) -> FloatArray:
    """Centres of balls that fit under a cover [m] below the allowed points (n, 3)."""
    centres = sample.anatomy.centres_below(sample.points[allowed], sample.normals[allowed], radius + cover)
    return centres[np.isfinite(centres).all(axis=1)]


def _placed(centres: FloatArray, count: int, apart: float) -> int:
    """Number of up to `count` balls with a place, if each takes the first centre (n, 3) far enough from the others."""
    free, placed = centres, 0
    while len(free) and placed < count:
        placed += 1
        free = free[norm(free - free[0], axis=1) >= apart]
    return placed
