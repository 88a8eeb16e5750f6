"""Bodies of a MuJoCo model that tissue feels: contact shapes, poses, twists, and their response to wrenches."""

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.stepping import round_shapes, unyielding
from surgsim_env.instruments import tool_kernels
from surgsim_env.instruments.tool_kernels import Servo, ToolViews

IndexArray = NDArray[np.int64]

# Geoms of this group are what tissue feels: spheres, capsules and boxes, whose edges are rounded.
CONTACT_GROUP = 3
# Prefix of a model's custom number (<numeric>) for the friction of a geom; the geom's name follows.
ROUGHNESS = "roughness_"


def make_servo(lower: FloatArray, upper: FloatArray, position: IndexArray, speed: IndexArray) -> Servo:
    """A servo at rest: limits of its joints [m or rad], indices of MuJoCo's position and speed controls, each (n,)."""
    return Servo(np.zeros(len(lower)), lower.copy(), upper.copy(), position, speed, np.zeros(len(lower), dtype=bool))


@dataclass(frozen=True, eq=False)
class _Cores:
    """Cores of the contact geoms, each array (n_shape,): radius, axes along and across, half sizes [m], friction.

    A box is rounded by its smallest half size; its core lies along the longest and spans the other.
    """

    radius: FloatArray
    axis: IndexArray
    half_length: FloatArray
    across: IndexArray
    half_width: FloatArray
    friction: FloatArray


def _cores(model: mujoco.MjModel, geoms: IndexArray) -> _Cores:
    size, kind = model.geom_size[geoms], model.geom_type[geoms]
    box = kind == mujoco.mjtGeom.mjGEOM_BOX
    capsule = kind == mujoco.mjtGeom.mjGEOM_CAPSULE
    # The axes of a box by size (thin, middle, long); other geoms lie along z, and their first size is the radius.
    order = np.where(box[:, None], np.argsort(size, axis=1, kind="stable"), np.array([[0, 1, 2]]))
    thin, middle, long = np.take_along_axis(size, order, axis=1).T
    return _Cores(
        radius=thin.copy(),
        axis=order[:, 2].copy(),
        half_length=np.where(box, long - thin, np.where(capsule, size[:, 1], 0.0)),
        across=order[:, 1].copy(),
        half_width=np.where(box, middle - thin, 0.0),
        friction=np.array([_roughness(model, int(geom)) for geom in geoms]),
    )


def _roughness(model: mujoco.MjModel, geom: int) -> float:
    """Coulomb coefficient of a geom relative to the contact law's: the model's custom number for it, or 1."""
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, ROUGHNESS + model.geom(geom).name)
    return 1.0 if number < 0 else float(model.numeric_data[model.numeric_adr[number]])


def _implicit_damping(model: mujoco.MjModel) -> FloatArray:
    """Damping that MuJoCo's implicit integrator adds to the joints' own [N s/m, N m s], (nv, nv).

    It comes from velocity servos of joints (also at the limit of their force) and from damped fixed tendons.
    """
    damping = np.zeros((model.nv, model.nv))
    for actuator in np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT):
        joint = model.jnt_dofadr[model.actuator_trnid[actuator, 0]]
        gear = model.actuator_gear[actuator, 0]
        damping[joint, joint] -= gear * gear * model.actuator_biasprm[actuator, 2]
    for tendon in range(model.ntendon):
        first, count = model.tendon_adr[tendon], model.tendon_num[tendon]
        parts = np.arange(first, first + count)
        if (model.wrap_type[parts] == mujoco.mjtWrap.mjWRAP_JOINT).all():
            arm = np.zeros(model.nv)
            arm[model.jnt_dofadr[model.wrap_objid[parts]]] = model.wrap_prm[parts]
            damping += model.tendon_damping[tendon].ravel()[0] * np.outer(arm, arm)
    return damping


