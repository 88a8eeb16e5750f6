"""An instrument simulated in MuJoCo: what a simulation and a task ask of any, and a scene's Cartesian probe."""

import mujoco
import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.jaw import Jaw
from surgsim_env.scene_files import scenes_folder
from surgsim_env.scenes import Scene
from surgsim_env.supports import add_supports
from surgsim_env.tool_bodies import ToolBodies, make_servo

SLIDES = ("x", "y", "z")


class Instrument(ToolBodies):
    """A tool that is steered by its tip's velocity within a box; its servo moves joint targets.

    Fields:
        lower, upper: the box that the tip may move in [m]                       (3,)
        parked: where the tip waits before the first reset [m]                   (3,)
        jaw: None without one
        turning_size: how many numbers say how the tip turns: 0 if it does not, 1 about a hinge, 3 in space
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
        # The joints of a jaw, which stop at their target, stand behind those that move the tip.
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
        """Put the tip at rest at a position [m], everything else as when loaded; a jaw with pads is open."""
        raise NotImplementedError

    def command_velocity(self, velocity: FloatArray, turning: FloatArray | None = None) -> None:
        """Set the tip's velocity [m/s] (3,) and how it turns [rad/s] (turning_size,) from now on."""
        raise NotImplementedError

    def command_jaw(self, target: float) -> None:
        """Let the jaw go to a target from -1 (closed) to 1 (open), at its limited speed, and stay there.

        Raises:
            ValueError: no jaw, or a target outside that range.
        """
        if self.jaw is None:
            raise ValueError(f"{self._where()} has no jaw to command")
        self.jaw.command(target)

    def turning_of(self, turning: FloatArray | None) -> FloatArray:
        """How the tip shall turn [rad/s], (turning_size,); zeros where nothing was said.

        Raises:
            ValueError: another number of values.
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
        """All of the instrument's state, command included, as one vector."""
        signature = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(self.model, signature))
        mujoco.mj_getState(self.model, self.data, state, signature)
        servo = self.servo
        return np.concatenate([state, servo.command, servo.limited.astype(np.float64), servo.lower, servo.upper])

    def set_state(self, state: FloatArray) -> None:
        """Restore what `get_state` gave, to the bit."""
        servo, size = self.servo, mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, state[:size], mujoco.mjtState.mjSTATE_INTEGRATION)
        servo.command[:], servo.limited[:], servo.lower[:], servo.upper[:] = state[size:].reshape(4, -1)
        self.refresh()

    def _rest(self) -> None:
        """Everything as when loaded, the servo still."""
        mujoco.mj_resetData(self.model, self.data)
        self.servo.command[:] = 0.0
        self.servo.limited[:] = False

    def _set_jaw(self, jaw: Jaw) -> None:
        self.jaw, self.jaws = jaw, jaw.tools[None]

    def _where(self) -> str:
        """What an error calls this instrument."""
        return f"instrument {self.model.names.split(bytes(1))[0].decode()!r}"


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

    def command_velocity(self, velocity: FloatArray, turning: FloatArray | None = None) -> None:
        """Set the tip velocity that the servo follows from now on [m/s], shape (3,); a probe does not turn."""
        self.turning_of(turning)
        self.servo.command[:] = velocity


def read_model(name: str) -> mujoco.MjSpec:
    """The model of a Cartesian instrument, an MJCF file in scenes/instruments."""
    path = scenes_folder() / "instruments" / name
    if not path.is_file():
        known = ", ".join(sorted(item.name for item in path.parent.glob("*.xml")))
        raise ValueError(f"instrument {name!r} is unknown; the instruments are {known}")
    return mujoco.MjSpec.from_file(str(path))


def _compile(scene: Scene, lower: FloatArray, upper: FloatArray) -> mujoco.MjModel:
    spec = read_model(scene.instrument.model)
    spec.option.timestep = scene.timing.haptic_step
    ball, shaft, tip = spec.geom("tip_ball"), spec.geom("tip_shaft"), spec.body("tip")
    radius = scene.instrument.tip_radius
    ball.size = [radius, 0.0, 0.0]
    start = radius + float(shaft.size[0])
    shaft.fromto = [0.0, 0.0, start, 0.0, 0.0, start + 0.1]
    tip.quat = _rotation_from_down(np.asarray(scene.instrument.approach))
    for axis, name in enumerate(SLIDES):
        spec.joint(f"slide_{name}").range = [lower[axis], upper[axis]]
    add_supports(spec, scene.supports)
    return spec.compile()


def _rotation_from_down(direction: FloatArray) -> FloatArray:
    """Quaternion (w, x, y, z) that turns -z into a direction, the shortest way."""
    unit = direction / np.linalg.norm(direction)
    down = np.array([0.0, 0.0, -1.0])
    quaternion = np.concatenate([[1.0 + down @ unit], np.cross(down, unit)])
    if np.linalg.norm(quaternion) < 1e-9:
        return np.array([0.0, 1.0, 0.0, 0.0])
    return quaternion / np.linalg.norm(quaternion)
