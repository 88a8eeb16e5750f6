"""CSV files of hand motions: a header, then a row of numbers for each time."""

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray, IntArray
from msdm_core.mesh_files.mesh_file import checked_content

# Largest button mask: 31 bits fit any integer type.
BUTTONS_LARGEST = 2**31 - 1
# Prefix of the columns of the tip's position [m] in recordings of `surgsim view`.
TIP_PREFIX = "tip_"


class Motion(NamedTuple):
    """Motion of a hand.

    Fields:
        time: of each row, increasing [s]                                          (n,)
        position: [m]; NaN in rows without a pose                                  (n, 3)
        buttons: one bit each; 0 without a column                                  (n,)
    """

    time: FloatArray
    position: FloatArray
    buttons: IntArray


def motion_columns(mark: str = "") -> list[str]:
    """Names of one hand's columns: x, y, z [m] and the buttons, each with the hand's suffix."""
    return [f"{name}{mark}" for name in ("x", "y", "z", "buttons")]


def read_motion(path: Path, mark: str = "", *, of_tip: bool = False) -> Motion:
    """Read a file with a header: time [s], x, y, z [m] and optionally buttons; other columns are ignored.

    Args:
        path: of the file.
        mark: suffix of the hand's column names.
        of_tip: read the recorded tip in place of the hand.

    Raises:
        ValueError: a missing column, a row that is not numeric or not finite, times that do not increase, invalid
            buttons, or no rows; names the file and the line or row.
        OSError: the file cannot be read.
    """
    with checked_content(path).open(newline="", encoding="utf-8", errors="replace") as file:
        reader = csv.DictReader(file)
        try:
            names = reader.fieldnames or []
            *places, pressed = motion_columns(mark)
            columns = ["time", *(f"{TIP_PREFIX if of_tip else ''}{name}" for name in places)]
            missing = [name for name in columns if name not in names]
            if missing:
                raise ValueError(
                    f"{path.name}: column {missing[0]!r} is missing; it must have {', '.join(columns)}, and may have "
                    f"{pressed}"
                )
            has_buttons = pressed in names
            rows = list(_rows(reader, [*columns, pressed] if has_buttons else columns, path.name))
        except csv.Error as error:
            raise ValueError(f"{path.name}, line {reader.line_num + 1}: {error}; it is not a CSV file") from None
    if not rows:
        raise ValueError(f"{path.name}: no rows below the header")
    table = np.array(rows)
    buttons = table[:, 4] if has_buttons else np.zeros(len(table))
    motion = Motion(table[:, 0], table[:, 1:4], buttons.astype(np.int32))
    _check(motion, path.name)
    return motion


def _check(motion: Motion, file_name: str) -> None:
    has_place = ~np.isnan(motion.position).all(axis=1)
    finite = np.isfinite(motion.time) & (np.isfinite(motion.position).all(axis=1) | ~has_place)
    if not finite.all():
        raise ValueError(f"{file_name}: row {np.flatnonzero(~finite)[0]} has a number that is not finite")
    backward = np.flatnonzero(np.diff(motion.time) <= 0.0)
    if len(backward):
        row = int(backward[0]) + 1
        raise ValueError(f"{file_name}: time of row {row}, {motion.time[row]:g} s, is not after the row before")
    if not has_place.any():
        raise ValueError(f"{file_name}: no row has a place")


def _rows(reader: csv.DictReader, columns: Sequence[str], file_name: str) -> Iterator[list[float]]:
    """Numbers of each row."""
    for row in reader:
        line = reader.line_num
        try:
            numbers = [float(row[name]) for name in columns]
        except (TypeError, ValueError):
            raise ValueError(f"{file_name}, line {line}: not a number in each of {', '.join(columns)}") from None
        for name, value in zip(columns, numbers, strict=True):
            # Comparisons with NaN are False.
            if name.startswith("buttons") and not (0 <= value <= BUTTONS_LARGEST and value == int(value)):
                raise ValueError(
                    f"{file_name}, line {line}: {name} is {value:g}; it must be a whole number from 0 to "
                    f"{BUTTONS_LARGEST}"
                )
        yield numbers
