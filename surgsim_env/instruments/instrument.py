"""Interface of instruments in MuJoCo for simulations and tasks: control of tip and jaw, readings, saved state."""

import logging
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import dot, matmul, norm
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.instruments.patches import TaxelPatches
from surgsim_env.instruments.tool_bodies import CONTACT_GROUP, ToolBodies
from surgsim_env.scene.model import SceneInstrument

# Without a handler MuJoCo writes its warnings to MUJOCO_LOG.TXT in the working folder.
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(logging.getLogger("mujoco").warning)

# Shape of the forces of no taxels: 0 numbers.
NO_TAXELS = (0, 0, 0, 3)
# Time from open to closed [s].
STROKE_TIME = 0.5


class Jaw:
    """Two fingers of an instrument, each a tool, commanded by a target from -1 (closed) to 1 (open).

    The servo moves the fingers' position targets in STROKE_TIME from closed to open. The force (or torque) range of the
    fingers' joints in the model limits their force.

    Fields:
        tools: the two fingers, as tools of the instrument                       (2,)
        shapes: their pads, as contact shapes of the instrument                  (2,)
        has_pads: True if these are flat (boxes), for a hold on tissue
        closed, opened: values of the fingers' joints at -1 and at 1 [rad or m]  (2,)
    """

    def __init__(self, instrument: ToolBodies, joints: tuple[str, ...], places: NDArray[np.int64]) -> None:
        """Take the two fingers' joints of an instrument, opening upwards, and their indices in its servo (2,).

        Raises:
            ValueError: not two fingers, or a finger without a contact geom.
        """
        model = instrument.model
        if len(joints) != 2:
            raise ValueError(f"a jaw has two fingers, each with a joint; not {len(joints)} ({', '.join(joints)})")
        index = np.array([model.joint(name).id for name in joints])
        bodies = model.jnt_bodyid[index]
        for body in bodies:
            if model.body(body).name not in instrument.tool_names:
                raise ValueError(f"finger {model.body(body).name!r} has no contact geom: it would pass through tissue")
        self._instrument, self._places = instrument, places
        self.tools = np.array([instrument.tool_names.index(model.body(body).name) for body in bodies], dtype=np.int32)
        self.shapes = np.array([np.flatnonzero(instrument.shapes.shape_tool == tool)[0] for tool in self.tools])
        self._pads = np.flatnonzero(model.geom_group == CONTACT_GROUP)[self.shapes]
        self._qpos = model.jnt_qposadr[index]
        self.closed, self.opened = model.jnt_range[index].T.copy()
        self.has_pads = bool((model.geom_type[self._pads] == int(mujoco.mjtGeom.mjGEOM_BOX)).all())
        # A box is thinnest across its pad; the first size of a ball or capsule is its radius.
        across = np.argmin(model.geom_size[self._pads], axis=1) if self.has_pads else np.zeros(2, dtype=np.int64)
        self._half_thickness = model.geom_size[self._pads, across]
        self._inward = self._inner_sides(across)

    @property
    def target(self) -> float:
        """Current position target of the fingers, from -1 (closed) to 1 (open)."""
        first = self._instrument.data.ctrl[self._controls[0]]
        return float(2.0 * (first - self.closed[0]) / (self.opened[0] - self.closed[0]) - 1.0)

    @property
    def friction(self) -> FloatArray:
        """Coulomb coefficient of each pad relative to the contact law's, (2,)."""
        return self._instrument.shapes.shape_friction[self.shapes]

    @property
    def normals(self) -> FloatArray:
        """Unit vectors out of the pads, towards each other, (2, 3); without pads, from one finger to the other."""
        data = self._instrument.data
        if self.has_pads:
            return dot(data.geom_xmat[self._pads].reshape(2, 3, 3), self._inward[:, None])
        gap = data.geom_xpos[self._pads[1]] - data.geom_xpos[self._pads[0]]
        return np.stack([gap, -gap]) / norm(gap)

    @property
    def opening(self) -> float:
        """Gap between the pads at their middles, along their mean normal [m]."""
        first, second = self._instrument.data.geom_xpos[self._pads]
        normals = self.normals
        mean = normals[0] - normals[1]
        return float(matmul(second - first, mean) / norm(mean) - self._half_thickness.sum())

    def command(self, target: float) -> None:
        """Command the fingers to a target from -1 (closed) to 1 (open), and hold it.

        Raises:
            ValueError: a target outside that range.
        """
        if not -1.0 <= target <= 1.0:
            raise ValueError(f"jaw target {target:g} is out of range: it goes from -1 (closed) to 1 (open)")
        servo, span = self._instrument.servo, self.opened - self.closed
        goal = self.closed + 0.5 * (target + 1.0) * span
        now = self._instrument.data.ctrl[self._controls]
        servo.command[self._places] = np.sign(goal - now) * span / STROKE_TIME
        # The servo stops at the goal as at any other limit.
        servo.lower[self._places] = np.where(goal < now, goal, self.closed)
        servo.upper[self._places] = np.where(goal > now, goal, self.opened)

    def rest(self) -> None:
        """Drop any command; a jaw with pads is opened, another jaw keeps MuJoCo's data.

        The caller brings MuJoCo's positions up to date.
        """
        servo, data = self._instrument.servo, self._instrument.data
        servo.command[self._places] = 0.0
        servo.lower[self._places], servo.upper[self._places] = self.closed, self.opened
        if self.has_pads:
            data.qpos[self._qpos] = data.ctrl[self._controls] = self.opened

    @property
    def _controls(self) -> NDArray[np.int64]:
        return self._instrument.servo.position[self._places]

    def _inner_sides(self, across: NDArray[np.int64]) -> FloatArray:
        """Normals of the open jaw's pads towards each other, each in its geom's own frame, (2, 3)."""
        model = self._instrument.model
        data = mujoco.MjData(model)
        data.qpos[self._qpos] = self.opened
        mujoco.mj_kinematics(model, data)
        gap = data.geom_xpos[self._pads[1]] - data.geom_xpos[self._pads[0]]
        axes = np.eye(3)[across]
        outward = dot(data.geom_xmat[self._pads].reshape(2, 3, 3), axes[:, None])
        return axes * np.sign(matmul(outward, gap) * np.array([1.0, -1.0]))[:, None]


