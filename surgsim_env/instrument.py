"""An instrument simulated in MuJoCo: what a simulation and a task ask of any, and the Cartesian probe of a scene."""

from pathlib import Path

import mujoco
import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.scene_files import scenes_folder
from surgsim_env.scenes import Scene
from surgsim_env.tool_bodies import ToolBodies, make_servo

SLIDES = ("x", "y", "z")


class Instrument(ToolBodies):
    """A tool with a ball tip that is steered by the tip's velocity within a box; its servo moves joint targets.

    Fields:
        lower, upper: the box that the tip may move in [m]                       (3,)
        parked: where the tip waits before the first reset [m]                   (3,)
    """

    lower: FloatArray
    upper: FloatArray
    parked: FloatArray

    def __init__(self, model: mujoco.MjModel, lower: FloatArray, upper: FloatArray, tip_site: int) -> None:
        """Take a compiled model, the tip's box [m] and the index of the site at its tip."""
        super().__init__(model)
        self.lower, self.upper = lower, upper
        self._tip = tip_site

    @property
    def workspace_limited(self) -> bool:
        """Whether the servo's targets were stopped at a limit in the last haptic step."""
        return bool(self.servo.limited[0])

    @property
    def trocar_residual(self) -> float | None:
        """Distance of the shaft's axis from the trocar [m]; None for an instrument that passes through none."""
        return None

    @property
    def tip_position(self) -> FloatArray:
        """Centre of the tip ball [m], shape (3,)."""
        return self.data.site_xpos[self._tip].copy()

    @property
    def tip_velocity(self) -> FloatArray:
        """Velocity of the tip's centre [m/s], shape (3,)."""
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_SITE, self._tip, self._velocity, 0)
        return self._velocity[3:].copy()

    def tip_pose_in(self, data: mujoco.MjData) -> tuple[FloatArray, FloatArray]:
        """Position [m] (3,) and orientation (w, x, y, z) of the tip in up-to-date data of this model."""
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, data.site_xmat[self._tip])
        return data.site_xpos[self._tip].copy(), quaternion

    def place(self, position: FloatArray) -> None:
        """Put the tip at rest at a position [m], everything else as when loaded."""
        raise NotImplementedError

    def command_velocity(self, velocity: FloatArray) -> None:
        """Set the tip velocity that the servo follows from now on [m/s], shape (3,)."""
        raise NotImplementedError

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
        """All of the instrument's state, command included, as one vector."""
        signature = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(self.model, signature))
        mujoco.mj_getState(self.model, self.data, state, signature)
        return np.concatenate([state, self.servo.command, [float(self.servo.limited[0])]])

    def set_state(self, state: FloatArray) -> None:
        """Restore what `get_state` gave, to the bit."""
        size = mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_INTEGRATION)
        joints = len(self.servo.command)
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, state[:size], mujoco.mjtState.mjSTATE_INTEGRATION)
        self.servo.command[:] = state[size : size + joints]
        self.servo.limited[0] = bool(state[size + joints])
        self.refresh()

    def _rest(self) -> None:
        """Everything as when loaded, the servo still."""
        mujoco.mj_resetData(self.model, self.data)
        self.servo.command[:] = 0.0
        self.servo.limited[0] = False


class Probe(Instrument):
    """A Cartesian probe of a scene, placed in the world frame: slide coordinates are the tip's position."""

    def __init__(self, scene: Scene, lower: FloatArray, upper: FloatArray) -> None:
        """Load the scene's model; the tip may move in the box from lower to upper [m], and waits in its far corner."""
        model = _compile(scene, lower, upper)
        super().__init__(model, lower, upper, model.site("tip").id)
        self.parked = upper
        self.servo = make_servo(lower, upper, np.arange(3), np.arange(3, 6))

    def place(self, position: FloatArray) -> None:
        """Put the tip at rest at a position [m], everything else as when loaded."""
        self._rest()
        self.data.qpos[:3] = position
        self.data.ctrl[:3] = position
        mujoco.mj_forward(self.model, self.data)

    def command_velocity(self, velocity: FloatArray) -> None:
        """Set the tip velocity that the servo follows from now on [m/s], shape (3,)."""
        self.servo.command[:] = velocity


def _compile(scene: Scene, lower: FloatArray, upper: FloatArray) -> mujoco.MjModel:
    path = scenes_folder() / "instruments" / scene.instrument.model
    if not path.is_file():
        known = ", ".join(sorted(item.name for item in Path(path.parent).glob("*.xml")))
        raise ValueError(f"instrument {scene.instrument.model!r} is unknown; the instruments are {known}")
    spec = mujoco.MjSpec.from_file(str(path))
    spec.option.timestep = scene.timing.haptic_step
    ball, shaft, tip = spec.geom("tip_ball"), spec.geom("tip_shaft"), spec.body("tip")
    radius = scene.instrument.tip_radius
    ball.size = [radius, 0.0, 0.0]
    start = radius + float(shaft.size[0])
    shaft.fromto = [0.0, 0.0, start, 0.0, 0.0, start + 0.1]
    tip.quat = _rotation_from_down(np.asarray(scene.instrument.approach))
    for axis, name in enumerate(SLIDES):
        spec.joint(f"slide_{name}").range = [lower[axis], upper[axis]]
    return spec.compile()


def _rotation_from_down(direction: FloatArray) -> FloatArray:
    """Quaternion (w, x, y, z) that turns -z into a direction, the shortest way."""
    unit = direction / np.linalg.norm(direction)
    down = np.array([0.0, 0.0, -1.0])
    quaternion = np.concatenate([[1.0 + down @ unit], np.cross(down, unit)])
    if np.linalg.norm(quaternion) < 1e-9:
        return np.array([0.0, 1.0, 0.0, 0.0])
    return quaternion / np.linalg.norm(quaternion)
