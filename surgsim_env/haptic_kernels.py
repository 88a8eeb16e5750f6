"""The haptic steps of one control step in one compiled call, MuJoCo's included, without the interpreter and its lock.

`exchange.haptic_step` in a loop is the readable reference: the same calls in the same order, equal to the bit
(`tests/coupling/test_compiled_step.py`). MuJoCo's C functions are called by name and must be known to the linker first:
`mujoco_library` sees to that, and whoever calls `advance_haptic_steps`, `begin_step` or `end_step` asks it before.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from msdm_core.kernels import FAULT_NONE, advance_substeps

FloatArray = NDArray[np.float64]

# No palpation comes near this: a force beyond it [N] is a fault of the simulation, not a touch.
FORCE_CAP = 100.0
# Beside those of `msdm_core.kernels`.
FAULT_WRENCH_NOT_FINITE = 101
FAULT_FORCE_CAP = 102

OBJECT_BODY = 1  # mjOBJ_BODY

_address, _index, _nothing = types.uintp, types.int32, types.void
_mj_step1 = types.ExternalFunction("mj_step1", _nothing(_address, _address))
_mj_step2 = types.ExternalFunction("mj_step2", _nothing(_address, _address))
_mj_actuation = types.ExternalFunction("mj_fwdActuation", _nothing(_address, _address))
_mj_acceleration = types.ExternalFunction("mj_fwdAcceleration", _nothing(_address, _address))
_mj_inertia = types.ExternalFunction("mj_fullM", _nothing(_address, _address, _address))
_mj_jacobian = types.ExternalFunction("mj_jacBodyCom", _nothing(_address, _address, _address, _address, _index))
_mj_velocity = types.ExternalFunction(
    "mj_objectVelocity", _nothing(_address, _address, _index, _index, _address, _index)
)
MUJOCO_FUNCTIONS = tuple(
    function.symbol
    for function in (_mj_step1, _mj_step2, _mj_actuation, _mj_acceleration, _mj_inertia, _mj_jacobian, _mj_velocity)
)


class Servo(NamedTuple):
    """What drives an instrument's joints, slides or hinges: position targets that move on at the commanded speeds.

    Fields:
        command: speed asked for [m/s or rad/s]                                  (n_joint,)
        lower, upper: the workspace, or the joints' limits [m or rad]            (n_joint,)
        position: which of MuJoCo's controls are the positions                   (n_joint,)
        speed: which are the speeds; -1 where a joint has none                   (n_joint,)
        limited: which joints the last step stopped at their limits              (n_joint,)
    """

    command: FloatArray
    lower: FloatArray
    upper: FloatArray
    position: NDArray[np.int64]
    speed: NDArray[np.int64]
    limited: NDArray[np.bool_]


class ToolViews(NamedTuple):
    """The tools of one MuJoCo model and data: addresses, views of MuJoCo's own arrays, and room to work in.

    Made for each call (`ToolBodies.views`), so that it never outlives or misses its data.

    Fields:
        model, data: addresses of mjModel and mjData
        timestep: [s]                                                            scalar
        geoms: contact shapes                                                    (n_shape,)
        axis, half_length: which axis of the geom the core lies along, its half length [m]  (n_shape,), (n_shape,)
        across, half_width: which axis of the geom a rounded box spans, its half width [m]  (n_shape,), (n_shape,)
        bodies: the tools                                                        (n_tool,)
        joint_damping: [N s/m, N m s]                                            (nv,)
        brake: what MuJoCo takes implicitly beside it, velocity servos and tendons  (nv, nv)
        geom_position, geom_rotation: of all geoms, world frame [m]              (n_geom, 3), (n_geom, 9)
        body_centre: centres of mass [m]                                         (n_body, 3)
        smooth_force: on the joints, without constraints [N, N m]                (nv,)
        applied_wrench: xfrc_applied [N, N m]                                    (n_body, 6)
        control: of all actuators                                                (nu,)
        servo: what moves the controls
        jaws: the two fingers of each jaw, as tools                              (n_jaw, 2)
        velocity, jacobians, inertia, yielded: scratch             (6,), (n_tool, 6, nv), (nv, nv), (nv, 6)
        reference, wrench: scratch: the step's first tool_centre [m], its mean wrench   (n_tool, 3), (n_tool, 6)
    """

    model: int
    data: int
    timestep: float
    geoms: NDArray[np.int64]
    axis: NDArray[np.int64]
    half_length: FloatArray
    across: NDArray[np.int64]
    half_width: FloatArray
    bodies: NDArray[np.int32]
    joint_damping: FloatArray
    brake: FloatArray
    geom_position: FloatArray
    geom_rotation: FloatArray
    body_centre: FloatArray
    smooth_force: FloatArray
    applied_wrench: FloatArray
    control: FloatArray
    servo: Servo
    jaws: NDArray[np.int32]
    velocity: FloatArray
    jacobians: FloatArray
    inertia: FloatArray
    yielded: FloatArray
    reference: FloatArray
    wrench: FloatArray


@njit(cache=True, nogil=True, error_model="numpy")
def factorise(matrix):
    """A = L D L^T in place: D on the diagonal, L below it; A (n, n) symmetric and positive definite."""
    for column in range(matrix.shape[0]):
        for row in range(column, matrix.shape[0]):
            value = matrix[row, column]
            for k in range(column):
                value -= matrix[row, k] * matrix[column, k] * matrix[k, k]
            matrix[row, column] = value if row == column else value / matrix[column, column]


@njit(cache=True, nogil=True, error_model="numpy")
def yield_tool(factors, jacobians, tool, smooth_force, yielded, mobility, acceleration):
    """How all tools i yield to a wrench on one, t: mobility[i, t] = J_i A^-1 J_t^T; A^-1 J_t^T into yielded (nv, 6).

    And how that one moves on without any: acceleration[t] = J_t A^-1 q. Tools of one arm share its joints: two fingers
    that tissue pushes apart leave the wrist where it is, and a response of each to its own wrench alone would not.
    `factors` is A after `factorise`, `jacobians` are all tools' (n_tool, 6, nv). Both the compiled and the plain loop
    call this: a library's solver rounds its own way.
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


