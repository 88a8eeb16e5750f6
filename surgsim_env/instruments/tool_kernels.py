"""Tools of a MuJoCo model: servo, poses and response to wrenches, in Python and compiled.

A function with calls of MuJoCo (`mujoco_kernels`) is plain Python when called from Python, and compiled within a
compiled function. The text is the same, so the bits are too.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numba.extending import register_jitable
from numpy.typing import NDArray

from msdm_core.kernels.option_kernels import JITABLE, KERNEL
from surgsim_env.instruments.mujoco_kernels import (
    OBJECT_BODY,
    mj_fullM,
    mj_fwdAcceleration,
    mj_fwdActuation,
    mj_jacBodyCom,
    mj_objectVelocity,
)

FloatArray = NDArray[np.float64]


class Servo(NamedTuple):
    """Servo of an instrument's joints, slides or hinges: position targets moving at commanded speeds.

    Fields:
        command: speed [m/s or rad/s]                                            (n_joint,)
        lower, upper: the workspace, or the joints' limits [m or rad]            (n_joint,)
        position: indices of the positions among MuJoCo's controls               (n_joint,)
        speed: indices of the speeds; -1 for a joint without one                 (n_joint,)
        limited: True for joints stopped at a limit in the last step             (n_joint,)
    """

    command: FloatArray
    lower: FloatArray
    upper: FloatArray
    position: NDArray[np.int64]
    speed: NDArray[np.int64]
    limited: NDArray[np.bool_]


class ToolViews(NamedTuple):
    """Tools of one MuJoCo model and data: views of MuJoCo's own arrays, and scratch arrays.

    Get them for each call (`ToolBodies.views`): `data` may be replaced.

    Fields:
        model, data: MjModel and MjData; their addresses for compiled code
        timestep: [s]                                                            scalar
        geoms: contact shapes                                                    (n_shape,)
        axis, half_length: the geom's axis along the core, and half length [m]   (n_shape,), (n_shape,)
        across, half_width: the geom's axis across a rounded box, half width [m] (n_shape,), (n_shape,)
        bodies: the tools                                                        (n_tool,)
        joint_damping: [N s/m, N m s]                                            (nv,)
        implicit_damping: MuJoCo's further damping of velocity servos and tendons (nv, nv)
        geom_position, geom_rotation: of all geoms, world frame [m]              (n_geom, 3), (n_geom, 9)
        body_centre: centres of mass [m]                                         (n_body, 3)
        smooth_force: on the joints, without constraints [N, N m]                (nv,)
        applied_wrench: xfrc_applied [N, N m]                                    (n_body, 6)
        control: of all actuators                                                (nu,)
        servo: of the controls
        jaws: the two fingers of each jaw, as tools                              (n_jaw, 2)
        patch_local: patches of taxels: middle [m], unit vectors along a row and along a column over the pitch [1/m],
            in the frame of their geom                                           (n_patch, 3, 3)
        velocity, jacobians, inertia, yielded: scratch             (6,), (n_tool, 6, nv), (nv, nv), (nv, 6)
    """

    model: Any
    data: Any
    timestep: float
    geoms: NDArray[np.int64]
    axis: NDArray[np.int64]
    half_length: FloatArray
    across: NDArray[np.int64]
    half_width: FloatArray
    bodies: NDArray[np.int32]
    joint_damping: FloatArray
    implicit_damping: FloatArray
    geom_position: FloatArray
    geom_rotation: FloatArray
    body_centre: FloatArray
    smooth_force: FloatArray
    applied_wrench: FloatArray
    control: FloatArray
    servo: Servo
    jaws: NDArray[np.int32]
    patch_local: FloatArray
    velocity: FloatArray
    jacobians: FloatArray
    inertia: FloatArray
    yielded: FloatArray


@njit(**KERNEL)
def factorise(matrix):
    """A = L D L^T in place: D on the diagonal, L below it; A (n, n) symmetric and positive definite."""
    for column in range(matrix.shape[0]):
        for row in range(column, matrix.shape[0]):
            value = matrix[row, column]
            for k in range(column):
                value -= matrix[row, k] * matrix[column, k] * matrix[k, k]
            matrix[row, column] = value if row == column else value / matrix[column, column]


@njit(**KERNEL)
def tool_mobility(factors, jacobians, tool, smooth_force, yielded, mobility, acceleration):
    """Column t of the tool mobility matrix, mobility[i, t] = J_i A^-1 J_t^T, and acceleration[t] = J_t A^-1 q.

    In:      A = `factors` after `factorise` (nv, nv), `jacobians` of all tools (n_tool, 6, nv), t = `tool`,
             q = `smooth_force`, joint forces but the tissue's [N, N m] (nv,)
    Out:     mobility (n_tool, n_tool, 6, 6) [1/kg, ...], acceleration (n_tool, 6) [m/s^2, rad/s^2]
    Scratch: yielded = A^-1 J_t^T (nv, 6)

    Tools of one arm share its joints: two fingers pushed apart by tissue leave the wrist in place, unlike with a
    response of each to its own wrench alone. The plain Python loop calls this too, because a library's
    solver rounds differently.
    """
    count = factors.shape[0]
    jacobian = jacobians[tool]
    for part in range(6):
        for row in range(count):
            value = jacobian[part, row]
            for k in range(row):
                value -= factors[row, k] * yielded[k, part]
            yielded[row, part] = value
        for row in range(count - 1, -1, -1):
            value = yielded[row, part] / factors[row, row]
            for k in range(row + 1, count):
                value -= factors[k, row] * yielded[k, part]
            yielded[row, part] = value
    for part in range(6):
        rate = 0.0
        for k in range(count):
            rate += smooth_force[k] * yielded[k, part]
        acceleration[tool, part] = rate
    for other in range(jacobians.shape[0]):
        for part in range(6):
            for row in range(6):
                value = 0.0
                for k in range(count):
                    value += jacobians[other, row, k] * yielded[k, part]
                mobility[other, tool, row, part] = value


@register_jitable(**JITABLE)
def drive_servo(tools):
    """Move the servo's targets by one step at the commanded speeds; they stop at their limits.

    In:  tools.servo.command [m/s or rad/s], its limits [m or rad], tools.timestep [s]
    Out: tools.control, tools.servo.limited
    """
    servo, control = tools.servo, tools.control
    for joint in range(servo.command.shape[0]):
        place, pace = servo.position[joint], servo.speed[joint]
        target = control[place] + servo.command[joint] * tools.timestep
        held = target
        if held < servo.lower[joint]:
            held = servo.lower[joint]
        if held > servo.upper[joint]:
            held = servo.upper[joint]
        control[place] = held
        servo.limited[joint] = held != target
        if pace >= 0:
            control[pace] = 0.0 if held != target else servo.command[joint]


@register_jitable(**JITABLE)
def read_shapes(tools, shapes):
    """Read pose and twist of each contact shape in the current step; call after mj_step1.

    Out: shapes.shape_ends, shape_span, patch_frame, tool_centre [m], tool_twist [m/s, rad/s]; MuJoCo gives angular
         before linear
    """
    for shape in range(tools.geoms.shape[0]):
        geom = tools.geoms[shape]
        along, across = tools.axis[shape], tools.across[shape]
        for axis in range(3):
            offset = tools.geom_rotation[geom, 3 * axis + along] * tools.half_length[shape]
            shapes.shape_ends[shape, 0, axis] = tools.geom_position[geom, axis] - offset
            shapes.shape_ends[shape, 1, axis] = tools.geom_position[geom, axis] + offset
            shapes.shape_span[shape, axis] = tools.geom_rotation[geom, 3 * axis + across] * tools.half_width[shape]
    for patch in range(tools.patch_local.shape[0]):
        shape = shapes.patch_layout[patch, 0]
        geom = tools.geoms[shape]
        for row in range(3):
            for axis in range(3):
                value = 0.0
                for part in range(3):
                    value += tools.geom_rotation[geom, 3 * axis + part] * tools.patch_local[patch, row, part]
                shapes.patch_frame[patch, row, axis] = value
        for axis in range(3):
            shapes.patch_frame[patch, 0, axis] += tools.geom_position[geom, axis] - shapes.shape_ends[shape, 0, axis]
    for tool in range(tools.bodies.shape[0]):
        body = tools.bodies[tool]
        mj_objectVelocity(tools.model, tools.data, OBJECT_BODY, body, tools.velocity, 0)
        for axis in range(3):
            shapes.tool_centre[tool, axis] = tools.body_centre[body, axis]
            shapes.tool_twist[tool, axis] = tools.velocity[3 + axis]
            shapes.tool_twist[tool, 3 + axis] = tools.velocity[axis]


@register_jitable(**JITABLE)
def read_inertia(tools, dt):
    """Read M + dt D: joint-space inertia with armature, and the joints' damping D over dt [s].

    Out: tools.inertia (nv, nv)
    """
    inertia = tools.inertia
    mj_fullM(tools.model, tools.data, inertia)
    for joint in range(inertia.shape[0]):
        inertia[joint, joint] += dt * tools.joint_damping[joint]


@register_jitable(**JITABLE)
def read_jacobian(tools, tool):
    """Read the Jacobian from joint velocities to a tool's twist at its centre of mass.

    Out: tools.jacobians[tool] (6, nv)
    """
    jacobian = tools.jacobians[tool]
    mj_jacBodyCom(tools.model, tools.data, jacobian[:3], jacobian[3:], tools.bodies[tool])


@register_jitable(**JITABLE)
def read_response(tools, response):
    """Read the tools' acceleration without tissue and their mobility; call after `drive_servo`.

    With the inertia M, the implicit damping D of MuJoCo's integrator (of the joints, and
    `tools.implicit_damping`) and the sum q of all forces but the tissue's, wrenches w_j on the tools j change the twist
    of tool i at the rate J_i (M + dt D)^-1 (q + sum_j J_j^T w_j). J are the tools' Jacobians: tools of one arm share
    its joints. Centripetal terms are left out, and MuJoCo's own contacts, which it counts at the step's end.

    Out:     response.tool_acceleration, tool_mobility
    Scratch: tools.inertia, jacobians, yielded; tools.applied_wrench is set to 0
    """
    for tool in range(tools.bodies.shape[0]):
        tools.applied_wrench[tools.bodies[tool], :] = 0.0
    mj_fwdActuation(tools.model, tools.data)
    mj_fwdAcceleration(tools.model, tools.data)
    read_inertia(tools, tools.timestep)
    inertia = tools.inertia
    for joint in range(inertia.shape[0]):
        for other in range(inertia.shape[0]):
            inertia[joint, other] += tools.timestep * tools.implicit_damping[joint, other]
    factorise(inertia)
    for tool in range(tools.bodies.shape[0]):
        read_jacobian(tools, tool)
    for tool in range(tools.bodies.shape[0]):
        tool_mobility(
            inertia, tools.jacobians, tool, tools.smooth_force, tools.yielded, response.tool_mobility,
            response.tool_acceleration,
        )  # fmt: skip
