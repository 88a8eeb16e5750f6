"""CSV files of the motion of hands (a header, then one row of numbers per time), and a device that plays one."""

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray, IntArray
from surgsim_env.haptics.device import DevicePose

# Of a pose: 31 bits, so that they fit into any integer type.
BUTTONS_LARGEST = 2**31 - 1
# Names of the columns with the tip's place [m], which recordings of `surgsim view` have.
TIP = "tip_"
# Tolerance of a row's time, as a share of the haptic step.
ROUNDING = 1e-3


class Motion(NamedTuple):
    """The motion of a hand.

    Fields:
        time: of each row, increasing [s]                                          (n,)
        position: [m]; three times nan in a row without a pose                     (n, 3)
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
            buttons, or no rows; names the file and the line or the row.
        OSError: the file cannot be read.
    """
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        reader = csv.DictReader(file)
        try:
            names = reader.fieldnames or []
            *places, pressed = motion_columns(mark)
            columns = ["time", *(f"{TIP if of_tip else ''}{name}" for name in places)]
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
    """The numbers of each row."""
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


class TrajectoryDevice:
    """Plays positions over time, interpolated linearly, one haptic step per `read`; forces are stored.

    In a row without a place it gives no pose.

    Fields:
        force: the last one written [N]                                    (3,)
    """

    dynamics = None

    def __init__(
        self,
        time: FloatArray,
        position: FloatArray,
        buttons: Sequence[int] | IntArray | None = None,
        *,
        haptic_step: float = 1e-3,
    ) -> None:
        """Play a trajectory; its last pose is held at the end.

        Args:
            time: of each row [s], increasing, (n,).
            position: [m], (n, 3); three times nan in a row without a pose.
            buttons: pressed from each row on, from 0 to 2^31 - 1, (n,); none by default.
            haptic_step: of the loop [s].
        """
        self._time, self._position = time, position
        self._buttons = np.zeros(len(time), dtype=np.int32) if buttons is None else np.asarray(buttons)
        self._has_place: Any = np.isfinite(position).all(axis=1)
        self.force = np.zeros(3)
        self._step = 0
        self._haptic_step = haptic_step

    @classmethod
    def load(cls, path: Path, *, haptic_step: float = 1e-3) -> "TrajectoryDevice":
        """Read a CSV file with a header: time [s], x, y, z [m] and optionally buttons; other columns are ignored.

        Raises:
            ValueError: as `read_motion`.
            OSError: the file cannot be read.
        """
        return cls(*read_motion(path), haptic_step=haptic_step)

    @property
    def over(self) -> bool:
        """Whether the last row has been played."""
        return self._time[0] + self._step * self._haptic_step > self._time[-1]

    def read(self) -> DevicePose | None:
        """The pose of the next haptic step."""
        now = self._time[0] + self._step * self._haptic_step
        self._step += 1
        # Written times are rounded.
        row = int(np.searchsorted(self._time, now + ROUNDING * self._haptic_step, side="right")) - 1
        later = min(row + 1, len(self._time) - 1)
        exact = row == later or abs(now - self._time[row]) <= ROUNDING * self._haptic_step
        if not self._has_place[row] or not (exact or self._has_place[later]):
            return None
        span = slice(row, row + 1) if exact else slice(row, later + 1)
        place = np.array([np.interp(now, self._time[span], column) for column in self._position[span].T])
        return DevicePose(place, float(now), int(self._buttons[row]))

    def write(self, force: FloatArray) -> None:
        """Store the force [N], (3,)."""
        self.force = np.array(force)

    def rewind(self) -> None:
        """Play from the start again."""
        self._step = 0
