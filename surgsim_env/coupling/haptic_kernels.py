"""The haptic steps of one control step, of one organ or of several side by side, MuJoCo's steps included.

The compiled loops do not hold the interpreter's lock. The text of `advance_haptic_steps` runs in Python too, as
`advance_haptic_steps.py_func`: the same calls in the same order, equal to the bit (`tests/coupling`). Before compiled
code runs, MuJoCo's C functions must be known to the linker (`mujoco_library`).
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numba.extending import overload, register_jitable
from numpy.typing import NDArray

from msdm_core.kernels.lane_view_kernels import response_of, shapes_of
from msdm_core.kernels.option_kernels import JITABLE, KERNEL
from msdm_core.kernels.structure_kernels import FAULT_NONE, LANE_EMPTY
from msdm_core.kernels.substep_kernels import advance_inside, advance_substeps
from surgsim_env.coupling.motion_kernels import steer_motion
from surgsim_env.instruments.mujoco_kernels import mj_step1, mj_step2
from surgsim_env.instruments.tool_kernels import drive_servo, read_response, read_shapes

FloatArray = NDArray[np.float64]

# No palpation comes near this: a force beyond it [N] is a fault of the simulation, not a touch.
FORCE_CAP = 100.0
# Beside those of `msdm_core.kernels.structure_kernels`.
FAULT_WRENCH_NOT_FINITE = 101
FAULT_FORCE_CAP = 102


class StepPlan(NamedTuple):
    """Settings of the haptic steps of one call.

    Fields:
        dt: duration of a substep [s]
        decay: exp(-alpha dt), the mass-proportional damping of a substep
        substep_count: substeps in a haptic step
        step_count: haptic steps
        force_limit: a step whose `total_force` is beyond this is the last [N]
        pull_limit: a step whose `pull_force` is beyond this is the last [N]
    """

    dt: float
    decay: float
    substep_count: int
    step_count: int
    force_limit: float
    pull_limit: float


class StepOutcome(NamedTuple):
    """Results of haptic steps, lane by lane; one organ alone is one lane.

    Fields:
        wrench: of the last good step [N, N m]                                   (n_lane, n_tool, 6)
        mean: of the last step, also where it showed a fault [N, N m]            (n_lane, n_tool, 6)
        reference: scratch: centres of mass at the start of a step [m]           (n_lane, n_tool, 3)
        stopped: FAULT_NONE where a lane moves; of `LaneState.lane_fault`        (n_lane,)
        step_count: number of finished steps                                     (n_lane,)
        fault: a FAULT_ code                                                     (n_lane,)
        force_peak: largest `total_force` [N]                                    (n_lane,)
        pull_peak: largest `pull_force` [N]                                      (n_lane,)
    """

    wrench: FloatArray
    mean: FloatArray
    reference: FloatArray
    stopped: NDArray[np.int32]
    step_count: NDArray[np.int64]
    fault: NDArray[np.int64]
    force_peak: FloatArray
    pull_peak: FloatArray


def _advance_organs(*given):
    """`advance_substeps` in Python; in a kernel `advance_inside`, which is compiled as a part of that kernel alone."""
    return advance_substeps(*given)


@overload(_advance_organs, jit_options=JITABLE)
def _(*given):
    return lambda *given: advance_inside(*given)


@register_jitable(**JITABLE)
def begin_step(tools, drive, shapes, response, motion, reference):
    """A haptic step up to the organ's substeps: mj_step1, the servo, what the organ sees of the tools, its motions.

    In:  drive: of the motions
    Out: shapes, response, motion: of the organ's state, reference: centres of mass, about which the step's torques are
         taken [m] (n_tool, 3)
    """
    steer_motion(drive, motion)
    mj_step1(tools.model, tools.data)
    drive_servo(tools)
    read_shapes(tools, shapes)
    read_response(tools, response)
    for tool in range(reference.shape[0]):
        for axis in range(3):
            reference[tool, axis] = shapes.tool_centre[tool, axis]


@njit(**KERNEL)
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


@njit(**KERNEL)
def total_force(wrench):
    """Size of the sum of the forces on all tools [N]; wrench (n_tool, 6) [N, N m]."""
    x, y, z = 0.0, 0.0, 0.0
    for tool in range(wrench.shape[0]):
        x += wrench[tool, 0]
        y += wrench[tool, 1]
        z += wrench[tool, 2]
    return math.sqrt(x * x + y * y + z * z)


@njit(**KERNEL)
def pull_force(jaws, wrench):
    """Largest size of the sum of the forces on the two fingers of a jaw [N], over all jaws (n_jaw, 2)."""
    largest = 0.0
    for jaw in range(jaws.shape[0]):
        first, second = jaws[jaw, 0], jaws[jaw, 1]
        x, y, z = (
            wrench[first, 0] + wrench[second, 0],
            wrench[first, 1] + wrench[second, 1],
            wrench[first, 2] + wrench[second, 2],
        )
        largest = max(largest, math.sqrt(x * x + y * y + z * z))
    return largest


@register_jitable(**JITABLE)
def clear_outcome(outcome, lane):
    """Forget the last call's steps of a lane."""
    outcome.step_count[lane] = 0
    outcome.fault[lane] = FAULT_NONE
    outcome.force_peak[lane] = 0.0
    outcome.pull_peak[lane] = 0.0


