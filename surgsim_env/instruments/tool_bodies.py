"""Tools, the bodies of a MuJoCo model in contact with tissue: shapes, poses, twists, response, mass; supports."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import eigh, matmul, norm, solve
from msdm_core.errors import OrganError
from msdm_core.kernels.structure_kernels import ContactLaw
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.stepping import round_shapes, unyielding
from msdm_core.organ.support import Support
from surgsim_env.instruments import tool_kernels
from surgsim_env.instruments.joint_couplings import joint_couplings
from surgsim_env.instruments.tool_kernels import Servo, ToolViews

IndexArray = NDArray[np.int64]

# Group of the geoms in contact with tissue: spheres, capsules and boxes with rounded edges.
CONTACT_GROUP = 3
# Prefix of a model's custom number (<numeric>) for a geom's friction; the geom's name follows.
ROUGHNESS = "roughness_"
SUPPORT_PREFIX = "support_"
# Bit of the contact masks between supports and the tools' contact geoms.
SUPPORT_BIT = 2
# As soft as cloth over a soft base: 1500 N/m for a tool of 0.1 kg, more for a heavier tool, critically damped.
# MuJoCo's negative solref [1/s^2, 1/s] gives a contact of impedance 1/2 a stiffness of 2 x 7500 N/m per kilogram of
# the tool.
SOLREF = (-7500.0, -173.0)
SOLIMP = (0.5, 0.5, 0.001, 0.5, 2.0)
# The pads of a jaw at rest face each other along UP as closely as possible; along UP_ELSE if the jaw points along UP.
UP, UP_ELSE = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
SUPPORT_COLOUR = (0.125, 0.335, 0.375, 1.0)
_GEOMS = {
    "plane": mujoco.mjtGeom.mjGEOM_PLANE,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
}


def frame_along(direction: FloatArray) -> FloatArray:
    """Right-handed frame with -z along a direction and y as close to up as possible, as columns (3, 3)."""
    z = -direction / norm(direction)
    up = UP if abs(matmul(z, UP)) < 0.9 else UP_ELSE
    y = up - matmul(up, z) * z
    y /= norm(y)
    return np.stack([np.cross(y, z), y, z], axis=1)


def make_servo(lower: FloatArray, upper: FloatArray, position: IndexArray, speed: IndexArray) -> Servo:
    """Servo at rest with joint limits [m or rad] and indices of MuJoCo's position and speed controls, each (n,)."""
    return Servo(np.zeros(len(lower)), lower.copy(), upper.copy(), position, speed, np.zeros(len(lower), dtype=bool))


def _roughness(model: mujoco.MjModel, geom: int) -> float:
    """Coulomb coefficient of a geom relative to the contact law's: the model's custom number for it, or 1."""
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, ROUGHNESS + model.geom(geom).name)
    return 1.0 if number < 0 else float(model.numeric_data[model.numeric_adr[number]])


