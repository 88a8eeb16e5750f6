"""The course of an organ's motions in an episode: drawn cycles, or none."""

from collections.abc import Sequence

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.motion_kernels import MotionDrive, signal_at
from surgsim_env.scene.model import CyclicMotion

# Cycles that are drawn; after the last one the first follows: 4 minutes of breaths, 50 s of heartbeats.
CYCLE_COUNT = 64
# Drawn sizes and durations stay within this share of their mean.
VARIATION_MOST = 0.5


def draw_drive(motions: Sequence[CyclicMotion], haptic_step: float, rng: np.random.Generator) -> MotionDrive:
    """Draw the cycles of an episode: size and period of each motion, their variation, and when the first cycle begins.

    Args:
        motions: of the scene.
        haptic_step: [s].
        rng: of the episode.
    """
    count = len(motions)
    start, size = np.zeros((count, CYCLE_COUNT + 1)), np.zeros((count, CYCLE_COUNT))
    delay = np.zeros(count)
    for number, motion in enumerate(motions):
        period, mean = rng.uniform(*motion.period), rng.uniform(*motion.size)
        spread = np.clip(motion.variation * rng.standard_normal((2, CYCLE_COUNT)), -VARIATION_MOST, VARIATION_MOST)
        start[number, 1:] = np.cumsum(period * (1.0 + spread[0]))
        size[number] = mean * (1.0 + spread[1])
        delay[number] = rng.uniform(0.0, period)
    rise, fall = (np.array([getattr(motion, share) for motion in motions]) for share in ("rise", "fall"))
    return MotionDrive(start, size, rise, fall, delay, haptic_step, np.zeros(1, dtype=np.int64))


def signals(drive: MotionDrive, time: float) -> FloatArray:
    """Signal of each motion at a time since they were drawn [s], shape (n_motion,)."""
    return np.array([signal_at(drive, number, time) for number in range(len(drive.delay))])


def hold(drive: MotionDrive, stopping: Sequence[int], time: float) -> MotionDrive:
    """The drive whose motions `stopping` end the cycle of a time [s] as it began and then rest.

    The ground never jumps: a breath that has begun ends.
    """
    size = drive.cycle_size.copy()
    for number in stopping:
        start = drive.cycle_start[number]
        within = (time - drive.delay[number]) % start[-1]
        present = int(np.searchsorted(start, within, side="right")) - 1
        later = np.arange(size.shape[1]) != present
        # Before the first cycle, and in the rest of a cycle, nothing has begun.
        size[number, later | (signal_at(drive, number, time) == 0.0)] = 0.0
    return drive._replace(cycle_size=size)


def go_on(drive: MotionDrive, drawn_size: FloatArray, stopping: Sequence[int], time: float) -> MotionDrive:
    """The drive of `hold` from a time [s] on, again with the drawn sizes (n_motion, n_cycle)."""
    delay = drive.delay.copy()
    for number in stopping:
        if signal_at(drive, number, time) == 0.0:
            delay[number] = time
    return drive._replace(cycle_size=drawn_size.copy(), delay=delay)


def still(haptic_step: float) -> MotionDrive:
    """The drive of an organ without motions."""
    return draw_drive((), haptic_step, np.random.default_rng(0))