@dataclass(frozen=True)
class Grasp:
    """Hold of a jaw on tissue, from the contact forces of one haptic step.

    Args:
        opening: gap between the pads at their middles [m].
        grip_force: the smaller of the tissue's two forces along the pads' own normals [N].
        pull_force: size of the sum of the tissue's forces on both fingers [N].
        friction_left: friction in reserve, mu (N1 + N2) - (T1 + T2) [N], with N and T each pad's normal and
            tangential force; at 0 or below the tissue slips.
        holds: True if tissue presses both pads.
    """

    opening: float
    grip_force: float
    pull_force: float
    friction_left: float
    holds: bool


def read_grasp(jaw: Jaw | None, wrench: FloatArray, friction: float) -> Grasp | None:
    """Grasp of a jaw at the current poses of its instrument; None without a jaw.

    Args:
        jaw: of an instrument.
        wrench: the tissue's force [N] and torque [N m] on each tool, (n_tool, 6).
        friction: Coulomb coefficient of the scene's contact law; the pads' relative coefficients multiply it.
    """
    if jaw is None:
        return None
    forces, normals = wrench[jaw.tools, :3], jaw.normals
    # Tissue pushes a pad back, against its normal.
    along = (forces * normals).sum(axis=1)
    pressing = np.maximum(-along, 0.0)
    tangential = norm(forces - along[:, None] * normals, axis=1)
    return Grasp(
        opening=jaw.opening,
        grip_force=float(pressing.min()),
        pull_force=float(norm(forces.sum(axis=0))),
        friction_left=float((friction * jaw.friction * pressing - tangential).sum()),
        holds=bool((pressing > 0.0).all()),
    )


