"""Playback of a recorded motion as a haptic device."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from msdm_core.mesh import FloatArray, IntArray
from surgsim_apps.haptics.device import DevicePose
from surgsim_env.scripting import read_motion

# Tolerance of a row's time, as a share of the haptic step.
ROUNDING = 1e-3


class TrajectoryDevice:
    """Positions over time, interpolated linearly, one haptic step per `read`; forces are stored.

    A row without a place gives no pose.

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
        """True after the last row."""
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
