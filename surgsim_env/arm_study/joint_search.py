"""Inverse kinematics of many targets at once: damped least squares within joint limits, as arrays.

The same aims as `instruments.arm.inverse_kinematics`, weighted instead of ranked, so that each target is one small
linear system: with W = diag of the weights and e the residual, each step solves

    (J^T W J + (k |e|^2 + least) I) dq = J^T W e        (Levenberg-Marquardt; damping after Sugihara 2011)

in joints scaled by their speed limits. A joint that would pass a limit is held there and the others are solved
again. The last steps drop the direction, so that the position is exact to rounding wherever it can be reached.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.arm_study.kinematics import BatchKinematics, Chain, cross, dot

ITERATIONS, POLISHING = 48, 8
# One radian of direction weighs as much as this distance [m].
DIRECTION_WEIGHT = 0.03
DAMPING_SHARE, DAMPING_LEAST = 0.3, 1e-13
# Largest step of the joints [s] at their speed limits.
STRIDE = 0.2
# Residuals at which a search ends: [m], [rad].
PLACE_MET, ANGLE_MET = 1e-8, 1e-4


@dataclass(frozen=True)
class Found:
    """Results of the searches.

    Fields:
        joints: [rad or m]                                              (n, n_joint)
        position_error: of the tip [m]                                  (n,)
        trocar_error: of the shaft's axis [m]                           (n,)
    """

    joints: FloatArray
    position_error: FloatArray
    trocar_error: FloatArray


@dataclass(frozen=True)
class Wanted:
    """Targets: position [m] (n, 3) and direction (n, 3) or None of the tip; whether limits and trocar are respected."""

    position: FloatArray
    direction: FloatArray | None = None
    limits: bool = True
    trocar: bool = True

    def only(self, rows: NDArray, *, direction: bool = True) -> "Wanted":
        """Some of the targets, with or without their directions."""
        kept = self.direction[rows] if direction and self.direction is not None else None
        return Wanted(self.position[rows], kept, self.limits, self.trocar)


def search_joints(kinematics: BatchKinematics, wanted: Wanted, start: FloatArray) -> Found:
    """Joint values that bring the tip as near to the targets as possible, from starts (n, n_joint) [rad or m]."""
    joints = np.clip(start, kinematics.lower, kinematics.upper) if wanted.limits else start.copy()
    if wanted.direction is not None:
        _iterate(kinematics, wanted, joints, ITERATIONS)
        _iterate(kinematics, wanted.only(np.arange(len(joints)), direction=False), joints, POLISHING)
    else:
        _iterate(kinematics, wanted, joints, ITERATIONS)
    chain = kinematics.at(joints, shapes=False)
    return Found(joints, np.linalg.norm(wanted.position - chain.tip, axis=1), kinematics.trocar_error(chain))


def _iterate(kinematics: BatchKinematics, wanted: Wanted, joints: FloatArray, count: int) -> None:
    """Iterate in place on the joint values (n, n_joint) whose targets are not met yet."""
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
    """Residuals (n, m), their Jacobian (n, m, n_joint), and which targets are met (n,)."""
    chain = kinematics.at(joints, shapes=False)
    linear, angular = kinematics.tip_jacobian(chain)
    errors, jacobians = [wanted.position - chain.tip], [linear]
    met = np.linalg.norm(errors[0], axis=1) < PLACE_MET
    if wanted.trocar and not kinematics.arm.remote_centre_fixed:
        errors.append(kinematics.trocar - chain.near)
        jacobians.append(_across(kinematics.shaft_jacobian(chain), chain.along))
        met &= np.linalg.norm(errors[-1], axis=1) < PLACE_MET
    if wanted.direction is not None:
        turn = turns_between(chain.direction, wanted.direction)
        errors.append(DIRECTION_WEIGHT * turn)
        jacobians.append(DIRECTION_WEIGHT * _across(angular, chain.direction))
        met &= np.linalg.norm(turn, axis=1) < ANGLE_MET
    return np.concatenate(errors, axis=1), np.concatenate(jacobians, axis=1), met


def _across(jacobian: FloatArray, axis: FloatArray) -> FloatArray:
    """The part of (n, 3, n_joint) across unit vectors (n, 3)."""
    return jacobian - axis[:, :, None] * np.einsum("ni,nij->nj", axis, jacobian)[:, None]


def _bounded_step(
    jacobian: FloatArray, error: FloatArray, lower: FloatArray, upper: FloatArray, scale: FloatArray
) -> FloatArray:
    """Damped least-squares steps (n, n_joint) within bounds; joints that would pass one are held there."""
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
    """Smallest rotation vectors [rad] that take unit vectors to others, (n, 3)."""
    axis = cross(now, wanted)
    sine, cosine = np.linalg.norm(axis, axis=1), dot(now, wanted)
    return axis * (np.arctan2(sine, cosine) / np.maximum(sine, 1e-12))[:, None]


def tip_angle(chain: Chain, directions: FloatArray) -> FloatArray:
    """Angle between where the tips point and directions (n, 3) [rad], (n,)."""
    return np.arctan2(np.linalg.norm(cross(chain.direction, directions), axis=1), dot(chain.direction, directions))
