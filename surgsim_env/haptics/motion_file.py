"""CSV files of the motion of hands: a header, then one row of numbers per time."""

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray, IntArray

# Of a pose: 31 bits, so that they fit into any integer type.
BUTTONS_LARGEST = 2**31 - 1
BUTTONS_RULE = f"a whole number from 0 to {BUTTONS_LARGEST}"


class Motion(NamedTuple):
    """The motion of one or more hands; numbers may be nan or infinite, buttons may not.

    Fields:
        time: of each row [s]                        (n,)
        position: of each hand [m]                   (n, hand, 3)
        buttons: one bit each; 0 without a column    (n, hand)
    """

    time: FloatArray
    position: FloatArray
    buttons: IntArray


def are_buttons(value: float) -> bool:
    """Whether a number is one that `BUTTONS_RULE` allows."""
    # Comparisons with NaN are False.
    return 0 <= value <= BUTTONS_LARGEST and value == int(value)


def motion_columns(mark: str = "") -> list[str]:
    """Names of one hand's columns: x, y, z [m] and the buttons, each with the hand's suffix."""
    return [f"{name}{mark}" for name in ("x", "y", "z", "buttons")]


def read_motion(path: Path, marks: Sequence[str] = ("",), *, rows_largest: int) -> Motion:
    """Read a file with a header: time [s]; for each hand x, y, z [m] and optionally buttons; other columns are ignored.

    Args:
        path: of the file.
        marks: suffix of the column names of each hand.
        rows_largest: largest number of rows.

    Raises:
        ValueError: a missing column, a row that is not numeric, invalid buttons, too many rows or none; names the file
            and the line.
        OSError: the file cannot be read.
    """
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        reader = csv.DictReader(file)
        try:
            places, pressed = _columns(reader.fieldnames or [], marks, path.name)
            rows = list(_rows(reader, [*places, *pressed], path.name, rows_largest))
        except csv.Error as error:
            raise ValueError(f"{path.name}, line {reader.line_num + 1}: {error}; it is not a CSV file") from None
    if not rows:
        raise ValueError(f"{path.name}: no rows below the header")
    table = np.array(rows)
    buttons = np.zeros((len(table), len(marks)), dtype=np.int32)
    for hand, mark in enumerate(marks):
        name = motion_columns(mark)[3]
        if name in pressed:
            buttons[:, hand] = table[:, len(places) + pressed.index(name)]
    return Motion(table[:, 0], table[:, 1 : len(places)].reshape(-1, len(marks), 3), buttons)


def _columns(names: Sequence[str], marks: Sequence[str], file_name: str) -> tuple[list[str], list[str]]:
    """The columns of time and positions, and those of buttons that exist."""
    places = ["time", *(name for mark in marks for name in motion_columns(mark)[:3])]
    pressed = [motion_columns(mark)[3] for mark in marks]
    missing = [name for name in places if name not in names]
    if missing:
        raise ValueError(
            f"{file_name}: column {missing[0]!r} is missing; it must have {', '.join(places)}, and may have "
            f"{', '.join(pressed)}"
        )
    return places, [name for name in pressed if name in names]


def _rows(reader: csv.DictReader, columns: Sequence[str], file_name: str, rows_largest: int) -> Iterator[list[float]]:
    """The numbers of each row."""
    for number, row in enumerate(reader):
        if number >= rows_largest:
            raise ValueError(f"{file_name}: more than {rows_largest} rows; cut it into parts")
        line = reader.line_num
        try:
            numbers = [float(row[name]) for name in columns]
        except (TypeError, ValueError):
            raise ValueError(f"{file_name}, line {line}: not a number in each of {', '.join(columns)}") from None
        for name, value in zip(columns, numbers, strict=True):
            if name.startswith("buttons") and not are_buttons(value):
                raise ValueError(f"{file_name}, line {line}: {name} is {value:g}; it must be {BUTTONS_RULE}")
        yield numbers
