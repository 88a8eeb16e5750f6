"""An instrument simulated in MuJoCo: its model made for a scene, its tip and its velocity servo."""

from pathlib import Path

import mujoco
import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.haptic_kernels import Servo
from surgsim_env.scene_files import scenes_folder
from surgsim_env.scenes import Scene
from surgsim_env.tool_bodies import ToolBodies

SLIDES = ("x", "y", "z")


class Instrument(ToolBodies):
    """A Cartesian probe of a scene, placed in the world frame: slide coordinates are the tip's position."""

    def __init__(self, scene: Scene, lower: FloatArray, upper: FloatArray) -> None:
        """Load the scene's model; the tip may move in the box from lower to upper [m]."""
        super().__init__(_compile(scene, lower, upper))
        self.lower, self.upper = lower, upper
        self._tip = self.model.site("tip").id
        self.servo = Servo(np.zeros(3), lower, upper, np.zeros(1, dtype=bool))

    @property
    def workspace_limited(self) -> bool:
        """Whether the servo's target was stopped at the edge of the workspace in the last haptic step."""
        return bool(self.servo.limited[0])

    @property
    def tip_position(self) -> FloatArray:
        """Centre of the tip ball [m], shape (3,)."""
        return self.data.site_xpos[self._tip].copy()

    @property
    def tip_velocity(self) -> FloatArray:
        """Velocity of the tip's centre [m/s], shape (3,)."""
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_SITE, self._tip, self._velocity, 0)
        return self._velocity[3:].copy()

    def place(self, position: FloatArray) -> None:
        """Put the tip at rest at a position [m], everything else as when loaded."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:3] = position
        self.data.ctrl[:3] = position
        self.servo.command[:] = 0.0
        self.servo.limited[0] = False
        mujoco.mj_forward(self.model, self.data)

    def command_velocity(self, velocity: FloatArray) -> None:
        """Set the tip velocity that the servo follows from now on [m/s], shape (3,)."""
        self.servo.command[:] = velocity

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
        return np.concatenate([state, self.servo.command, [float(self.workspace_limited)]])

    def set_state(self, state: FloatArray) -> None:
        """Restore what `get_state` gave, to the bit."""
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, state[:-4], mujoco.mjtState.mjSTATE_INTEGRATION)
        self.servo.command[:] = state[-4:-1]
        self.servo.limited[0] = bool(state[-1])
        self.refresh()


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
