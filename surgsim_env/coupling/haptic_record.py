"""A recording of wrenches and tip poses, haptic step by haptic step."""

from bisect import bisect_left

import mujoco
import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.instruments.instrument import Instrument


class HapticRecord:
    """Time, wrench and tip pose at the end of each recorded haptic step; recording does not change the episode.

    After mj_step2 MuJoCo's coordinates belong to the end of the step and its poses to the start. The tip's pose is
    therefore computed from the coordinates in an MjData of the record's own; the instrument's data are not written.
    """

    def __init__(self, instrument: Instrument) -> None:
        """Start an empty record of an instrument."""
        self.instrument = instrument
        self._data = mujoco.MjData(instrument.model)
        self._time: list[float] = []
        self._wrench: list[FloatArray] = []
        self._position: list[FloatArray] = []
        self._orientation: list[FloatArray] = []
        self._touching: list[int] = []

    def __len__(self) -> int:
        return len(self._time)

    def note(self, time: float, wrench: FloatArray) -> None:
        """Add a finished step: its end [s] and the tissue's mean wrench on each tool [N, N m], shape (n_tool, 6)."""
        self._data.qpos[:] = self.instrument.data.qpos
        mujoco.mj_kinematics(self.instrument.model, self._data)
        position, orientation = self.instrument.tip_pose_in(self._data)
        if wrench.any():
            self._touching.append(len(self))
        self._time.append(time)
        self._wrench.append(wrench.copy())
        self._position.append(position)
        self._orientation.append(orientation)

    def first_contact(self, start: int = 0) -> int | None:
        """Index of the first step from `start` on in which a tool touched the tissue; None without one."""
        later = bisect_left(self._touching, start)
        return self._touching[later] if later < len(self._touching) else None

    @property
    def time(self) -> FloatArray:
        """End of each haptic step since the reset [s], shape (n,)."""
        return np.array(self._time)

    @property
    def wrench(self) -> FloatArray:
        """Mean force [N] of the tissue, and torque about the centre of mass [N m], on each tool, (n, n_tool, 6)."""
        return np.array(self._wrench).reshape(-1, self.instrument.tool_count, 6)

    @property
    def tip_position(self) -> FloatArray:
        """Centre of the tip ball [m], shape (n, 3)."""
        return np.array(self._position).reshape(-1, 3)

    @property
    def tip_orientation(self) -> FloatArray:
        """Unit quaternion (w, x, y, z) from the tip's axes to the world's, shape (n, 4)."""
        return np.array(self._orientation).reshape(-1, 4)

    def tip_position_at(self, index: int) -> FloatArray:
        """Centre of the tip ball at the end of one step [m], shape (3,)."""
        return self._position[index].copy()
