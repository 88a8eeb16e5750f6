"""What a simulation felt and where its tip was, haptic step by haptic step."""

from bisect import bisect_left

import mujoco
import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.instrument import Instrument


class HapticRecord:
    """Time, wrench and tip pose at the end of each haptic step of a recording; reading it leaves the episode alone.

    After mj_step2 MuJoCo's coordinates are of the step's end and its poses of the start, so the tip's pose is worked
    out from the coordinates in data of the record's own: not a bit of the instrument's is written.
    """

    def __init__(self, instrument: Instrument) -> None:
        """Record the steps of an instrument from now on."""
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
        """Index of the first step from `start` on in which a tool felt the tissue; None where none did."""
        later = bisect_left(self._touching, start)
        return self._touching[later] if later < len(self._touching) else None

    @property
    def time(self) -> FloatArray:
        """End of each haptic step since the reset [s], shape (n,)."""
        return np.array(self._time)

    @property
    def wrench(self) -> FloatArray:
        """Tissue's mean force [N], and torque about the centre of mass [N m], on each tool, shape (n, n_tool, 6)."""
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