@njit(cache=True, nogil=True, error_model="numpy")
def _drive(tools):
    """`ToolBodies.drive`: the servo's targets move on by one step and stop at their limits."""
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


@njit(cache=True, nogil=True, error_model="numpy")
def _read_shapes(tools, shapes):
    """`ToolBodies.read_shapes`: pose and twist of every contact shape; MuJoCo gives angular before linear."""
    for shape in range(tools.geoms.shape[0]):
        geom = tools.geoms[shape]
        along, across = tools.axis[shape], tools.across[shape]
        for axis in range(3):
            offset = tools.geom_rotation[geom, 3 * axis + along] * tools.half_length[shape]
            shapes.shape_ends[shape, 0, axis] = tools.geom_position[geom, axis] - offset
            shapes.shape_ends[shape, 1, axis] = tools.geom_position[geom, axis] + offset
            shapes.shape_span[shape, axis] = tools.geom_rotation[geom, 3 * axis + across] * tools.half_width[shape]
    for tool in range(tools.bodies.shape[0]):
        body = tools.bodies[tool]
        _mj_velocity(
            tools.model, tools.data, np.int32(OBJECT_BODY), np.int32(body), tools.velocity.ctypes.data, np.int32(0)
        )
        for axis in range(3):
            shapes.tool_centre[tool, axis] = tools.body_centre[body, axis]
            shapes.tool_twist[tool, axis] = tools.velocity[3 + axis]
            shapes.tool_twist[tool, 3 + axis] = tools.velocity[axis]


@njit(cache=True, nogil=True, error_model="numpy")
def _read_response(tools, response):
    """`ToolBodies.read_response`: how the tools move on without the tissue, and yield to it."""
    for tool in range(tools.bodies.shape[0]):
        tools.applied_wrench[tools.bodies[tool], :] = 0.0
    _mj_actuation(tools.model, tools.data)
    _mj_acceleration(tools.model, tools.data)
    inertia, jacobians = tools.inertia, tools.jacobians
    _mj_inertia(tools.model, tools.data, inertia.ctypes.data)
    for joint in range(inertia.shape[0]):
        inertia[joint, joint] += tools.timestep * tools.joint_damping[joint]
        for other in range(inertia.shape[0]):
            inertia[joint, other] += tools.timestep * tools.brake[joint, other]
    factorise(inertia)
    for tool in range(tools.bodies.shape[0]):
        linear = jacobians[tool].ctypes.data
        angular = jacobians[tool, 3:].ctypes.data
        _mj_jacobian(tools.model, tools.data, linear, angular, np.int32(tools.bodies[tool]))
    for tool in range(tools.bodies.shape[0]):
        yield_tool(
            inertia, jacobians, tool, tools.smooth_force, tools.yielded, response.tool_mobility,
            response.tool_acceleration,
        )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def begin_step(tools, shapes, response):
    """A haptic step up to the organ's substeps: mj_step1, the servo, what the organ sees of the tools."""
    _mj_step1(tools.model, tools.data)
    _drive(tools)
    _read_shapes(tools, shapes)
    _read_response(tools, response)
    for tool in range(tools.bodies.shape[0]):
        for axis in range(3):
            tools.reference[tool, axis] = shapes.tool_centre[tool, axis]


