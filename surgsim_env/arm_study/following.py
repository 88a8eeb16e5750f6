"""The joint speeds of an arm that follows a point of an organ that moves.

A point X of an organ that goes with its ground is at X + sum_m s_m(t) d_m(X) (`msdm_core.organ.motion`). The tip
follows it, the direction in which it points is free. Of all joint speeds that do so, and keep the shaft in a trocar
that control keeps, those are taken whose shares q'_j / q'_j,max of their limits have the least sum of squares,

    q' = S (J S)^+ sum_m s'_m d_m,    S = diag(q'_max)       (weighted pseudoinverse: Whitney 1969)
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.arm_study.joint_search import across
from surgsim_env.arm_study.kinematics import BatchKinematics
from surgsim_env.coupling.motion_kernels import smooth_rise
from surgsim_env.scene.model import CyclicMotion

# Evenly spaced positions between rest and top of the motion that moves the organ most.
STEPS = 5
# Instants of the cycle at which speeds are computed.
INSTANTS = 121
# Largest rate of p(x) = x^3 (10 - 15 x + 6 x^2), at x = 1/2.
RATE_MOST = 15.0 / 8.0
# Smaller singular values than this share of the largest count as 0: one of the three rows of a trocar always does.
RANK_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Course:
    """Signal of a motion in its largest and quickest cycle at some instants.

    Fields:
        time: since the cycle began [s]                                  (n_instant,)
        level: the signal as a share of its top                          (n_instant,)
        rate: of the signal [1/s]                                        (n_instant,)
    """

    time: FloatArray
    level: FloatArray
    rate: FloatArray


def course(motion: CyclicMotion, count: int = INSTANTS) -> Course:
    """A whole cycle of the largest size and the shortest period; the variation between cycles is left out."""
    size, period = motion.size[1], motion.period[0]
    share = np.linspace(0.0, 1.0, count)
    rises, ends = share < motion.rise, motion.rise + motion.fall
    x = np.where(rises, share / motion.rise, np.clip(1.0 - (share - motion.rise) / motion.fall, 0.0, 1.0))
    slope = np.where(rises, 1.0 / motion.rise, np.where(share < ends, -1.0 / motion.fall, 0.0)) / period
    return Course(
        period * share,
        np.asarray(smooth_rise.py_func(x)),
        size * 30.0 * (x * (1.0 - x)) ** 2 * slope,
    )


@dataclass(frozen=True)
class Cycle:
    """Positions of an organ that are evaluated: each motion in its largest cycle.

    From rest to the top of the motion that moves the organ most in even steps, the others at rest; then, if there are
    others, rest and top again with all others at their tops.

    Fields:
        motions: of the scene
        main: index of the motion that moves the organ most
        level: share of each motion's top at each position                   (n_position, n_motion)
        before: the position from which an arm comes to each; the first has none
    """

    motions: tuple[CyclicMotion, ...]
    main: int
    level: FloatArray
    before: tuple[int, ...]

    @property
    def signals(self) -> FloatArray:
        """Signals of the motions at each position, (n_position, n_motion)."""
        return self.level * np.array([one.size[1] for one in self.motions])

    @property
    def others(self) -> tuple[int, ...]:
        """Indices of the other motions."""
        return tuple(number for number in range(len(self.motions)) if number != self.main)


def make_cycle(motions: Sequence[CyclicMotion]) -> Cycle:
    """The positions of an organ with at least one motion."""
    main = int(np.argmax([math.hypot(*one.displacement) * one.size[1] for one in motions]))
    alone = np.arange(len(motions)) == main
    level = np.linspace(0.0, 1.0, STEPS + 1)[:, None] * alone
    before = [max(number - 1, 0) for number in range(STEPS + 1)]
    if len(motions) > 1:
        level = np.concatenate([level, [~alone, np.ones(len(motions))]])
        before += [0, STEPS]
    return Cycle(tuple(motions), main, level, tuple(before))


def joints_per_signal(kinematics: BatchKinematics, joints: FloatArray, shifts: FloatArray) -> FloatArray:
    """Joint values per unit of each signal, a_m [rad or m], at joint values (n, n_joint); (n, n_motion, n_joint).

    Args:
        kinematics: of the arm.
        joints: [rad or m].
        shifts: d_m at the points [m], shape (n_motion, n, 3).
    """
    chain = kinematics.at(joints, shapes=False)
    jacobian, moved = kinematics.tip_jacobian(chain)[0], np.moveaxis(shifts, 0, 2)
    if not kinematics.arm.remote_centre_fixed:
        held = across(kinematics.shaft_jacobian(chain), chain.along)
        jacobian = np.concatenate([jacobian, held], axis=1)
        moved = np.concatenate([moved, np.zeros_like(moved)], axis=1)
    scale = kinematics.arm.speed_limit
    found = np.linalg.pinv(jacobian * scale, rcond=RANK_TOLERANCE) @ moved
    return np.swapaxes(found, 1, 2) * scale


def speeds_through_cycle(
    kinematics: BatchKinematics, cycle: Cycle, joints: FloatArray, shifts: FloatArray
) -> FloatArray:
    """Largest speed of each joint [rad/s or m/s], (n_instant, n, n_joint).

    The instants are those of `course` of the main motion. The other motions have other periods: each is added with its
    largest rate, so that the results are bounds.

    Args:
        kinematics: of the arm.
        cycle: of the organ.
        joints: with the main motion at each of its STEPS + 1 positions [rad or m], shape (STEPS + 1, n, n_joint).
        shifts: d_m at the points [m], shape (n_motion, n, 3).
    """
    one = course(cycle.motions[cycle.main])
    per_signal = np.stack([joints_per_signal(kinematics, now, shifts) for now in joints])
    position = one.level * STEPS
    low = np.minimum(position.astype(np.int64), STEPS - 1)
    share = position - low
    rate = np.zeros((len(one.time), len(cycle.motions)))
    for number, motion in enumerate(cycle.motions):
        rate[:, number] = motion.size[1] * RATE_MOST / (min(motion.rise, motion.fall) * motion.period[0])
    rate[:, cycle.main] = one.rate
    speeds = []
    for instant, (first, part) in enumerate(zip(low, share, strict=True)):
        moving = (1.0 - part) * per_signal[first] + part * per_signal[first + 1]
        speeds.append(np.abs(moving * rate[instant][:, None]).sum(axis=1))
    return np.stack(speeds)
