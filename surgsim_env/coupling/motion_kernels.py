"""Signals of an organ's motions over time, cycle by cycle: breaths and heartbeats."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from msdm_core.kernels.option_kernels import INLINED_KERNEL, KERNEL

FloatArray = NDArray[np.float64]


class MotionDrive(NamedTuple):
    """The signals of an organ's motions (`msdm_core.organ.motion`) in an episode.

    A cycle rises from 0 to its size, falls to 0 and rests until the next one: with the share u of its duration that has
    passed, s = A p(u / u_r) up to u_r, A p(1 - (u - u_r) / u_f) up to u_r + u_f, and 0 from there on, where
    p(x) = x^3 (10 - 15 x + 6 x^2). Signal, rate and acceleration are continuous. After the last cycle
    comes the first.

    Fields:
        cycle_start: of each cycle, and the end of the last one [s]              (n_motion, n_cycle + 1)
        cycle_size: A of each cycle                                              (n_motion, n_cycle)
        rise, fall: u_r and u_f                                                  (n_motion,)
        delay: time before the first cycle [s]                                   (n_motion,)
        haptic_step: [s]                                                         scalar
        step_count: haptic steps since the reset                                 (1,)
    """

    cycle_start: FloatArray
    cycle_size: FloatArray
    rise: FloatArray
    fall: FloatArray
    delay: FloatArray
    haptic_step: float
    step_count: NDArray[np.int64]


@njit(**INLINED_KERNEL)
def smooth_rise(x):
    """From 0 at 0 to 1 at 1, rate and acceleration 0 at both."""
    return x * x * x * (10.0 + x * (6.0 * x - 15.0))


@njit(**KERNEL)
def signal_at(drive, number, time):
    """Signal of one motion at a time since the reset [s]."""
    start = drive.cycle_start[number]
    last = start.shape[0] - 1
    time -= drive.delay[number]
    if time <= 0.0:
        return 0.0
    time = start[0] + time % (start[last] - start[0])
    cycle = 0
    while cycle + 1 < last and time >= start[cycle + 1]:
        cycle += 1
    share = (time - start[cycle]) / (start[cycle + 1] - start[cycle])
    size, rise, fall = drive.cycle_size[number, cycle], drive.rise[number], drive.fall[number]
    if share < rise:
        return size * smooth_rise(share / rise)
    if share < rise + fall:
        return size * smooth_rise(1.0 - (share - rise) / fall)
    return 0.0


@njit(**KERNEL)
def steer_motion(drive, motion):
    """Let the signals of an organ change evenly over the next haptic step to their values at its end.

    Model: drive
    Out:   drive.step_count, motion: rates [1/s] (n_motion, 4)
    """
    drive.step_count[0] += 1
    for number in range(motion.shape[0]):
        signal = signal_at(drive, number, drive.step_count[0] * drive.haptic_step)
        motion[number, 1] = (signal - motion[number, 0]) / drive.haptic_step
