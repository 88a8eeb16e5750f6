"""What a simulation and a task ask of any instrument in MuJoCo: place and steer its tip, read it, save its state."""

import mujoco
import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.instruments.jaw import Jaw
from surgsim_env.instruments.tool_bodies import ToolBodies


class Instrument(ToolBodies):
    """A tool that is steered by its tip's velocity within a box; its servo moves joint targets.

    Fields:
        lower, upper: the box that the tip may move in [m]                       (3,)
        parked: where the tip waits before the first reset [m]                   (3,)
        jaw: None without one
        turning_size: size of the angular velocity command: 0 if the tip does not turn, 1 about a hinge, 3 in space
    """

    turning_size = 0
    lower: FloatArray
    upper: FloatArray
    parked: FloatArray

    def __init__(self, model: mujoco.MjModel, lower: FloatArray, upper: FloatArray, tip_site: int) -> None:
        """Take a compiled model, the tip's box [m] and the index of the site at its tip."""
        super().__init__(model)
        self.lower, self.upper = lower, upper
        self.jaw: Jaw | None = None
        self._tip = tip_site

    @property
    def workspace_limited(self) -> bool:
        """Whether the servo's targets were stopped at a limit in the last haptic step."""
        # The last joints are those of jaws, whose servo stops at the jaw's target.
        return bool(self.servo.limited[: len(self.servo.limited) - 2 * len(self.jaws)].any())

    @property
    def opening(self) -> float | None:
        """Gap between the pads of the jaw [m]; None without one."""
        return None if self.jaw is None else self.jaw.opening

    @property
    def trocar_residual(self) -> float | None:
        """Distance of the shaft's axis from the trocar [m]; None for an instrument that passes through none."""
        return None

    @property
    def tip_position(self) -> FloatArray:
        """Centre of the tip's ball, or the middle between the pads [m], shape (3,)."""
        return self.data.site_xpos[self._tip].copy()

    @property
    def tip_velocity(self) -> FloatArray:
        """Velocity of the tip [m/s], shape (3,)."""
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_SITE, self._tip, self._velocity, 0)
        return self._velocity[3:].copy()

    def tip_pose_in(self, data: mujoco.MjData) -> tuple[FloatArray, FloatArray]:
        """Position [m] (3,) and orientation (w, x, y, z) of the tip in up-to-date data of this model."""
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, data.site_xmat[self._tip])
        return data.site_xpos[self._tip].copy(), quaternion

    def place(self, position: FloatArray) -> None:
        """Place the tip at rest at a position [m]; all else is as when loaded, and a jaw with pads is open."""
        raise NotImplementedError

    def command_velocity(self, velocity: FloatArray, turning: FloatArray | None = None) -> None:
        """Command the tip's velocity [m/s] (3,) and angular velocity [rad/s] (turning_size,)."""
        raise NotImplementedError

    def command_jaw(self, target: float) -> None:
        """Command the jaw to a target from -1 (closed) to 1 (open), which it approaches at limited speed and holds.

        Raises:
            ValueError: no jaw, or a target outside that range.
        """
        if self.jaw is None:
            raise ValueError(f"{self._where()} has no jaw to command")
        self.jaw.command(target)

    def turning_of(self, turning: FloatArray | None) -> FloatArray:
        """Angular velocity command of the tip [rad/s], (turning_size,); zeros if none is given.

        Raises:
            ValueError: a wrong number of values.
        """
        values = np.zeros(self.turning_size) if turning is None else np.asarray(turning, dtype=np.float64)
        if values.shape != (self.turning_size,):
            raise ValueError(f"turning has shape {values.shape}; {self._where()} takes ({self.turning_size},)")
        return values

    def refresh(self) -> None:
        """Bring poses and velocities up to the current coordinates (after mj_step2 they are one step old)."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_comVel(self.model, self.data)

    def warning(self) -> str:
        """The first MuJoCo warning raised since the last reset, or an empty string."""
        for kind in range(mujoco.mjtWarning.mjNWARNING):
            if self.data.warning[kind].number:
                return f"MuJoCo warning {mujoco.mjtWarning(kind).name}"
        return ""

    def get_state(self) -> FloatArray:
        """The whole state of the instrument, command included, as one vector."""
        signature = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(self.model, signature))
        mujoco.mj_getState(self.model, self.data, state, signature)
        servo = self.servo
        return np.concatenate([state, servo.command, servo.limited.astype(np.float64), servo.lower, servo.upper])

    def set_state(self, state: FloatArray) -> None:
        """Restore a state from `get_state`, to the bit."""
        servo, size = self.servo, mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, state[:size], mujoco.mjtState.mjSTATE_INTEGRATION)
        servo.command[:], servo.limited[:], servo.lower[:], servo.upper[:] = state[size:].reshape(4, -1)
        self.refresh()

    def _rest(self) -> None:
        """Reset MuJoCo's data and stop the servo."""
        mujoco.mj_resetData(self.model, self.data)
        self.servo.command[:] = 0.0
        self.servo.limited[:] = False

    def _set_jaw(self, jaw: Jaw) -> None:
        self.jaw, self.jaws = jaw, jaw.tools[None]

    def _where(self) -> str:
        """The instrument's name in error messages."""
        return f"instrument {self.model.names.split(bytes(1))[0].decode()!r}"
