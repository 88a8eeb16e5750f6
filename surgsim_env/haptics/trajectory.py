"""CSV files of the motion of hands (a header, then one row of numbers per time), and a device that plays one."""

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray, IntArray
from surgsim_env.haptics.device import DevicePose, require_positive

# A trajectory of an hour at 1 kHz.
ROWS_LARGEST = 3_600_000
# Of a pose: 31 bits, so that they fit into any integer type.
BUTTONS_LARGEST = 2**31 - 1
BUTTONS_RULE = f"a whole number from 0 to {BUTTONS_LARGEST}"
# Names of the columns with the tip's place [m], which recordings of `surgsim view` have: in these a row stands for one
# haptic step, and steps in which no hand gave a place have none.
TIP = "tip_"
# Rows of a recording whose spacing is more than this many steps have a pause between them.
PAUSE_LEAST = 1.5
# Tolerance of a row's time, as a share of the haptic step.
ROUNDING = 1e-3


class Motion(NamedTuple):
    """The motion of one or more hands; numbers may be nan or infinite, buttons may not.

    Fields:
        time: of each row [s]                        (n,)
        position: of each hand [m]                   (n, hand, 3)
        buttons: one bit each; 0 without a column    (n, hand)
        recorded: whether it is a recording, where a place of nan stands for a step without one
    """

    time: FloatArray
    position: FloatArray
    buttons: IntArray
    recorded: bool = False


def are_buttons(value: float) -> bool:
    """Whether a number is one that `BUTTONS_RULE` allows."""
    # Comparisons with NaN are False.
    return 0 <= value <= BUTTONS_LARGEST and value == int(value)


def motion_columns(mark: str = "") -> list[str]:
    """Names of one hand's columns: x, y, z [m] and the buttons, each with the hand's suffix."""
    return [f"{name}{mark}" for name in ("x", "y", "z", "buttons")]


def read_motion(path: Path, marks: Sequence[str] = ("",), *, rows_largest: int) -> Motion:
    """Read a file with a header: time [s]; for each hand x, y, z [m] and optionally buttons; other columns are ignored.

    In a recording (a file with the tip's place) pauses are gaps in time; the motion has a row for each step of them.

    Args:
        path: of the file.
        marks: suffix of the column names of each hand.
        rows_largest: largest number of rows, those of pauses included.

    Raises:
        ValueError: a missing column, a row that is not numeric, invalid buttons, too many rows or none; names the file
            and the line.
        OSError: the file cannot be read.
    """
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        reader = csv.DictReader(file)
        try:
            names = reader.fieldnames or []
            places, pressed = _columns(names, marks, path.name)
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
    motion = Motion(table[:, 0], table[:, 1 : len(places)].reshape(-1, len(marks), 3), buttons)
    return _with_pauses(motion, path.name, rows_largest) if f"{TIP}x" in names else motion


def _with_pauses(motion: Motion, file_name: str, rows_largest: int) -> Motion:
    """A recording with a row without places for each step that its file leaves out; as it is where times are wrong."""
    spacing = np.diff(motion.time)
    # Others say which time is wrong.
    if not len(spacing) or not np.isfinite(motion.time).all() or not (spacing > 0.0).all():
        return motion._replace(recorded=True)
    step = float(np.median(spacing))
    steps = np.where(spacing > PAUSE_LEAST * step, np.round(spacing / step), 1.0)
    if not steps.sum() < rows_largest:
        raise ValueError(f"{file_name}: more than {rows_largest} steps with those of its pauses; cut it into parts")
    row = np.concatenate([[0], np.cumsum(steps)]).astype(np.int64)
    count = int(row[-1]) + 1
    position, buttons = np.full((count, *motion.position.shape[1:]), np.nan), np.zeros((count, motion.buttons.shape[1]))
    position[row], buttons[row] = motion.position, motion.buttons
    time = np.interp(np.arange(count), row, motion.time)
    return Motion(time, position, buttons.astype(np.int32), recorded=True)


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


class TrajectoryDevice:
    """Plays positions over time, interpolated linearly, one haptic step per `read`; forces are stored.

    In the pauses of a recording it gives no pose, as a device that has none.

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
        recorded: bool = False,
    ) -> None:
        """Play a trajectory; its last pose is held at the end.

        Args:
            time: of each row [s], increasing, (n,).
            position: in the device's frame [m], (n, 3).
            buttons: pressed from each row on, from 0 to 2^31 - 1, (n,); none by default.
            haptic_step: of the loop [s].
            recorded: whether a row with three places of nan stands for a step without a pose.

        Raises:
            ValueError: inconsistent shapes, a number that is not finite, times that do not increase (names the row).
        """
        require_positive("haptic_step", haptic_step, "s")
        self._time = np.array(time, dtype=np.float64)
        self._position = np.array(position, dtype=np.float64)
        count = len(self._time)
        pressed = np.zeros(count, dtype=np.int32) if buttons is None else np.asarray(buttons)
        if self._time.shape != (count,) or count < 1 or self._position.shape != (count, 3):
            raise ValueError(
                f"a trajectory has times (n,) and positions (n, 3), n at least 1; these are {self._time.shape} and "
                f"{self._position.shape}"
            )
        if pressed.shape != (count,):
            raise ValueError(f"a trajectory of {count} rows has buttons of shape {pressed.shape}; give one per row")
        wrong = [row for row, bits in enumerate(pressed.tolist()) if not are_buttons(bits)]
        if wrong:
            raise ValueError(
                f"buttons of row {wrong[0]} of the trajectory are {pressed[wrong[0]]}; they must be {BUTTONS_RULE}"
            )
        self._buttons = pressed.astype(np.int32)
        no_place = np.isnan(self._position).all(axis=1) & recorded
        self._has_place = np.logical_not(no_place)
        finite = np.isfinite(self._time) & (np.isfinite(self._position).all(axis=1) | ~self._has_place)
        if not finite.all():
            raise ValueError(f"row {np.flatnonzero(~finite)[0]} of the trajectory has a number that is not finite")
        backward = np.flatnonzero(np.diff(self._time) <= 0.0)
        if len(backward):
            row = int(backward[0]) + 1
            raise ValueError(f"time of row {row} of the trajectory, {self._time[row]:g} s, is not after the row before")
        self.force = np.zeros(3)
        self._step = 0
        self._haptic_step = haptic_step

    @classmethod
    def load(cls, path: Path, *, haptic_step: float = 1e-3) -> "TrajectoryDevice":
        """Read a CSV file with a header: time [s], x, y, z [m] and optionally buttons; other columns are ignored.

        Raises:
            ValueError: as `read_motion` and `TrajectoryDevice`; names the file, and the line or the row.
            OSError: the file cannot be read.
        """
        motion = read_motion(path, rows_largest=ROWS_LARGEST)
        try:
            return cls(
                motion.time,
                motion.position[:, 0],
                motion.buttons[:, 0],
                haptic_step=haptic_step,
                recorded=motion.recorded,
            )
        except ValueError as error:
            raise ValueError(f"{path.name}: {error}") from None

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


def save_trajectory(path: Path, time: FloatArray, position: FloatArray, buttons: Sequence[int] | None = None) -> None:
    """Write a trajectory that `TrajectoryDevice.load` reads: time [s] (n,), position [m] (n, 3), with all digits."""
    pressed = [0] * len(time) if buttons is None else buttons
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["time", *motion_columns()])
        for row in zip(np.asarray(time).tolist(), np.asarray(position).tolist(), pressed, strict=True):
            writer.writerow([repr(row[0]), *map(repr, row[1]), int(row[2])])
