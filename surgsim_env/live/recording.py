"""Recordings as CSV files, readable by `surgsim_env.haptics.trajectory`: one row for each haptic step with a hand."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgsim_env.haptics.trajectory import TIP, Motion, motion_columns, read_motion
from surgsim_env.live.exchange_records import RECORDING_MOST, recording_type
from surgsim_env.reports.output_folder import output_folder

# Tolerance on the spacing of rows, as a share of the haptic step.
STEP_TOLERANCE = 0.01


def columns(arm_count: int) -> list[str]:
    """Names of a file's columns: time [s]; of each arm hand [m], buttons, tip [m] and the tissue's force [N]."""
    names = ["time"]
    for arm in range(arm_count):
        names += motion_columns(_mark(arm))
        names += [f"{what}{axis}{_mark(arm)}" for what in (TIP, "force_") for axis in "xyz"]
    return names


def write_recording(steps: NDArray[Any], folder: Path) -> str:
    """Write steps to the next free recording-NUMBER.csv of a folder; returns a sentence that states the result.

    Steps in which no hand gave a place are left out: a pause is a gap in time.
    """
    has_place = np.isfinite(steps["hand"]).all(axis=2)
    steps = steps[np.any(has_place, axis=1)]
    if not len(steps):
        return "nothing was recorded: no hand moved an instrument"
    arm_count = steps["hand"].shape[1]
    parts = [steps["time"][:, None]]
    for arm in range(arm_count):
        parts += [steps["hand"][:, arm], steps["buttons"][:, arm, None], steps["tip"][:, arm], steps["force"][:, arm]]
    table = np.concatenate(parts, axis=1)
    try:
        with output_folder(folder) as files:
            with (files / "recording.csv").open("w", newline="", encoding="utf-8") as file:
                file.write(",".join(columns(arm_count)) + "\n")
                np.savetxt(file, table, fmt="%.9g", delimiter=",")
            name = files.number("recording.csv")
    except OSError as error:
        return f"the recording was not written: {error}"
    return f"{len(steps)} steps written to {name}"


def read_recording(path: Path, arm_count: int, haptic_step: float) -> NDArray[Any]:
    """The steps of a file that `write_recording` wrote, or of a trajectory with columns time, x, y, z.

    Rows one haptic step [s] apart are used unchanged. Otherwise the rows are interpolated linearly in time, with the
    buttons of the earlier row; next to a row without a position (nan) and in pauses there is none.

    Raises:
        ValueError: names the file, the line and what is wrong with it: no number, not finite, times that do not
            increase, more steps than RECORDING_MOST.
        OSError: the file cannot be read.
    """
    motion = read_motion(path, [_mark(arm) for arm in range(arm_count)], rows_largest=RECORDING_MOST)
    time = motion.time
    # A step without a pose is nan, nan, nan; its time is always a number.
    if not np.isfinite(time).all() or np.isinf(motion.position).any():
        raise ValueError(f"{path.name} has a time or a place that is not finite")
    backward = np.flatnonzero(np.diff(time) <= 0.0)
    if len(backward):
        row = int(backward[0]) + 1
        raise ValueError(f"{path.name}, row {row}: time {time[row]:g} s is not after that of the row before")
    # Written times are rounded.
    if (np.abs(np.diff(time) - haptic_step) > STEP_TOLERANCE * haptic_step).any():
        motion = _resampled(path, motion, haptic_step)
    steps = np.zeros(len(motion.time), dtype=recording_type(arm_count))
    steps["time"], steps["hand"], steps["buttons"] = motion.time, motion.position, motion.buttons
    return steps


def _resampled(path: Path, motion: Motion, haptic_step: float) -> Motion:
    """A motion's rows a haptic step apart, from its first time to its last."""
    time, places = motion.time, motion.position.reshape(len(motion.time), -1)
    span = float(time[-1] - time[0])
    if not span / haptic_step < RECORDING_MOST:
        raise ValueError(
            f"{path.name} lasts {span:g} s; a recording holds {RECORDING_MOST} steps of {haptic_step:g} s: cut it"
        )
    count = int(span / haptic_step + STEP_TOLERANCE) + 1
    now = np.minimum(time[0] + haptic_step * np.arange(count), time[-1])
    row = np.searchsorted(time, now + STEP_TOLERANCE * haptic_step, side="right") - 1
    hand = np.column_stack([np.interp(now, time, place) for place in places.T])
    return Motion(now, hand.reshape(count, -1, 3), motion.buttons[row])


def _mark(arm: int) -> str:
    """Suffix of the names of an arm's columns."""
    return "" if arm == 0 else f"_{arm + 1}"
