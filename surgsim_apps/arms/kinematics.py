"""Batch kinematics of an arm: tip, shaft and shapes at many joint values, as arrays without state.

`Arm` asks MuJoCo about one set of joint values at a time. An evaluation needs tens of thousands: the same chain of
bodies, from the same model, is multiplied out here for all of them together; tests hold the two equal.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray, IntArray
from surgsim_env.instruments import Arm


@dataclass(frozen=True)
class Chain:
    """Positions of the parts of an arm at n sets of joint values, world frame.

    Fields:
        tip: position of the tip [m]                                    (n, 3)
        direction: unit vector out of the tip                           (n, 3)
        near, along: the shaft's point nearest to the trocar [m] and its direction to the tip       (n, 3)
        shape_ends: ends of the outer shapes' axes [m]                  (n, n_shape, 2, 3)
        axes, anchors: of the driven joints and their followers [m]     (n, n_moved, 3)
    """

    tip: FloatArray
    direction: FloatArray
    near: FloatArray
    along: FloatArray
    shape_ends: FloatArray
    axes: FloatArray
    anchors: FloatArray

    def only(self, rows: NDArray) -> "Chain":
        """Some of the sets."""
        return Chain(*(values[rows] for values in vars(self).values()))

    def moved(self, turns: FloatArray, shifts: FloatArray) -> "Chain":
        """Each set turned by a rotation (n, 3, 3), then shifted (n, 3) [m]."""

        def turned(vectors: FloatArray) -> FloatArray:
            return np.einsum("nij,n...j->n...i", turns, vectors)

        ends = turned(self.shape_ends) + shifts[:, None, None]
        tip, near, anchors = turned(self.tip) + shifts, turned(self.near) + shifts, turned(self.anchors)
        return Chain(
            tip, turned(self.direction), near, turned(self.along), ends, turned(self.axes), anchors + shifts[:, None]
        )


class BatchKinematics:
    """The kinematic chain of an arm for many sets of joint values at once.

    Fields:
        arm: the arm
        lower, upper: limits [rad or m]                     (n_joint,)
        hinge: True for a hinge, False for a slide, of the driven joints and their followers      (n_moved,)
        shaft_index: shapes of the shaft's body             (k,)
        distal: True for shapes of the shaft or beyond      (n_shape,)
        effort: largest torque or force of each joint [N m or N], inf for a model without it  (n_joint,)
    """

    def __init__(self, arm: Arm) -> None:
        """Read the constant transforms of the arm's model."""
        model = arm.model
        self.arm = arm
        self.lower, self.upper = arm.lower, arm.upper
        driven = [model.joint(name).id for name in arm.joints]
        self._joint_of = {int(joint): index for index, joint in enumerate((*driven, *arm.followers.joints))}
        self._body_rotation = [_rotation(quaternion) for quaternion in model.body_quat]
        self._tip_body = int(model.site_bodyid[arm.tip_site])
        self._tip_position = model.site_pos[arm.tip_site].copy()
        self._tip_axis = _rotation(model.site_quat[arm.tip_site]) @ arm.tip_axis
        self.trocar, self._into = arm.trocar, -arm.port.rotation[:, 2]
        self.hinge = np.array([model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE for j in self._joint_of])
        bodies = [int(model.jnt_bodyid[joint]) for joint in self._joint_of]
        self._moves_tip = np.array([body in _ancestors(model, self._tip_body) for body in bodies])
        self._moves_shaft = np.array([body in _ancestors(model, arm.shaft) for body in bodies])
        self._shape_body = model.geom_bodyid[arm.shapes]
        self._shape_local = np.zeros((len(arm.shapes), 2, 3))
        for index, geom in enumerate(arm.shapes):
            axis = _rotation(model.geom_quat[geom]) @ arm.shape_half_axis[index]
            self._shape_local[index] = model.geom_pos[geom] - axis, model.geom_pos[geom] + axis
        self.shaft_index: IntArray = np.flatnonzero(self._shape_body == arm.shaft).astype(np.int32)
        self.distal = np.array([arm.shaft in _ancestors(model, int(body)) for body in self._shape_body])
        self.effort = np.array([_effort(model, joint) for joint in driven])

    def at(self, joints: FloatArray, *, shapes: bool = True) -> Chain:
        """Tip, shaft, joint axes and (unless left out) shapes at joint values (n, n_joint)."""
        rotation, position, axes, anchors = self._bodies(joints)
        count = len(joints)
        tip = position[self._tip_body] + rotation[self._tip_body] @ self._tip_position
        shaft = self.arm.shaft
        along = rotation[shaft] @ self.arm.shaft_axis
        start = position[shaft] + rotation[shaft] @ self.arm.shaft_point
        near = start + dot(self.trocar - start, along)[:, None] * along
        ends = np.zeros((count, len(self._shape_body) if shapes else 0, 2, 3))
        for index in range(ends.shape[1]):
            body = self._shape_body[index]
            ends[:, index] = position[body][:, None] + self._shape_local[index] @ np.swapaxes(rotation[body], 1, 2)
        return Chain(tip, rotation[self._tip_body] @ self._tip_axis, near, along, ends, axes, anchors)

    def _bodies(self, joints: FloatArray) -> tuple[list[FloatArray], list[FloatArray], FloatArray, FloatArray]:
        """Rotation (n, 3, 3) and position (n, 3) of every body, axes and anchors of the joints that move."""
        model, count = self.arm.model, len(joints)
        rotation = [np.broadcast_to(np.eye(3), (count, 3, 3))]
        position = [np.zeros((count, 3))]
        axes, anchors = np.zeros((2, count, len(self._joint_of), 3))
        values = np.concatenate([joints, self.arm.followers.values(joints)], axis=1)
        for body in range(1, model.nbody):
            parent = model.body_parentid[body]
            place = position[parent] + rotation[parent] @ model.body_pos[body]
            turn = rotation[parent] @ self._body_rotation[body]
            first = model.body_jntadr[body]
            for joint in range(first, first + model.body_jntnum[body]):
                axis, anchor = turn @ model.jnt_axis[joint], place + turn @ model.jnt_pos[joint]
                index = self._joint_of.get(joint)
                if index is None:
                    continue  # a finger of the jaw, which stays closed
                axes[:, index], anchors[:, index] = axis, anchor
                value = values[:, index] - model.qpos0[model.jnt_qposadr[joint]]
                if self.hinge[index]:
                    turn = turn @ _turns(model.jnt_axis[joint], value)
                    place = anchor - turn @ model.jnt_pos[joint]
                else:
                    place = place + axis * value[:, None]
            rotation.append(turn)
            position.append(place)
        return rotation, position, axes, anchors

    def tip_jacobian(self, chain: Chain) -> tuple[FloatArray, FloatArray]:
        """From joint speeds to the tip's velocity [m/s] and angular velocity [rad/s], each (n, 3, n_joint)."""
        return self._jacobian(chain, chain.tip, self._moves_tip)

    def shaft_jacobian(self, chain: Chain) -> FloatArray:
        """From joint speeds to the velocity of the shaft's point at the trocar [m/s], (n, 3, n_joint)."""
        return self._jacobian(chain, chain.near, self._moves_shaft)[0]

    def _jacobian(self, chain: Chain, point: FloatArray, moves: np.ndarray) -> tuple[FloatArray, FloatArray]:
        turning = chain.axes * (self.hinge & moves)[:, None]
        linear = cross(turning, point[:, None] - chain.anchors) + chain.axes * (~self.hinge & moves)[:, None]
        followers, count = self.arm.followers, self.arm.joint_count
        for index, (driver, slope) in enumerate(zip(followers.driver, followers.slope, strict=True), start=count):
            linear[:, driver] += slope * linear[:, index]
            turning[:, driver] += slope * turning[:, index]
        return np.swapaxes(linear[:, :count], 1, 2), np.swapaxes(turning[:, :count], 1, 2)

    def trocar_error(self, chain: Chain) -> FloatArray:
        """Distance of the shaft from the trocar [m], (n,).

        The shaft is the half line that ends at the tip: a tip that has not passed the trocar misses it. inf where the
        shaft runs out of the body.
        """
        short = np.minimum(dot(chain.tip - chain.near, chain.along), 0.0)
        missed = np.hypot(np.linalg.norm(self.trocar - chain.near, axis=1), short)
        return np.where(chain.along @ self._into > 0.0, missed, np.inf)


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Scalar products along the last axis."""
    return np.einsum("...i,...i->...", a, b)


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Vector products along the last axis; quicker than numpy's for many short rows."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)


def _rotation(quaternion: FloatArray) -> FloatArray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def _turns(axis: FloatArray, angle: FloatArray) -> FloatArray:
    """Rotations about an axis (3,) by angles (n,) [rad]: I + sin K + (1 - cos) K^2 (Rodrigues), (n, 3, 3)."""
    x, y, z = axis / np.linalg.norm(axis)
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle)[:, None, None] * skew + (1.0 - np.cos(angle))[:, None, None] * (skew @ skew)


def _ancestors(model: mujoco.MjModel, body: int) -> set[int]:
    """A body and all bodies between it and the world."""
    bodies = {body}
    while body:
        body = int(model.body_parentid[body])
        bodies.add(body)
    return bodies


def _effort(model: mujoco.MjModel, joint: int) -> float:
    """Largest torque [N m] or force [N] of a joint: its own limit, else its actuators' together, else inf."""
    if model.jnt_actfrclimited[joint]:
        return float(np.abs(model.jnt_actfrcrange[joint]).min())
    driven = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_trnid[:, 0] == joint)
    limited = driven & (model.actuator_forcelimited != 0)
    if not limited.any():
        return float("inf")
    force = np.abs(model.actuator_forcerange[limited]).min(axis=1) * np.abs(model.actuator_gear[limited, 0])
    return float(force.sum())