@njit(cache=True, nogil=True, error_model="numpy")
def check_wrench(wrench):
    """The FAULT_ code of the tissue's mean wrench on each tool, (n_tool, 6)."""
    fault = FAULT_NONE
    for tool in range(wrench.shape[0]):
        for part in range(6):
            if not math.isfinite(wrench[tool, part]):
                return FAULT_WRENCH_NOT_FINITE
        x, y, z = wrench[tool, 0], wrench[tool, 1], wrench[tool, 2]
        if math.sqrt(x * x + y * y + z * z) > FORCE_CAP:
            fault = FAULT_FORCE_CAP
    return fault


@njit(cache=True, nogil=True, error_model="numpy")
def end_step(tools, wrench):
    """The rest of a haptic step: `tools.wrench` is checked, acts on the tools in mj_step2, and is kept in `wrench`.

    Returns a FAULT_ code; with a fault MuJoCo stays where it is and `wrench` is that of the last good step.
    """
    fault = check_wrench(tools.wrench)
    if fault != FAULT_NONE:
        return fault
    for tool in range(tools.bodies.shape[0]):
        for part in range(6):
            tools.applied_wrench[tools.bodies[tool], part] = tools.wrench[tool, part]
    _mj_step2(tools.model, tools.data)
    wrench[:, :] = tools.wrench
    return fault


@njit(cache=True, nogil=True, error_model="numpy")
def total_force(wrench):
    """Size of the sum of the forces on all tools [N]."""
    x, y, z = 0.0, 0.0, 0.0
    for tool in range(wrench.shape[0]):
        x += wrench[tool, 0]
        y += wrench[tool, 1]
        z += wrench[tool, 2]
    return math.sqrt(x * x + y * y + z * z)


@njit(cache=True, nogil=True, error_model="numpy")
def pull_force(jaws, wrench):
    """Largest size of the sum of the forces on the two fingers of a jaw, over all jaws (n_jaw, 2) [N]."""
    largest = 0.0
    for jaw in range(jaws.shape[0]):
        one, other = jaws[jaw, 0], jaws[jaw, 1]
        x, y, z = (
            wrench[one, 0] + wrench[other, 0],
            wrench[one, 1] + wrench[other, 1],
            wrench[one, 2] + wrench[other, 2],
        )
        largest = max(largest, math.sqrt(x * x + y * y + z * z))
    return largest


@njit(cache=True, nogil=True, error_model="numpy")
def advance_haptic_steps(
    model, state, law, shapes, response, tools, dt, decay, substep_count, wrench, count, force_limit, pull_limit
):
    """Advance an organ and its tools by `count` haptic steps, fewer where there is a fault or too much force.

    Model: model, law
    In:    dt [s] of a substep, decay = exp(-alpha dt), substep_count, count; beyond force_limit or pull_limit [N] a
           step is the last
    Out:   state, shapes, response, tools, wrench: of the last good haptic step (n_tool, 6)
    Returns how many steps were finished, a FAULT_ code and the largest `total_force` and `pull_force` [N].
    """
    peak, pull_peak = 0.0, 0.0
    for step in range(count):
        begin_step(tools, shapes, response)
        fault = advance_substeps(
            model, state, shapes, law, response, dt, decay, substep_count, tools.reference, tools.wrench
        )
        if fault == FAULT_NONE:
            fault = end_step(tools, wrench)
        if fault != FAULT_NONE:
            return step, fault, peak, pull_peak
        force = total_force(wrench)
        if force > peak:
            peak = force
        pull_peak = max(pull_peak, pull_force(tools.jaws, wrench))
        if peak > force_limit or pull_peak > pull_limit:
            return step + 1, FAULT_NONE, peak, pull_peak
    return count, FAULT_NONE, peak, pull_peak
