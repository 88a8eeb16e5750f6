"""Kinematics of an arm: tip, shaft, shapes and Jacobians at given joint values."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from msdm_core.arithmetic import dot, eigh, matmul, norm
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.support import Support
from surgsim_env.instruments.arm.model import LINK_GROUP, TIP_SITE, compile_arm, followers_in
from surgsim_env.instruments.tool_bodies import CONTACT_GROUP
from surgsim_env.scene.arm_description import ArmDescription, read_description
from surgsim_env.scene.model import Port
from surgsim_env.scene.palpable_surface import tangent_axes


class Pose(NamedTuple):
    """Position [m] (3,) and axes of a frame as columns (3, 3), world frame."""

    position: FloatArray
    rotation: FloatArray


class Arm:
    """Kinematics of an arm at a port, as functions of joint values; without state.

    Fields:
        description, port: of the arm
        model: MuJoCo's model of the arm alone
        joints: names of the driven joints, base to tip
        qpos, dof: their indices in MuJoCo's coordinates and velocities          (n,)
        followers: joints that follow them
        lower, upper: limits [rad or m]                                          (n,)
        speed_limit: [rad/s or m/s]                                              (n,)
        home: [rad or m]                                                         (n,)
        shape_names, shape_radius: outer shapes (contact geoms first) and radii [m]; a box counts as the capsule of the
            same length around its cross-section                                 (n_shape,)
        shape_half_axis: vector from the middle of each shape to its end, in its geom's frame [m]  (n_shape, 3)
        felt: True for shapes in contact with tissue                             (n_shape,)
        shapes, tip_site, shaft: indices of the shapes' geoms, the tip's site and the shaft's body in the model
        tip_axis: unit vector out of the tip, in its site's frame                (3,)
        shaft_point, shaft_axis: point [m] and direction of the shaft's axis, in its body's frame      (3,)
        trocar: [m]                                                              (3,)
    """

    def __init__(self, description: ArmDescription, port: Port, model: mujoco.MjModel) -> None:
        """Take the compiled model of a description at a port."""
        self.description, self.port, self.model = description, port, model
        self.joints = description.joints
        index = [model.joint(name).id for name in self.joints]
        self.qpos, self.dof = model.jnt_qposadr[index], model.jnt_dofadr[index]
        self.followers = followers_in(model, description)
        self._follower_qpos = model.jnt_qposadr[self.followers.joints]
        self._follower_dof = model.jnt_dofadr[self.followers.joints]
        self.lower, self.upper = model.jnt_range[index, 0].copy(), model.jnt_range[index, 1].copy()
        self.speed_limit = np.array(description.control.speed_limit)
        self.home = np.array([description.home[name] for name in self.joints])
        groups = [np.flatnonzero(model.geom_group == group) for group in (CONTACT_GROUP, LINK_GROUP)]
        self.shapes = np.concatenate(groups)
        self.felt = np.arange(len(self.shapes)) < len(groups[0])
        self.shape_names = [model.geom(geom).name for geom in self.shapes]
        size, kind = model.geom_size[self.shapes], model.geom_type[self.shapes]
        box, capsule = kind == mujoco.mjtGeom.mjGEOM_BOX, kind == mujoco.mjtGeom.mjGEOM_CAPSULE
        thin, middle, long = np.sort(size, axis=1).T
        self.shape_radius = np.where(box, np.sqrt(thin * thin + middle * middle), size[:, 0])
        half_length = np.where(box, long, np.where(capsule, size[:, 1], 0.0))
        self.shape_half_axis = np.eye(3)[np.where(box, size.argmax(axis=1), 2)] * half_length[:, None]
        self.tip_site = model.site(description.tip.site or TIP_SITE).id
        self.tip_axis = _unit(description.tip.direction)
        trocar = description.trocar
        self.shaft = model.body(trocar.shaft_body).id
        self.shaft_point, self.shaft_axis = np.array(trocar.shaft_point), _unit(trocar.shaft_axis)
        self.trocar = np.array(port.point)
        self._data = mujoco.MjData(model)
        self._jacobian = np.zeros((6, model.nv))

    @property
    def joint_count(self) -> int:
        """Number of driven joints."""
        return len(self.joints)

    @property
    def remote_centre_fixed(self) -> bool:
        """True if the mechanism itself keeps the shaft in the trocar."""
        return self.description.trocar.fixed

    @property
    def trocar_play(self) -> float:
        """Distance from the trocar at which the mechanism itself may keep the shaft [m]; 0 if control keeps it."""
        return self.description.trocar.tolerance if self.remote_centre_fixed else 0.0

    def tip_pose(self, joints: ArrayLike) -> Pose:
        """Pose of the tip at joint values (n,), in the frame of the description's site or body."""
        data = self._at(joints)
        return Pose(data.site_xpos[self.tip_site].copy(), data.site_xmat[self.tip_site].reshape(3, 3).copy())

    def tip_direction(self, joints: ArrayLike) -> FloatArray:
        """Unit vector out of the tip at joint values (n,), shape (3,)."""
        return matmul(self._at(joints).site_xmat[self.tip_site].reshape(3, 3), self.tip_axis)

    def tip_jacobian(self, joints: ArrayLike) -> FloatArray:
        """Jacobian of the tip's velocity [m/s] and angular velocity [rad/s], world frame, (6, n)."""
        data = self._at(joints, moving=True)
        mujoco.mj_jacSite(self.model, data, self._jacobian[:3], self._jacobian[3:], self.tip_site)
        return self.driven_columns(self._jacobian)

    def shaft_line(self, joints: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Point of the shaft's axis nearest to the trocar [m] and its direction to the tip, each (3,)."""
        data = self._at(joints)
        rotation = data.xmat[self.shaft].reshape(3, 3)
        start, along = data.xpos[self.shaft] + matmul(rotation, self.shaft_point), matmul(rotation, self.shaft_axis)
        return start + matmul(self.trocar - start, along) * along, along

    def trocar_place(self, joints: ArrayLike) -> float:
        """Place of the trocar on the shaft's axis, from the shaft's point on [m]."""
        near = self.shaft_line(joints)[0]
        rotation = self._data.xmat[self.shaft].reshape(3, 3)
        start = self._data.xpos[self.shaft] + matmul(rotation, self.shaft_point)
        return float(matmul(near - start, matmul(rotation, self.shaft_axis)))

    def trocar_residual(self, joints: ArrayLike) -> float:
        """Distance of the shaft's axis from the trocar at joint values (n,) [m]."""
        return float(norm(self.trocar - self.shaft_line(joints)[0]))

    def trocar_task(self, joints: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Lateral distance of the trocar from the shaft's axis [m] (2,), and the Jacobian of the shaft there (2, n)."""
        near, along = self.shaft_line(joints)
        data = self._at(joints, moving=True)
        mujoco.mj_jac(self.model, data, self._jacobian[:3], None, near, self.shaft)
        across = np.stack(tangent_axes(along))
        return matmul(across, self.trocar - near), matmul(across, self.driven_columns(self._jacobian[:3]))

    def driven_columns(self, matrix: FloatArray) -> FloatArray:
        """Columns of the driven joints (m, n), with their followers', of a matrix for all velocities (m, nv)."""
        columns = matrix[:, self.dof]
        followers = self.followers
        for dof, driver, slope in zip(self._follower_dof, followers.driver, followers.slope, strict=True):
            columns[:, driver] += slope * matrix[:, dof]
        return columns

    def shape_ends(self, joints: ArrayLike, jaw: float = 0.0) -> FloatArray:
        """Ends of the outer shapes' axes at joint values (n,) and a jaw angle [rad], shape (n_shape, 2, 3) [m]."""
        data = self._at(joints, jaw)
        rotations = data.geom_xmat[self.shapes].reshape(-1, 3, 3)
        axis = dot(rotations, self.shape_half_axis[:, None])
        centre = data.geom_xpos[self.shapes]
        return np.stack([centre - axis, centre + axis], axis=1)

    def manipulability(self, joints: ArrayLike) -> float:
        """Yoshikawa's sqrt(det J J^T) of the tip's velocity over all joints; its unit follows from the joints'."""
        linear = self.tip_jacobian(joints)[:3]
        return float(np.sqrt(np.prod(np.maximum(eigh(matmul(linear, linear.T))[0], 0.0))))

    def write(self, data: mujoco.MjData, joints: ArrayLike, jaw: float = 0.0) -> None:
        """Write joint values (n,), their followers' and a jaw angle [rad], shared by its fingers, into `data.qpos`."""
        data.qpos[self.qpos] = joints
        data.qpos[self._follower_qpos] = self.followers.values(data.qpos[self.qpos])
        for name in self.description.jaw:
            data.qpos[self.model.joint(name).qposadr[0]] = jaw / len(self.description.jaw)

    def _at(self, joints: ArrayLike, jaw: float = 0.0, *, moving: bool = False) -> mujoco.MjData:
        self.write(self._data, joints, jaw)
        mujoco.mj_kinematics(self.model, self._data)
        if moving:
            mujoco.mj_comPos(self.model, self._data)
        return self._data


def load_arm(
    source: str | Path | ArmDescription,
    port: Port | None = None,
    *,
    tip_radius: float | None = None,
    timestep: float = 0.001,
    supports: Sequence[Support] = (),
    supports_move: bool = False,
) -> Arm:
    """Load an arm with its trocar at a port, by default at the world's origin.

    Args:
        source: a shipped arm's name, the path of a TOML file, or a description.
        port: of the arm.
        tip_radius: of the tip's ball [m]; by default the model's.
        timestep: of MuJoCo [s].
        supports: bodies in the world in contact with its tools.
        supports_move: True if these move with the organ's ground.

    Raises:
        ValueError: a wrong entry (names the arm, the entry and the remedy).
    """
    description = source if isinstance(source, ArmDescription) else read_description(source)
    port = port or Port()
    arm = Arm(description, port, compile_arm(description, port, tip_radius, timestep, supports, supports_move))
    _check_trocar(arm)
    return arm


def _check_trocar(arm: Arm) -> None:
    """Check that the shaft passes through the trocar at home, and at any joint values for a fixed remote centre."""
    trocar, name = arm.description.trocar, f"arm {arm.description.name!r}"
    residual = arm.trocar_residual(arm.home)
    if not residual <= trocar.tolerance:
        raise ValueError(
            f"{name}: at home the shaft's axis passes the trocar at {residual * 1e3:.3g} mm, more than "
            f"trocar.tolerance = {trocar.tolerance * 1e3:.3g} mm: change home, trocar.point or trocar.shaft_axis"
        )
    near, along = arm.shaft_line(arm.home)
    if matmul(arm.tip_pose(arm.home).position - near, along) <= 0.0:
        raise ValueError(
            f"{name}: at home the tip has not passed the trocar: move home further in, or turn trocar.shaft_axis, "
            "which points towards the tip"
        )
    if not trocar.fixed:
        return
    for share in np.random.default_rng(0).random((32, arm.joint_count)):
        residual = arm.trocar_residual(arm.lower + share * (arm.upper - arm.lower))
        if not residual <= trocar.tolerance:
            raise ValueError(
                f"{name}: trocar.fixed says that the mechanism keeps the shaft in the trocar, but it leaves it by "
                f"{residual * 1e3:.3g} mm within the joints' limits: use fixed = false"
            )


def _unit(vector: ArrayLike) -> FloatArray:
    values = np.asarray(vector, dtype=np.float64)
    return values / norm(values)
