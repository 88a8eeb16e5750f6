"""How an arm follows a point of an organ that moves: its joints through the cycle, their speeds and accelerations.

A point X of an organ that goes with its ground is at X + sum_m s_m(t) d_m(X) (`msdm_core.organ.motion`). The tip
follows it, the direction in which it points is free. Of all joint speeds that do so, and keep the shaft in a trocar
that control keeps, those are taken whose shares q'_j / q'_j,max of their limits have the least sum of squares,

    q' = S (J S)^+ sum_m s'_m d_m,    S = diag(q'_max)       (weighted pseudoinverse: Whitney 1969)

With a_m(q) = S (J S)^+ d_m and D its derivative along joint values, the accelerations are

    q'' = sum_m a_m s''_m + sum_mn (D a_m)[a_n] s'_m s'_n
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
# Instants of the cycle at which speeds and accelerations are computed.
INSTANTS = 121
# Largest rate and acceleration of p(x) = x^3 (10 - 15 x + 6 x^2), at x = 1/2 and x = 1/2 - sqrt(3)/6.
RATE_MOST, ACCELERATION_MOST = 15.0 / 8.0, 10.0 / math.sqrt(3.0)
# Joint values are moved by this share of their speeds in a second to differentiate a_m.
DIFFERENCE = 1e-5
# Smaller singular values than this share of the largest count as 0: one of the three rows of a trocar always does.
RANK_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Course:
    """Signal of a motion in its largest and quickest cycle at some instants.

    Fields:
        time: since the cycle began [s]                                  (n_instant,)
        level: the signal as a share of its top                          (n_instant,)
        rate, acceleration: of the signal [1/s], [1/s^2]                 (n_instant,)
    """

    time: FloatArray
    level: FloatArray
    rate: FloatArray
    acceleration: FloatArray


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
        size * 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) * slope**2,
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


def change_of_joints_per_signal(
    kinematics: BatchKinematics, joints: FloatArray, shifts: FloatArray, per_signal: FloatArray
) -> FloatArray:
    """(D a_m)[a_n] [rad or m] by central differences, (n, n_motion n, n_motion m, n_joint); arguments as above."""
    changes = []
    for along in np.moveaxis(per_signal, 1, 0):
        most = np.abs(along / kinematics.arm.speed_limit).max(axis=1)
        step = (DIFFERENCE / np.where(most > 0.0, most, 1.0))[:, None]
        ahead, behind = (joints_per_signal(kinematics, joints + sign * step * along, shifts) for sign in (1.0, -1.0))
        changes.append((ahead - behind) / (2.0 * step[:, None]))
    return np.stack(changes, axis=1)


def speeds_through_cycle(
    kinematics: BatchKinematics, cycle: Cycle, joints: FloatArray, shifts: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Largest speed [rad/s or m/s] and acceleration [rad/s^2 or m/s^2] of each joint, (n_instant, n, n_joint) each.

    The instants are those of `course` of the main motion. The other motions have other periods: each is added with its
    largest rate and acceleration, so that the results are bounds.

    Args:
        kinematics: of the arm.
        cycle: of the organ.
        joints: with the main motion at each of its STEPS + 1 positions [rad or m], shape (STEPS + 1, n, n_joint).
        shifts: d_m at the points [m], shape (n_motion, n, 3).
    """
    one = course(cycle.motions[cycle.main])
    per_signal = np.stack([joints_per_signal(kinematics, now, shifts) for now in joints])
    change = np.stack(
        [change_of_joints_per_signal(kinematics, now, shifts, a) for now, a in zip(joints, per_signal, strict=True)]
    )
    position = one.level * STEPS
    low = np.minimum(position.astype(np.int64), STEPS - 1)
    share = position - low
    rate, rush = np.zeros((2, len(one.time), len(cycle.motions)))
    for number, motion in enumerate(cycle.motions):
        quickest = 1.0 / (min(motion.rise, motion.fall) * motion.period[0])
        rate[:, number] = motion.size[1] * RATE_MOST * quickest
        rush[:, number] = motion.size[1] * ACCELERATION_MOST * quickest**2
    rate[:, cycle.main], rush[:, cycle.main] = one.rate, one.acceleration
    others = list(cycle.others)
    speeds, accelerations = [], []
    for instant, (first, part) in enumerate(zip(low, share, strict=True)):
        a = (1.0 - part) * per_signal[first] + part * per_signal[first + 1]
        b = (1.0 - part) * change[first] + part * change[first + 1]
        moving = a * rate[instant][:, None]
        speeds.append(np.abs(moving[:, cycle.main]) + np.abs(moving[:, others]).sum(axis=1))
        bent = b * np.multiply.outer(rate[instant], rate[instant])[..., None]
        rushing = a * rush[instant][:, None]
        alone = rushing[:, cycle.main] + bent[:, cycle.main, cycle.main]
        mixed = np.abs(bent).sum(axis=(1, 2)) - np.abs(bent[:, cycle.main, cycle.main])
        accelerations.append(np.abs(alone) + np.abs(rushing[:, others]).sum(axis=1) + mixed)
    return np.stack(speeds), np.stack(accelerations)
