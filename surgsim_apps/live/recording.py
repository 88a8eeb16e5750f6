"""Recordings as CSV files, readable by `surgsim_env.scripting.motion_file`: one row for each haptic step."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgsim_apps.reports.output_folder import output_folder
from surgsim_env.scripting import TIP_PREFIX, motion_columns


def columns(arm_count: int) -> list[str]:
    """Names of a file's columns: time [s]; of each arm hand [m], buttons, tip [m] and the tissue's force [N]."""
    names = ["time"]
    for mark in ("", "_2")[:arm_count]:
        names += motion_columns(mark)
        names += [f"{what}{axis}{mark}" for what in (TIP_PREFIX, "force_") for axis in "xyz"]
    return names


def write_recording(steps: NDArray[Any], folder: Path) -> str:
    """Write steps to the next free recording-NUMBER.csv of a folder; returns the result in a sentence.

    The position of a hand is nan in steps without its place.
    """
    if not np.isfinite(steps["hand"]).any():
        return "nothing was recorded: no hand moved an instrument"
    arm_count = steps["hand"].shape[1]
    parts = [steps["time"][:, None]]
    for arm in range(arm_count):
        parts += [steps["hand"][:, arm], steps["buttons"][:, arm, None], steps["tip"][:, arm], steps["force"][:, arm]]
    table = np.concatenate(parts, axis=1)
    try:
        with output_folder(folder) as files:
            header = ",".join(columns(arm_count))
            np.savetxt(files / "recording.csv", table, fmt="%.9g", delimiter=",", header=header, comments="")
            name = files.number("recording.csv")
    except OSError as error:
        return f"the recording was not written: {error}"
    return f"{len(steps)} steps written to {name}"
