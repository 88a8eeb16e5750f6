"""Bodies of a MuJoCo model that tissue feels: their contact shapes, poses and twists, and how they yield."""

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from msdm_core.shapes import round_shapes
from msdm_core.stepping import unyielding
from surgsim_env.haptic_kernels import Servo, ToolViews, factorise, yield_tool

IndexArray = NDArray[np.int64]

# Geoms of this group are what tissue feels: spheres, capsules and boxes, whose edges are rounded.
CONTACT_GROUP = 3
# A custom number (<numeric>) of a model that says how rough a geom is: this, and the geom's name.
ROUGHNESS = "roughness_"


def make_servo(lower: FloatArray, upper: FloatArray, position: IndexArray, speed: IndexArray) -> Servo:
    """A servo at rest: limits of its joints [m or rad] and which of MuJoCo's controls hold and pace them, each (n,)."""
    return Servo(np.zeros(len(lower)), lower.copy(), upper.copy(), position, speed, np.zeros(len(lower), dtype=bool))


@dataclass(frozen=True, eq=False)
class _Cores:
    """Of each contact geom (n_shape,): its rounding [m], along which of its axes its core lies and spans [m], friction.

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
    # Of a box: the axes by size, thin, middle, long; all others lie along z and are as thick as their first size.
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
    """Coulomb coefficient of a geom over the contact law's: the model's custom number of that name, or 1."""
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, ROUGHNESS + model.geom(geom).name)
    return 1.0 if number < 0 else float(model.numeric_data[model.numeric_adr[number]])


def _brake(model: mujoco.MjModel) -> FloatArray:
    """How joint speeds brake themselves beside the joints' damping, as MuJoCo's implicit integrator has it, (nv, nv).

    Velocity servos of joints, at the limit of their force too, and the damping of fixed tendons [N s/m, N m s].
    """
    brake = np.zeros((model.nv, model.nv))
    for actuator in np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT):
        joint = model.jnt_dofadr[model.actuator_trnid[actuator, 0]]
        gear = model.actuator_gear[actuator, 0]
        brake[joint, joint] -= gear * gear * model.actuator_biasprm[actuator, 2]
    for tendon in range(model.ntendon):
        first, count = model.tendon_adr[tendon], model.tendon_num[tendon]
        parts = np.arange(first, first + count)
        if (model.wrap_type[parts] == mujoco.mjtWrap.mjWRAP_JOINT).all():
            arm = np.zeros(model.nv)
            arm[model.jnt_dofadr[model.wrap_objid[parts]]] = model.wrap_prm[parts]
            brake += model.tendon_damping[tendon].ravel()[0] * np.outer(arm, arm)
    return brake


class ToolBodies:
    """The tools of a MuJoCo model: every body that carries contact shapes. Their `servo` has no joints to drive here.

    Wrenches and twists refer to a body's centre of mass, which is what both `xfrc_applied` and `mj_objectVelocity` of
    a body mean. The order swap (MuJoCo gives angular before linear) happens here and nowhere else.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        """Find the tools of a model, which stays as it is."""
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
        self._brake = _brake(model)

    @property
    def tool_count(self) -> int:
        """How many bodies carry contact shapes."""
        return len(self._tools)

    @property
    def tool_names(self) -> list[str]:
        """Name of each tool's body in the model."""
        return [self.model.body(body).name for body in self._tools]

    def drive(self) -> None:
        """Move the servo's targets by one step of the commanded speeds; they stop at their limits, and it says so."""
        servo, control = self.servo, self.data.ctrl
        target = control[servo.position] + servo.command * self.model.opt.timestep
        held = np.clip(target, servo.lower, servo.upper)
        stopped = held != target
        servo.limited[:] = stopped
        control[servo.position] = held
        paced = servo.speed >= 0
        control[servo.speed[paced]] = np.where(stopped, 0.0, servo.command)[paced]

    def read_shapes(self) -> None:
        """Copy the current pose and twist of every contact shape into `shapes`; call after mj_step1."""
        shapes, data = self.shapes, self.data
        core = self._core
        for index, geom in enumerate(self._geoms):
            axes = data.geom_xmat[geom].reshape(3, 3).T
            half = axes[core.axis[index]] * core.half_length[index]
            shapes.shape_ends[index, 0] = data.geom_xpos[geom] - half
            shapes.shape_ends[index, 1] = data.geom_xpos[geom] + half
            shapes.shape_span[index] = axes[core.across[index]] * core.half_width[index]
        for index, body in enumerate(self._tools):
            mujoco.mj_objectVelocity(self.model, data, mujoco.mjtObj.mjOBJ_BODY, body, self._velocity, 0)
            shapes.tool_centre[index] = data.xipos[body]
            shapes.tool_twist[index, :3] = self._velocity[3:]
            shapes.tool_twist[index, 3:] = self._velocity[:3]

    def read_response(self) -> None:
        """How the tools move on without the tissue and yield to it, into `response`; call after `drive`.

        With the inertia M, what MuJoCo's integrator takes implicitly D (joints' damping, `_brake`), and all forces but
        the tissue's q, wrenches w_j on the tools j change the twist of tool i at the rate
        J_i (M + dt D)^-1 (q + sum_j J_j^T w_j), J being the tools' Jacobians: those of one arm share its joints.
        Centripetal terms are left out, and MuJoCo's own contacts, which it counts at the step's end.
        """
        model, data, response = self.model, self.data, self.response
        data.xfrc_applied[self._tools] = 0.0
        mujoco.mj_fwdActuation(model, data)
        mujoco.mj_fwdAcceleration(model, data)
        inertia = self.damped_inertia(model.opt.timestep)
        inertia += model.opt.timestep * self._brake
        factorise(inertia)
        for index in range(self.tool_count):
            self.jacobian(index)
        for index in range(self.tool_count):
            yield_tool(
                inertia,
                self._jacobians,
                index,
                data.qfrc_smooth,
                self._yielded,
                response.tool_mobility,
                response.tool_acceleration,
            )

    def damped_inertia(self, dt: float) -> FloatArray:
        """M + dt D: joint-space inertia, armature included, and the joints' damping over dt [s], (nv, nv).

        Overwritten by the next call.
        """
        mujoco.mj_fullM(self.model, self.data, self._inertia)
        self._inertia.ravel()[:: self.model.nv + 1] += dt * self.model.dof_damping
        return self._inertia

    def jacobian(self, tool: int) -> FloatArray:
        """From joint velocities to a tool's twist at its centre of mass, shape (6, nv); overwritten by its next."""
        jacobian = self._jacobians[tool]
        mujoco.mj_jacBodyCom(self.model, self.data, jacobian[:3], jacobian[3:], self._tools[tool])
        return jacobian

    def apply_wrench(self, wrench: FloatArray) -> None:
        """Write the tissue's mean wrench on each tool (overwritten each step), shape (n_tool, 6)."""
        self.data.xfrc_applied[self._tools] = wrench

    def views(self) -> ToolViews:
        """What compiled code needs to step these tools; good until the next call that replaces `data`."""
        model, data = self.model, self.data
        return ToolViews(
            model=model._address,
            data=data._address,
            timestep=model.opt.timestep,
            geoms=self._geoms,
            axis=self._core.axis,
            half_length=self._core.half_length,
            across=self._core.across,
            half_width=self._core.half_width,
            bodies=self._tools,
            joint_damping=model.dof_damping,
            brake=self._brake,
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
            reference=np.zeros((self.tool_count, 3)),
            wrench=np.zeros((self.tool_count, 6)),
        )
