"""Inverse kinematics of an arm for many points: damped least squares within joint limits, as arrays.

The aims of `instruments.arm.inverse_kinematics`, weighted instead of ranked, so that each target is one small linear
system: with W = diag of the weights and e the residual, each step solves

    (J^T W J + (k |e|^2 + least) I) dq = J^T W e        (Levenberg-Marquardt; damping after Sugihara 2011)

in joints scaled by their speed limits. A joint that would pass a limit is held there and the others are solved
again. The last steps drop the direction, so that the position is exact to rounding wherever it can be reached.
A point is searched from several starts and neighbours, and along 32 directions over the half space about its normal.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from msdm_core.mesh import FloatArray
from surgsim_apps.arms.kinematics import BatchKinematics, cross, dot

ITERATIONS, POLISHING = 48, 8
# One radian of direction weighs as much as this distance [m].
DIRECTION_WEIGHT = 0.03
DAMPING_SHARE, DAMPING_LEAST = 0.3, 1e-13
# Largest step of the joints [s] at their speed limits.
STRIDE = 0.2
# Residuals for the end of a search: [m], [rad].
PLACE_MET, ANGLE_MET = 1e-8, 1e-4
# Largest distance of a reached point from the tip, and of the trocar from the shaft [m].
REACHED = 1e-3
NEIGHBOURS = 3
# Directions of each ring; every direction covers the same share of the half space.
RINGS = (1, 6, 11, 14)
DIRECTION_COUNT = sum(RINGS)
# A direction counts as reached within this [rad].
APPROACH_ANGLE = math.radians(10.0)


@dataclass
class Candidates:
    """Sets of joint values from searches; n of them, or k for each of n points.

    Fields:
        joints: [rad or m]                                          (n, k, n_joint)
        position_error: of the tip [m]                              (n, k)
        trocar_error: of the shaft's axis beyond the arm's play [m] (n, k)
        pointing: unit vector out of the tip                        (n, k, 3)
    """

    joints: FloatArray
    position_error: FloatArray
    trocar_error: FloatArray
    pointing: FloatArray

    @property
    def met(self) -> NDArray[np.bool_]:
        """Mask of candidates with the tip at its point and the shaft in its trocar, (n, k)."""
        return (self.position_error <= REACHED) & (self.trocar_error <= REACHED)

    def only(self, rows: NDArray) -> "Candidates":
        """Those of some of the points."""
        return Candidates(*(values[rows] for values in vars(self).values()))

    def add(self, other: "Candidates") -> "Candidates":
        """Both, side by side."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Candidates(*(np.concatenate(pair, axis=1) for pair in pairs))


@dataclass(frozen=True)
class Wanted:
    """Targets: position [m] (n, 3) and direction (n, 3) or None of the tip, with or without limits and trocar."""

    position: FloatArray
    direction: FloatArray | None = None
    limits: bool = True
    trocar: bool = True

    def only(self, rows: NDArray, *, direction: bool = True) -> "Wanted":
        """Some of the targets, with or without their directions."""
        kept = self.direction[rows] if direction and self.direction is not None else None
        return Wanted(self.position[rows], kept, self.limits, self.trocar)


def search_joints(kinematics: BatchKinematics, wanted: Wanted, start: FloatArray) -> Candidates:
    """Joint values for the tip's nearest approach to the targets, from starts (n, n_joint) [rad or m]."""
    joints = np.clip(start, kinematics.lower, kinematics.upper) if wanted.limits else start.copy()
    _iterate(kinematics, wanted, joints, ITERATIONS)
    if wanted.direction is not None:
        _iterate(kinematics, wanted.only(np.arange(len(joints)), direction=False), joints, POLISHING)
    chain = kinematics.at(joints, shapes=False)
    missed = np.linalg.norm(wanted.position - chain.tip, axis=1)
    beside = np.maximum(kinematics.trocar_error(chain) - kinematics.arm.trocar_play, 0.0)
    return Candidates(joints, missed, beside, chain.direction)


