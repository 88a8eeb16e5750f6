"""Whether an organ has room for hidden lesions of given ranges, from one sample of its palpable face."""

import math
from dataclasses import dataclass

import numpy as np

from msdm_core.arithmetic import norm
from msdm_core.mesh import FloatArray
from surgsim_env.scene import LESION_GAP, LEVELS, REFERENCE_TIP, Anatomy, LesionDraw

# Points of the face that are tried.
POINTS = 200
# Least share of them below which the largest lesion fits: all 200 draws of a lesion then fail once in 3500 times.
SHARE_LEAST = 0.04
# Orders in which lesions are placed beside each other, and the least share of them in which all find a place: a level
# draws all lesions up to 200 times, which then fails once in 10^9 times, and once in 3000 at a share of 0.04.
ORDERS, ORDERS_LEAST = 40, 0.1


@dataclass(frozen=True, eq=False)
class FaceSample:
    """Random points of a palpable face.

    Fields:
        anatomy: whose face it is
        points, normals: on the face [m], and unit outward normals      (n, 3)
        thick: whether the organ is thick enough below to be pressed     (n,)
        rim: distance from the face's border [m]                         (n,)
    """

    anatomy: Anatomy
    points: FloatArray
    normals: FloatArray
    thick: np.ndarray
    rim: FloatArray


def sample_face(anatomy: Anatomy) -> FaceSample:
    """POINTS points of the palpable face of an anatomy, the same each time."""
    face = anatomy.face
    points, normals, thickness = face.random_points(np.random.default_rng(0), POINTS)
    rim = np.array([face.rim_distance(point) for point in points])
    return FaceSample(anatomy, points, normals, thickness >= face.thickness_smallest, rim)


def lack_of_room(sample: FaceSample, draw: LesionDraw) -> str:
    """Why lesions of these ranges do not fit at every level; empty if they do.

    At each level the largest lesion under the thickest cover must fit below SHARE_LEAST of the points, and in
    ORDERS_LEAST of some random orders as many lesions of the middle size as the level hides must fit beside each other.
    """
    scene, order = sample.anatomy.scene, np.random.default_rng(0)
    gap = LESION_GAP * scene.instrument.tip_radius / REFERENCE_TIP
    # A draw without a level has the scene's own ranges; levels may exceed them.
    levels = [(len(one.lesion_count_weights) - 1, one.ranges(draw)) for one in LEVELS.values()]
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
    """Centres of balls under some tissue [m] below the allowed points where they fit (n, 3)."""
    centres = sample.anatomy.centres_below(sample.points[allowed], sample.normals[allowed], radius + cover)
    return centres[np.isfinite(centres).all(axis=1)]


def _placed(centres: FloatArray, count: int, apart: float) -> int:
    """How many of `count` balls are placed if each takes the first centre (n, 3) that is far enough from the rest."""
    free, placed = centres, 0
    while len(free) and placed < count:
        placed += 1
        free = free[norm(free - free[0], axis=1) >= apart]
    return placed
