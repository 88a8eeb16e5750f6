"""Recordings as CSV files: one row a haptic step, readable by `surgsim_env.haptics.trajectory`."""

import csv
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgsim_env.live.exchange_records import RECORDING_MOST, recording_type

_AXES = "xyz"


def columns(arm_count: int) -> list[str]:
    """Names of a file's columns: time [s]; of each arm hand [m], buttons, tip [m] and the tissue's force [N]."""
    names = ["time"]
    for arm in range(arm_count):
        mark = "" if arm == 0 else f"_{arm + 1}"
        names += [f"{axis}{mark}" for axis in _AXES] + [f"buttons{mark}"]
        names += [f"{what}{axis}{mark}" for what in ("tip_", "force_") for axis in _AXES]
    return names


def write_recording(steps: NDArray[Any], folder: Path) -> str:
    """Write recorded steps to the next free recording-NUMBER.csv of a folder; returns a sentence on what came of it."""
    if not len(steps):
        return "nothing was recorded"
    arm_count = steps["hand"].shape[1]
    parts = [steps["time"][:, None]]
    for arm in range(arm_count):
        parts += [steps["hand"][:, arm], steps["buttons"][:, arm, None], steps["tip"][:, arm], steps["force"][:, arm]]
    table = np.concatenate(parts, axis=1)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path = _free(folder)
        unfinished = path.with_suffix(".part")
        with unfinished.open("w", newline="", encoding="utf-8") as file:
            file.write(",".join(columns(arm_count)) + "\n")
            np.savetxt(file, table, fmt="%.9g", delimiter=",")
        os.replace(unfinished, path)
    except OSError as error:
        return f"the recording was not written: {error}"
    return f"{len(steps)} steps written to {path.name}"


def read_recording(path: Path, arm_count: int) -> NDArray[Any]:
    """The steps of a file that `write_recording` wrote, or of a trajectory with columns time, x, y, z.

    Raises:
        ValueError: names the file, the row and what is wrong with it.
        OSError: a file that cannot be read.
    """
    wanted = ["time", *(f"{axis}{'' if arm == 0 else f'_{arm + 1}'}" for arm in range(arm_count) for axis in _AXES)]
    marks = ["" if arm == 0 else f"_{arm + 1}" for arm in range(arm_count)]
    rows: list[list[float]] = []
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        reader = csv.DictReader(file)
        missing = [name for name in wanted if name not in (reader.fieldnames or [])]
        if missing:
            raise ValueError(f"{path.name} has no column {missing[0]!r}; a recording has {', '.join(wanted)}")
        for number, row in enumerate(reader, start=2):
            try:
                pressed = [int(float(row.get(f"buttons{mark}") or 0)) for mark in marks]
                rows.append([*(float(row[name]) for name in wanted), *pressed])
            except (TypeError, ValueError, OverflowError):
                raise ValueError(f"{path.name}, line {number}: not a number in each of {', '.join(wanted)}") from None
            if len(rows) > RECORDING_MOST:
                raise ValueError(f"{path.name} has more than {RECORDING_MOST} rows: cut it")
    table = np.array(rows).reshape(-1, len(wanted) + arm_count)
    steps = np.zeros(len(table), dtype=recording_type(arm_count))
    # A step in which a hand said nothing is nan, nan, nan; its time is always a number.
    if not len(table) or not np.isfinite(table[:, 0]).all() or np.isinf(table).any():
        raise ValueError(f"{path.name} has no rows, or a time or a place that is not finite")
    steps["time"], steps["hand"] = table[:, 0], table[:, 1 : len(wanted)].reshape(-1, arm_count, 3)
    steps["buttons"] = table[:, len(wanted) :]
    return steps


def _free(folder: Path) -> Path:
    number = 1
    while (path := folder / f"recording-{number}.csv").exists():
        number += 1
    return path