class ToolBodies:
    """The tools of a MuJoCo model: every body that carries contact shapes.

    A subclass sets the `servo` that drives joints; here it has none. Wrenches and twists refer to a body's centre of
    mass, as `xfrc_applied` and `mj_objectVelocity` do. MuJoCo gives angular before linear velocities;
    `tool_kernels.read_shapes` swaps them, and nothing else does.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        """Find the tools of a model; the model is not changed."""
        self.model = model
        self.data = mujoco.MjData(model)
        self._geoms = np.flatnonzero(model.geom_group == CONTACT_GROUP)
        bodies = model.geom_bodyid[self._geoms]
        self._tools = np.unique(bodies)
        self._core = _cores(model, self._geoms)
        count = len(self._tools)
        self.shapes = round_shapes(
            np.zeros((len(self._geoms), 2, 3)),
            self._core.radius,
            friction=self._core.friction,
            tool=np.searchsorted(self._tools, bodies),
            centre=np.zeros((count, 3)),
        )
        self.response = unyielding(count)
        self.servo = make_servo(np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
        self.jaws = np.zeros((0, 2), dtype=np.int32)
        self._velocity = np.zeros(6)
        self._jacobians = np.zeros((count, 6, model.nv))
        self._inertia = np.zeros((model.nv, model.nv))
        self._yielded = np.zeros((model.nv, 6))
        self._implicit_damping = _implicit_damping(model)

    @property
    def tool_count(self) -> int:
        """How many bodies carry contact shapes."""
        return len(self._tools)

    @property
    def tool_names(self) -> list[str]:
        """Name of each tool's body in the model."""
        return [self.model.body(body).name for body in self._tools]

    def drive(self) -> None:
        """Move the servo's targets by one step of the commanded speeds; they stop at their limits."""
        tool_kernels.drive_servo(self.views())

    def read_shapes(self) -> None:
        """Read the current pose and twist of every contact shape into `shapes`; call after mj_step1."""
        tool_kernels.read_shapes(self.views(), self.shapes)

    def read_response(self) -> None:
        """Read how the tools move on without the tissue, and yield to it, into `response`; call after `drive`."""
        tool_kernels.read_response(self.views(), self.response)

    def damped_inertia(self, dt: float) -> FloatArray:
        """M + dt D: joint-space inertia, armature included, and the joints' damping over dt [s], (nv, nv).

        Overwritten by the next call.
        """
        tool_kernels.read_inertia(self.views(), dt)
        return self._inertia

    def jacobian(self, tool: int) -> FloatArray:
        """From joint velocities to a tool's twist at its centre of mass, shape (6, nv); overwritten by its next."""
        tool_kernels.read_jacobian(self.views(), tool)
        return self._jacobians[tool]

    def apply_wrench(self, wrench: FloatArray) -> None:
        """Apply the tissue's mean wrench to each tool, shape (n_tool, 6) [N, N m], in place of the last one."""
        self.data.xfrc_applied[self._tools] = wrench

    def views(self, *, compiled: bool = False) -> ToolViews:
        """What stepping these tools reads and writes, for compiled code or for Python; valid until `data` is replaced.

        Make it for each call: a copied instrument has data of its own.
        """
        model, data = self.model, self.data
        return ToolViews(
            model=model._address if compiled else model,
            data=data._address if compiled else data,
            timestep=model.opt.timestep,
            geoms=self._geoms,
            axis=self._core.axis,
            half_length=self._core.half_length,
            across=self._core.across,
            half_width=self._core.half_width,
            bodies=self._tools,
            joint_damping=model.dof_damping,
            implicit_damping=self._implicit_damping,
            geom_position=data.geom_xpos,
            geom_rotation=data.geom_xmat,
            body_centre=data.xipos,
            smooth_force=data.qfrc_smooth,
            applied_wrench=data.xfrc_applied,
            control=data.ctrl,
            servo=self.servo,
            jaws=self.jaws,
            velocity=self._velocity,
            jacobians=self._jacobians,
            inertia=self._inertia,
            yielded=self._yielded,
        )