class Instrument(ToolBodies):
    """Tool with a commanded tip velocity within a box; its servo moves joint targets.

    Fields:
        lower, upper: the box of the tip [m]                                     (3,)
        parked: position of the tip before the first reset [m]                   (3,)
        jaw: None without one
        turning_size: size of the angular velocity command: 0 if the tip does not turn, 1 about a hinge, 3 in space
        patches: of taxels; None without
    """

    turning_size = 0
    patches: TaxelPatches | None = None
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
    def taxel_shape(self) -> tuple[int, int, int, int]:
        """Shape of the taxels' forces (`TaxelPatches.forces`)."""
        return NO_TAXELS if self.patches is None else self.patches.shape

    @property
    def workspace_limited(self) -> bool:
        """True if a servo's target was stopped at a limit in the last haptic step."""
        # The last joints are those of jaws: their servo stops at the jaw's target.
        return bool(self.servo.limited[: len(self.servo.limited) - 2 * len(self.jaws)].any())

    @property
    def trocar_force(self) -> float | None:
        """Size of the shaft's force on a yielding wall [N]; None without one."""
        return None

    @property
    def trocar_residual(self) -> float | None:
        """Distance of the shaft's axis from the trocar [m]; None for an instrument without one."""
        return None

    @property
    def tip_position(self) -> FloatArray:
        """Centre of the tip's ball, or the middle between the pads [m], shape (3,)."""
        return self.data.site_xpos[self._tip].copy()

    @property
    def tip_reading(self) -> FloatArray:
        """Position of the tip by the joints' encoders [m], (3,); of exact joints `tip_position`."""
        return self.tip_position

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

    def draw_errors(self, rng: np.random.Generator) -> None:
        """Draw the errors of the joints for an episode; of exact joints none."""

    def place(self, position: FloatArray) -> None:
        """Place the tip at rest at a position [m] and reset all else; a jaw with pads is open."""
        raise NotImplementedError

    def command_velocity(self, velocity: FloatArray, turning: FloatArray | None = None) -> None:
        """Command the tip's velocity [m/s] (3,) and angular velocity [rad/s] (turning_size,)."""
        raise NotImplementedError

    def command_jaw(self, target: float) -> None:
        """Command the jaw to a target from -1 (closed) to 1 (open), approached at limited speed and held.

        Raises:
            ValueError: no jaw, or a target outside that range.
        """
        if self.jaw is None:
            raise ValueError(f"{self._where()} has no jaw to command")
        self.jaw.command(target)

    def turning_of(self, turning: FloatArray | None) -> FloatArray:
        """Angular velocity command of the tip [rad/s], (turning_size,); zeros for None.

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
        """First MuJoCo warning since the last reset, or an empty string."""
        for kind in range(mujoco.mjtWarning.mjNWARNING):
            if self.data.warning[kind].number:
                return f"MuJoCo warning {mujoco.mjtWarning(kind).name}"
        return ""

    def get_state(self) -> FloatArray:
        """Whole state of the instrument, with its command, as a vector."""
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

    def set_patches(self, description: SceneInstrument, outward: FloatArray) -> None:
        """Put the scene's taxels on the jaw's pads, else on the contact shape nearest to the tip, which faces outward.

        Args:
            description: of the instrument in the scene.
            outward: direction of the tip in its present pose, (3,).
        """
        if description.taxels is None:
            return
        mujoco.mj_kinematics(self.model, self.data)
        if self.jaw is None:
            away = norm(self.data.geom_xpos[self.geoms] - self.tip_position, axis=1)
            shapes, normals = np.array([np.argmin(away)]), outward[None]
        else:
            shapes, normals = self.jaw.shapes, self.jaw.normals
        self.patches = TaxelPatches(self, description.taxels, description.tip_radius, shapes, normals)

    def _set_jaw(self, jaw: Jaw) -> None:
        self.jaw, self.jaws = jaw, jaw.tools[None]

    def _where(self) -> str:
        """Name of the instrument in error messages."""
        return f"instrument {self.model.names.split(bytes(1))[0].decode()!r}"