def _iterate(kinematics: BatchKinematics, wanted: Wanted, joints: FloatArray, count: int) -> None:
    """Iterate in place on joint values (n, n_joint) of targets not met yet."""
    rows = np.arange(len(joints))
    for _ in range(count):
        error, jacobian, met = _residual(kinematics, wanted.only(rows), joints[rows])
        rows, error, jacobian = rows[~met], error[~met], jacobian[~met]
        if rows.size == 0:
            return
        now, stride = joints[rows], STRIDE * kinematics.arm.speed_limit
        lower, upper = np.broadcast_to(-stride, now.shape), np.broadcast_to(stride, now.shape)
        if wanted.limits:
            lower, upper = np.maximum(lower, kinematics.lower - now), np.minimum(upper, kinematics.upper - now)
        joints[rows] = now + _bounded_step(jacobian, error, lower, upper, kinematics.arm.speed_limit)


def _residual(
    kinematics: BatchKinematics, wanted: Wanted, joints: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Residuals (n, m), their Jacobian (n, m, n_joint), and a mask of met targets (n,)."""
    chain = kinematics.at(joints, shapes=False)
    linear, angular = kinematics.tip_jacobian(chain)
    errors, jacobians = [wanted.position - chain.tip], [linear]
    met = np.linalg.norm(errors[0], axis=1) < PLACE_MET
    if wanted.trocar and not kinematics.arm.remote_centre_fixed:
        errors.append(kinematics.trocar - chain.near)
        jacobians.append(across(kinematics.shaft_jacobian(chain), chain.along))
        met &= np.linalg.norm(errors[-1], axis=1) < PLACE_MET
    if wanted.direction is not None:
        turn = turns_between(chain.direction, wanted.direction)
        errors.append(DIRECTION_WEIGHT * turn)
        jacobians.append(DIRECTION_WEIGHT * across(angular, chain.direction))
        met &= np.linalg.norm(turn, axis=1) < ANGLE_MET
    return np.concatenate(errors, axis=1), np.concatenate(jacobians, axis=1), met


def across(jacobian: FloatArray, axis: FloatArray) -> FloatArray:
    """The part of (n, 3, n_joint) across unit vectors (n, 3)."""
    return jacobian - axis[:, :, None] * np.einsum("ni,nij->nj", axis, jacobian)[:, None]


def _bounded_step(
    jacobian: FloatArray, error: FloatArray, lower: FloatArray, upper: FloatArray, scale: FloatArray
) -> FloatArray:
    """Damped least-squares steps (n, n_joint); joints are held at their bounds."""
    scaled = jacobian * scale
    damping = DAMPING_SHARE * dot(error, error) + DAMPING_LEAST
    free = np.ones(lower.shape, dtype=bool)
    step = np.zeros(lower.shape)
    for _ in range(3):
        held = np.where(free, 0.0, step)
        missing = error - np.einsum("nij,nj->ni", jacobian, held)
        open_columns = scaled * free[:, None]
        normal = np.swapaxes(open_columns, 1, 2) @ open_columns
        normal[:, np.arange(len(scale)), np.arange(len(scale))] += damping[:, None]
        right = np.einsum("nij,ni->nj", open_columns, missing)
        step = np.where(free, np.linalg.solve(normal, right[..., None])[..., 0] * scale, held)
        beyond = free & ((step < lower) | (step > upper))
        step = np.clip(step, lower, upper)
        if not beyond.any():
            break
        free &= ~beyond
    return step


def turns_between(now: FloatArray, wanted: FloatArray) -> FloatArray:
    """Smallest rotation vectors [rad] between unit vectors, (n, 3)."""
    axis = cross(now, wanted)
    sine, cosine = np.linalg.norm(axis, axis=1), dot(now, wanted)
    return axis * (np.arctan2(sine, cosine) / np.maximum(sine, 1e-12))[:, None]


def spread_starts(kinematics: BatchKinematics) -> FloatArray:
    """Home, the middle of all limits, and each joint alone half way from there to either limit, (k, n_joint).

    No random numbers: the starts of a mirrored arm are the mirrored starts.
    """
    middle = 0.5 * (kinematics.lower + kinematics.upper)
    aside = np.diag(0.25 * (kinematics.upper - kinematics.lower))
    return np.concatenate([kinematics.arm.home[None], middle[None], middle + aside, middle - aside])


def from_starts(
    kinematics: BatchKinematics, tips: FloatArray, starts: FloatArray, *, limits: bool = True, trocar: bool = True
) -> Candidates:
    """Candidates for positions of the tip (n, 3) [m] from starts (k, n_joint), or of each (n, k, n_joint)."""
    count, each = len(tips), starts.shape[-2]
    begin = np.broadcast_to(starts, (count, each, kinematics.arm.joint_count)).reshape(-1, kinematics.arm.joint_count)
    wanted = Wanted(np.repeat(tips, each, axis=0), limits=limits, trocar=trocar)
    return _search(kinematics, wanted, begin, (count, each))


def from_neighbours(kinematics: BatchKinematics, tips: FloatArray, candidates: Candidates) -> Candidates:
    """Candidates for points without one, started from those of the nearest points with one."""
    met = candidates.met
    has = met.any(axis=1)
    need = np.flatnonzero(~has)
    if need.size == 0 or not has.any():
        return candidates
    first = np.where(has, met.argmax(axis=1), 0)
    tree, owners = KDTree(tips[has]), np.flatnonzero(has)
    near = owners[tree.query(tips[need], k=min(NEIGHBOURS, len(owners)))[1].reshape(len(need), -1)]
    added = from_starts(kinematics, tips[need], candidates.joints[near, first[near]])
    rows = np.arange(near.shape[1])
    for index, point in enumerate(need):
        for name in vars(candidates):
            getattr(candidates, name)[point, rows] = getattr(added, name)[index]
    return candidates


def from_directions(
    kinematics: BatchKinematics,
    tips: FloatArray,
    directions: FloatArray,
    candidates: Candidates,
    usable: NDArray[np.bool_],
) -> Candidates:
    """A candidate for each approach direction (n, 32, 3), begun at the usable one of the smallest angle to it."""
    cosine = -np.einsum("nki,ndi->ndk", candidates.pointing, directions)
    cosine = np.where(usable[:, None], cosine, -np.inf)
    best = cosine.argmax(axis=2)
    rows = np.arange(len(tips))[:, None]
    begin = candidates.joints[rows, best].reshape(-1, kinematics.arm.joint_count)
    wanted = Wanted(np.repeat(tips, DIRECTION_COUNT, axis=0), -directions.reshape(-1, 3))
    return _search(kinematics, wanted, begin, (len(tips), DIRECTION_COUNT))


def _search(kinematics: BatchKinematics, wanted: Wanted, begin: FloatArray, shape: tuple[int, int]) -> Candidates:
    fields = vars(search_joints(kinematics, wanted, begin)).values()
    return Candidates(*(values.reshape(*shape, *values.shape[1:]) for values in fields))


def approach_directions(normals: FloatArray, towards: FloatArray, line: FloatArray) -> FloatArray:
    """Approach directions of a tip, unit vectors out of the tissue about outward normals (n, 3), shape (n, 32, 3).

    Rings of 1, 6, 11 and 14 directions lie in the middles of bands of equal area: after k of 32 directions a band of m
    has cos(theta) = 1 - (k + m/2) / 32 (the first is the normal itself). Azimuths are evenly spaced. The first is that
    of `towards` (n, 3), from the surface to the endoscope, so that a mirrored scene has mirrored directions; where the
    normal is parallel to it, that of `line` (3,).
    """
    first = _tangential(towards, normals)
    short = np.linalg.norm(first, axis=1) < 1e-6 * np.linalg.norm(towards, axis=1)
    first[short] = _tangential(np.broadcast_to(line, first.shape), normals)[short]
    first /= np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(normals, first)
    directions = [normals]
    before = 1
    for count in RINGS[1:]:
        cosine = 1.0 - (before + 0.5 * count) / DIRECTION_COUNT
        sine = math.sqrt(1.0 - cosine**2)
        for index in range(count):
            azimuth = 2.0 * math.pi * index / count
            directions.append(cosine * normals + sine * (math.cos(azimuth) * first + math.sin(azimuth) * second))
        before += count
    return np.stack(directions, axis=1)


def _tangential(vectors: FloatArray, normals: FloatArray) -> FloatArray:
    return vectors - (vectors * normals).sum(axis=1)[:, None] * normals


def directions_met(pointing: FloatArray, usable: NDArray[np.bool_], directions: FloatArray) -> NDArray[np.bool_]:
    """Mask of directions (n, 32, 3) within 10 degrees of usable tips (n, k) that point along (n, k, 3), (n, 32)."""
    cosine = -np.einsum("nki,ndi->nkd", pointing, directions)
    return np.any((cosine >= math.cos(APPROACH_ANGLE)) & usable[:, :, None], axis=1)
