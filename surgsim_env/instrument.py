"""An instrument simulated in MuJoCo: its contact shapes, its tools' poses and twists, and its velocity servo."""

from pathlib import Path

import mujoco
import numpy as np

from msdm_core.kernels import ContactShapes
from msdm_core.mesh import FloatArray
from msdm_core.stepping import unyielding
from surgsim_env.scene_files import scenes_folder
from surgsim_env.scenes import Scene

# Geoms of this group are what tissue feels: spheres and capsules.
CONTACT_GROUP = 3
SLIDES = ("x", "y", "z")


class Instrument:
    """A Cartesian probe of a scene, placed in the world frame: slide coordinates are the tip's position.

    A tool is a body that carries contact shapes; wrenches and twists refer to its centre of mass, which is what both
    `xfrc_applied` and `mj_objectVelocity` of a body mean. The order swap (MuJoCo gives angular before linear) happens
    here and nowhere else.
    """

    def __init__(self, scene: Scene, lower: FloatArray, upper: FloatArray) -> None:
        """Load the scene's model; the tip may move in the box from lower to upper [m]."""
        self.model = _compile(scene, lower, upper)
        self.data = mujoco.MjData(self.model)
        self.lower, self.upper = lower, upper
        self._tip = self.model.site("tip").id
        self._geoms = np.flatnonzero(self.model.geom_group == CONTACT_GROUP)
        bodies = self.model.geom_bodyid[self._geoms]
        self._tools = np.unique(bodies)
        self._half_length = np.array(
            [
                self.model.geom_size[geom, 1] if self.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
                for geom in self._geoms
            ]
        )
        count = len(self._tools)
        self.shapes = ContactShapes(
            shape_ends=np.zeros((len(self._geoms), 2, 3)),
            shape_radius=self.model.geom_size[self._geoms, 0].copy(),
            shape_tool=np.searchsorted(self._tools, bodies).astype(np.int32),
            tool_centre=np.zeros((count, 3)),
            tool_twist=np.zeros((count, 6)),
        )
        self.response = unyielding(count)
        self._velocity = np.zeros(6)
        self._command = np.zeros(3)
        self.workspace_limited = False

    @property
    def tool_count(self) -> int:
        """How many bodies carry contact shapes."""
        return len(self._tools)

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
        self._command[:] = 0.0
        self.workspace_limited = False
        mujoco.mj_forward(self.model, self.data)

    def command_velocity(self, velocity: FloatArray) -> None:
        """Set the tip velocity that the servo follows from now on [m/s], shape (3,)."""
        self._command[:] = velocity

    def drive(self) -> None:
        """Move the servo's target by one step of the commanded velocity; it stops at the workspace, and says so."""
        target = self.data.ctrl[:3] + self._command * self.model.opt.timestep
        held = np.clip(target, self.lower, self.upper)
        stopped = held != target
        self.workspace_limited = bool(stopped.any())
        self.data.ctrl[:3] = held
        self.data.ctrl[3:6] = np.where(stopped, 0.0, self._command)

    def read_shapes(self) -> None:
        """Copy the current pose and twist of every contact shape into `shapes`; call after mj_step1."""
        shapes, data = self.shapes, self.data
        for index, geom in enumerate(self._geoms):
            axis = data.geom_xmat[geom].reshape(3, 3)[:, 2] * self._half_length[index]
            shapes.shape_ends[index, 0] = data.geom_xpos[geom] - axis
            shapes.shape_ends[index, 1] = data.geom_xpos[geom] + axis
        for index, body in enumerate(self._tools):
            mujoco.mj_objectVelocity(self.model, data, mujoco.mjtObj.mjOBJ_BODY, body, self._velocity, 0)
            shapes.tool_centre[index] = data.xipos[body]
            shapes.tool_twist[index, :3] = self._velocity[3:]
            shapes.tool_twist[index, 3:] = self._velocity[:3]

    def read_response(self) -> None:
        """How the tools move on without the tissue and yield to it, into `response`; call after `drive`.

        With M the inertia and D the joints' damping, which MuJoCo's integrators take implicitly, a wrench w on a tool
        of Jacobian J changes its twist at the rate J (M + dt D)^-1 (q + J^T w), q being all other forces. Centripetal
        terms are left out; a velocity servo's implicit share too (it only brakes).
        """
        model, data = self.model, self.data
        data.xfrc_applied[self._tools] = 0.0
        mujoco.mj_fwdActuation(model, data)
        mujoco.mj_fwdAcceleration(model, data)
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        inertia[np.diag_indices(model.nv)] += model.opt.timestep * model.dof_damping
        jacobian = np.zeros((6, model.nv))
        for index, body in enumerate(self._tools):
            mujoco.mj_jacBodyCom(model, data, jacobian[:3], jacobian[3:], body)
            yielded = np.linalg.solve(inertia, jacobian.T)
            self.response.tool_acceleration[index] = data.qfrc_smooth @ yielded
            self.response.tool_mobility[index] = jacobian @ yielded

    def apply_wrench(self, wrench: FloatArray) -> None:
        """Write the tissue's mean wrench on each tool (overwritten each step), shape (n_tool, 6)."""
        self.data.xfrc_applied[self._tools] = wrench

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
        return np.concatenate([state, self._command, [float(self.workspace_limited)]])

    def set_state(self, state: FloatArray) -> None:
        """Restore what `get_state` gave, to the bit."""
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, state[:-4], mujoco.mjtState.mjSTATE_INTEGRATION)
        self._command[:] = state[-4:-1]
        self.workspace_limited = bool(state[-1])
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