def _implicit_damping(model: mujoco.MjModel) -> FloatArray:
    """Damping of MuJoCo's implicit integrator beyond the joints' own [N s/m, N m s], shape (nv, nv).

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


def _coupling_inertia(model: mujoco.MjModel) -> FloatArray:
    """Inertia against motion apart of coupled joints, 1e6 times their own: they move as one, (nv, nv)."""
    inertia = np.zeros((model.nv, model.nv))
    for follower, leader, terms in joint_couplings(model):
        apart = np.zeros(model.nv)
        apart[model.jnt_dofadr[follower]] = 1.0
        if leader >= 0:
            apart[model.jnt_dofadr[leader]] = -terms[1]
        inertia += 1e6 * model.dof_M0[apart != 0.0].max() * np.outer(apart, apart)
    return inertia


class ToolBodies:
    """Tools of a MuJoCo model: the bodies with contact shapes.

    A subclass sets the `servo` of its joints, and `patch_local`; here it has none. Wrenches and twists refer to a
    body's centre of mass, as `xfrc_applied` and `mj_objectVelocity` do. MuJoCo gives angular before linear velocities;
    `tool_kernels.read_shapes` swaps them, and nothing else does.

    Fields:
        geoms: geom of each contact shape                                        (n_shape,)
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        """Find the tools of a model, without changing it."""
        self.model = model
        self.data = mujoco.MjData(model)
        self.geoms = np.flatnonzero(model.geom_group == CONTACT_GROUP)
        bodies = model.geom_bodyid[self.geoms]
        self._tools = np.unique(bodies)
        size, kind = model.geom_size[self.geoms], model.geom_type[self.geoms]
        box, capsule = kind == mujoco.mjtGeom.mjGEOM_BOX, kind == mujoco.mjtGeom.mjGEOM_CAPSULE
        # The core of a box, rounded by its smallest half size, lies along its longest axis and spans the other
        # (thin, middle, long); other geoms lie along z, and their first size is the radius.
        order = np.where(box[:, None], np.argsort(size, axis=1, kind="stable"), np.array([[0, 1, 2]]))
        thin, middle, long = np.take_along_axis(size, order, axis=1).T
        self._axis, self._across = order[:, 2].copy(), order[:, 1].copy()
        self._half_length = np.where(box, long - thin, np.where(capsule, size[:, 1], 0.0))
        self._half_width = np.where(box, middle - thin, 0.0)
        count = len(self._tools)
        self.shapes = round_shapes(
            np.zeros((len(self.geoms), 2, 3)),
            thin.copy(),
            friction=np.array([_roughness(model, int(geom)) for geom in self.geoms]),
            tool=np.searchsorted(self._tools, bodies),
            centre=np.zeros((count, 3)),
        )
        self.response = unyielding(count)
        self.servo = make_servo(np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
        self.jaws = np.zeros((0, 2), dtype=np.int32)
        self.patch_local = np.zeros((0, 3, 3))
        self._velocity = np.zeros(6)
        self._jacobians = np.zeros((count, 6, model.nv))
        self._inertia = np.zeros((model.nv, model.nv))
        self._yielded = np.zeros((model.nv, 6))
        self._coupling_inertia = _coupling_inertia(model)
        self._implicit_damping = _implicit_damping(model) + self._coupling_inertia / model.opt.timestep

    @property
    def tool_count(self) -> int:
        """Number of tools."""
        return len(self._tools)

    @property
    def tool_names(self) -> list[str]:
        """Name of each tool's body in the model."""
        return [self.model.body(body).name for body in self._tools]

    def drive(self) -> None:
        """Move the servo's targets by one step of the commanded speeds; they stop at their limits."""
        tool_kernels.drive_servo(self.views())

    def read_shapes(self) -> None:
        """Read the current pose and twist of each contact shape into `shapes`; call after mj_step1."""
        tool_kernels.read_shapes(self.views(), self.shapes)

    def read_response(self) -> None:
        """Read the tools' acceleration without tissue and their mobility into `response`; call after `drive`."""
        tool_kernels.read_response(self.views(), self.response)

    def damped_inertia(self, dt: float) -> FloatArray:
        """M + dt D: joint-space inertia with armature and couplings, and the joints' damping over dt [s], (nv, nv).

        Overwritten by the next call.
        """
        tool_kernels.read_inertia(self.views(), dt)
        self._inertia += self._coupling_inertia
        return self._inertia

    def jacobian(self, tool: int) -> FloatArray:
        """Jacobian of a tool's twist at its centre of mass, shape (6, nv); overwritten by the tool's next call."""
        tool_kernels.read_jacobian(self.views(), tool)
        return self._jacobians[tool]

    def views(self, *, compiled: bool = False) -> ToolViews:
        """Arrays of a step of these tools, for compiled code or for Python; valid until `data` is replaced.

        Get them for each call: a copied instrument has data of its own.
        """
        model, data = self.model, self.data
        return ToolViews(
            model=model._address if compiled else model,
            data=data._address if compiled else data,
            timestep=model.opt.timestep,
            geoms=self.geoms,
            axis=self._axis,
            half_length=self._half_length,
            across=self._across,
            half_width=self._half_width,
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
            patch_local=self.patch_local,
            velocity=self._velocity,
            jacobians=self._jacobians,
            inertia=self._inertia,
            yielded=self._yielded,
        )


def add_supports(spec: mujoco.MjSpec, supports: Sequence[Support], *, moving: bool = False) -> None:
    """Add supports to a model's world as geoms `support_NAME` in the scene's frame, in contact with its tools.

    Moving supports are bodies of the same names for `place_supports`. Without supports nothing changes.
    Call it after all geoms have their groups and the world has its final frame.
    """
    if not supports:
        return
    # A pyramidal friction cone would make the contact 1 / mu^2 times as stiff.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    for geom in spec.geoms:
        if geom.group == CONTACT_GROUP:
            geom.conaffinity |= SUPPORT_BIT
    for support in supports:
        name = SUPPORT_PREFIX + support.name
        body = spec.worldbody.add_body(name=name, mocap=True, pos=support.position) if moving else spec.worldbody
        body.add_geom(
            name=name,
            type=_GEOMS[support.kind],
            pos=(0.0, 0.0, 0.0) if moving else support.position,
            quat=support.quaternion,
            # Half sizes of 0 draw an infinite plane.
            size=(*support.size, 0.0, 0.0, 0.0)[:3] if support.kind != "plane" else (0.0, 0.0, 0.05),
            friction=(support.friction, 0.005, 0.0001),
            contype=SUPPORT_BIT,
            conaffinity=0,
            # The contact parameters of the support apply, not those of the tool.
            priority=1,
            condim=3,
            solref=SOLREF,
            solimp=SOLIMP,
            rgba=SUPPORT_COLOUR,
        )


def place_supports(model: mujoco.MjModel, data: mujoco.MjData, supports: Sequence[Support], shift: FloatArray) -> None:
    """Displace moving supports from their places by shifts [m] (n_support, 3)."""
    for support, offset in zip(supports, shift, strict=True):
        body = model.body(SUPPORT_PREFIX + support.name).mocapid[0]
        data.mocap_pos[body] = np.asarray(support.position) + offset


@dataclass(frozen=True)
class ToolMass:
    """Effective mass of a tool at its contact shapes, and the minimum for the exchange.

    Args:
        name: the tool's body.
        stiffness: its largest contact stiffness [N/m].
        damping: its largest contact damping [N s/m].
        mass: its least effective mass over the ends of its contact shapes and all directions [kg].
        damped_mass: the same for M + (dt / 2) D, with the damping D of its joints [kg].
        least_mass: minimum of `damped_mass` [kg].
        least_damping: joint damping along the lightest direction in place of the missing mass [N s/m].
    """

    name: str
    stiffness: float
    damping: float
    mass: float
    damped_mass: float
    least_mass: float
    least_damping: float


def contact_area(tools: ToolBodies, tool: int) -> float:
    """Largest contact area of a tool [m^2]: cross-sections of its shapes, pi r^2 + 2 r l + w (2 r + l).

    l and w are length and width of the core, 0 for a ball, w = 0 for a capsule.

    A surface pressed by k_p per area and penetration holds a shape with k_p int (e . u)^2 dA along u, e being the
    direction of the pressure. For a ball in a flat surface up to its centre that is half of pi r^2, for one with
    tissue wrapped around its lower half two thirds; for a capsule's side pi / 4 of 2 r l. The effect of the turning
    pressure is smaller by penetration / radius.
    """
    own = tools.shapes.shape_tool == tool
    radius = tools.shapes.shape_radius[own]
    length = norm(np.diff(tools.shapes.shape_ends[own], axis=1)[:, 0], axis=1)
    width = 2.0 * norm(tools.shapes.shape_span[own], axis=1)
    return float((np.pi * (radius * radius) + 2.0 * radius * (length + width) + width * length).sum())


def tool_masses(tools: ToolBodies, contact: ContactLaw, surface_area: float, substep_count: int = 2) -> list[ToolMass]:
    """Effective and minimum mass of each tool at its current pose.

    In the worst case a tool of mass m touches tissue too heavy to move within a haptic step dt: a spring k = k_p A and
    a damper c = c_p A, where A is `contact_area`, at most the organ's whole surface; k_t replaces k_p where sticking
    friction is stiffer. An explicit exchange takes the force at the mean place x_n + v_n dt / 2 of a twist held over
    the step, v_(n+1) = v_n - (dt / m) (k (x_n + v_n dt / 2) + c v_n), x_(n+1) = x_n + dt v_(n+1). Its characteristic
    polynomial leaves the unit circle at z = -1, where 4 m = 2 k dt^2 + 2 c dt:

        m + b dt / 2 >= (k dt + c) dt / 2,

    where b is the joints' damping, which MuJoCo takes implicitly: m > k dt^2 / 2 without damping, or else
    b > k dt + c - 2 m / dt. (The minimum mass of Brown & Colgate 1998, "Minimum mass for haptic display simulations",
    for this integrator; the damping is Colgate & Schenkel's b > k T / 2, moved from the device to the tool.) As tools
    here respond within the step, and pressure is that of a substep's end, the actual limit is lower, 0.12 to
    0.33 k dt^2 depending on the number of substeps (from 2), and the bound is safe by a factor of 1.5 or more. With a
    single substep the pressure is that after the whole step at the old twist: m + b dt / 2 >= (1.5 k dt + c) dt / 2.
    The damping of servos is not counted, because servos saturate, nor is their stiffness.

    Args:
        tools: of one model; the derived quantities of its `data` are updated.
        contact: the scene's contact law.
        surface_area: of the organ's touchable surface [m^2].
        substep_count: of the organ in a haptic step.
    """
    mujoco.mj_forward(tools.model, tools.data)
    tools.read_shapes()
    dt = tools.model.opt.timestep
    stiffest = max(contact.stiffness, contact.tangential_stiffness if contact.friction > 0.0 else 0.0)
    masses: list[ToolMass] = []
    for tool, name in enumerate(tools.tool_names):
        area = min(contact_area(tools, tool), surface_area)
        stiffness, damping = stiffest * area, contact.damping * area
        mass, damped = (effective_mass(tools, tool, tools.damped_inertia(share * dt)) for share in (0.0, 0.5))
        ahead = 1.5 if substep_count == 1 else 1.0
        least = 0.5 * dt * (ahead * stiffness * dt + damping)
        masses.append(ToolMass(name, stiffness, damping, mass, damped, least, max(0.0, 2.0 * (least - mass) / dt)))
    return masses


def effective_mass(tools: ToolBodies, tool: int, inertia: FloatArray) -> float:
    """Least mass of a tool at the ends of its shapes' axes, 1 / max eig(J M^-1 J^T) [kg], for an inertia M (nv, nv)."""
    jacobian = tools.jacobian(tool)
    mobility = 0.0
    own = tools.shapes.shape_tool == tool
    ends, span = tools.shapes.shape_ends[own], tools.shapes.shape_span[own][:, None]
    for end in np.concatenate([ends - span, ends + span]).reshape(-1, 3):
        x, y, z = end - tools.shapes.tool_centre[tool]
        # Velocity of that end: v + omega x (x, y, z).
        at_end = jacobian[:3] + matmul(np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]), jacobian[3:])
        mobility = max(mobility, float(eigh(matmul(at_end, solve(inertia, at_end.T)))[0][-1]))
    return 1.0 / mobility if mobility > 0.0 else np.inf


def check_tool_masses(
    scene: str, tools: ToolBodies, contact: ContactLaw, surface_area: float, substep_count: int = 2
) -> None:
    """Check that all tools are heavy enough for a stable exchange.

    Raises:
        OrganError: a tool is too light (names it, its mass, the minimum mass, and a sufficient damping).
    """
    for tool in tool_masses(tools, contact, surface_area, substep_count):
        if tool.damped_mass < tool.least_mass:
            raise OrganError(
                f"scene {scene!r}: tool {tool.name!r} weighs {tool.mass * 1e3:.3g} g at its tip, too little for a "
                f"contact as stiff as {tool.stiffness:.3g} N/m at steps of {tools.model.opt.timestep * 1e3:g} ms: the "
                f"exchange would be unstable. Give it at least {tool.least_mass * 1e3:.3g} g, or joints damped with "
                f"{tool.least_damping:.3g} N s/m, or lower contact.stiffness or timing.haptic_step"
            )