@register_jitable(**JITABLE)
def end_step(tools, fault, plan, outcome, lane):
    """The rest of a haptic step: check the mean wrench, apply it to the tools, mj_step2, compare forces with limits.

    In:  fault: a FAULT_ code of the organ, plan, outcome.mean[lane]: the tissue's mean wrench on each tool
    Out: outcome: all else of the lane; `stopped` is LANE_EMPTY after a fault or beyond a limit
    With a fault MuJoCo stays where it is, and `outcome.wrench` is that of the last good step.
    """
    mean, wrench = outcome.mean[lane], outcome.wrench[lane]
    if fault == FAULT_NONE:
        fault = check_wrench(mean)
    if fault != FAULT_NONE:
        outcome.fault[lane] = fault
        outcome.stopped[lane] = LANE_EMPTY
        return
    for tool in range(tools.bodies.shape[0]):
        for part in range(6):
            tools.applied_wrench[tools.bodies[tool], part] = mean[tool, part]
            wrench[tool, part] = mean[tool, part]
    mj_step2(tools.model, tools.data)
    force_peak = max(outcome.force_peak[lane], total_force(wrench))
    pull_peak = max(outcome.pull_peak[lane], pull_force(tools.jaws, wrench))
    outcome.step_count[lane] += 1
    outcome.force_peak[lane] = force_peak
    outcome.pull_peak[lane] = pull_peak
    if force_peak > plan.force_limit or pull_peak > plan.pull_limit:
        outcome.stopped[lane] = LANE_EMPTY


@njit(**KERNEL)
def advance_haptic_steps(model, state, law, shapes, response, tools, drive, plan, outcome):
    """Advance an organ and its tools by `plan.step_count` haptic steps, fewer at a fault or beyond a limit.

    Model: model, law
    In:    plan
    Out:   state, shapes, response, tools, drive, outcome: of one lane
    """
    reference, mean = outcome.reference[0], outcome.mean[0]
    clear_outcome(outcome, 0)
    for _ in range(plan.step_count):
        begin_step(tools, drive, shapes, response, state.motion, reference)
        fault = _advance_organs(
            model, state, shapes, law, response, plan.dt, plan.decay, plan.substep_count, reference, mean
        )
        end_step(tools, fault, plan, outcome, 0)
        if outcome.stopped[0] != FAULT_NONE:
            return


@njit(**KERNEL)
def advance_lane_haptic_steps(model, state, law, shapes, response, tools, drives, plan, outcome):
    """Advance organs side by side and their tools by `plan.step_count` haptic steps; a lane that ends early stops.

    Model: model, law
    In:    plan, tools, drives: one ToolViews and one MotionDrive a lane
    Out:   state, shapes, response, tools, outcome, whose `stopped` is `state.lane_fault`
    """
    stopped = outcome.stopped
    for lane in range(len(tools)):
        clear_outcome(outcome, lane)
    for _ in range(plan.step_count):
        for lane in range(len(tools)):
            if stopped[lane] == FAULT_NONE:
                begin_step(
                    tools[lane],
                    drives[lane],
                    shapes_of(model.lanes, shapes, lane),
                    response_of(model.lanes, response, lane),
                    state.motion[lane],
                    outcome.reference[lane],
                )
        _advance_organs(
            model, state, shapes, law, response, plan.dt, plan.decay, plan.substep_count, outcome.reference,
            outcome.mean,
        )  # fmt: skip
        running = False
        for lane in range(len(tools)):
            if stopped[lane] != LANE_EMPTY:
                end_step(tools[lane], stopped[lane], plan, outcome, lane)
                running = running or stopped[lane] == FAULT_NONE
        if not running:
            return
