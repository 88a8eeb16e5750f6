"""The force exchange between organ and instrument: haptic steps in one call, compiled or in Python."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from msdm_core.arithmetic import exp
from msdm_core.kernels.structure_kernels import FAULT_NONE, ContactLaw, OrganModel, OrganState
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.stepping import describe_fault
from surgsim_env.coupling import mujoco_library
from surgsim_env.coupling.haptic_kernels import (
    FAULT_FORCE_CAP,
    FAULT_WRENCH_NOT_FINITE,
    FORCE_CAP,
    StepOutcome,
    StepPlan,
    advance_haptic_steps,
)
from surgsim_env.coupling.motion import still
from surgsim_env.instruments.tool_bodies import ToolBodies


class StepsTaken(NamedTuple):
    """The result of some haptic steps.

    Fields:
        step_count: number of finished steps
        force_peak: their largest total force [N]
        fault: description of the fault that ended them, or ""
        pull_peak: the largest pull of a jaw, the size of the sum of its fingers' forces [N]
        ended: whether a fault or a limit ended them
    """

    step_count: int
    force_peak: float
    fault: str
    pull_peak: float = 0.0
    ended: bool = False


def haptic_steps(
    model: OrganModel,
    state: OrganState,
    instrument: ToolBodies,
    contact: ContactLaw,
    dt: float,
    substep_count: int,
    wrench: FloatArray,
    count: int = 1,
    *,
    compiled: bool = False,
) -> StepsTaken:
    """Advance organ and instrument together by up to `count` haptic steps of `substep_count` substeps of dt [s].

    `wrench` (n_tool, 6) [N, N m] receives the mean wrench of the tissue in the last good step. Compiled, all is one
    call without the interpreter's lock, equal to the bit.

    The instrument's shapes are read from the current step (mj_step1) and move along their twist through the organ's
    substeps. The MEAN wrench of the tissue, with its torque about each tool's centre of mass at the start of the step,
    acts on the tool in mj_step2: the organ's change of momentum is exactly minus that wrench times the step.

    Within the step the twist responds to each substep's wrench at the rate J (M + dt D)^-1 (q + J^T w), as MuJoCo's
    does to their mean, and therefore ends equal to MuJoCo's. MuJoCo then moves the tool by dt v_end, which is ahead of
    the shapes that the organ saw by delta = (dt^2 / m) int_0^1 s F(s dt) ds, where F is the total force on the tool.
    This displacement takes the energy F(dt) . delta: at frequency w its mean is
    |F|^2 dt^2 / (2 m) (1 - cos w dt) / (w dt)^2, never negative. The exchange therefore dissipates, except for
    k delta^2 / 2, which the minimum mass in `tool_bodies` keeps small. With a constant twist delta would be dt^2 / m
    times the mean force, out of phase with F(dt): tissue vibrating above about 370 Hz under the tool would gain energy
    until damping balances it.

    Raises:
        RuntimeError: compiled, where MuJoCo's functions are not known to the linker (says why).
    """
    advance, tools = haptic_loop(compiled=compiled), instrument.views(compiled=compiled)
    plan = step_plan(model.alpha, dt, substep_count, count)
    outcome = step_outcome(1, instrument.tool_count)._replace(wrench=wrench[None])
    drive = still(dt * substep_count)
    advance(model, state, contact, instrument.shapes, instrument.response, tools, drive, plan, outcome)
    return steps_taken(model, state, outcome, 0)


def haptic_loop(*, compiled: bool) -> Callable[..., Any]:
    """`advance_haptic_steps`, compiled or in Python.

    Raises:
        RuntimeError: compiled, where MuJoCo's functions are not known to the linker (says why).
    """
    if not compiled:
        return advance_haptic_steps.py_func
    if missing := mujoco_library.missing():
        raise RuntimeError(f"haptic steps cannot be compiled: {missing}; run them with compiled=False")
    return advance_haptic_steps


def step_plan(
    alpha: float,
    dt: float,
    substep_count: int,
    count: int,
    force_limit: float = math.inf,
    pull_limit: float = math.inf,
) -> StepPlan:
    """The plan of `count` haptic steps of `substep_count` substeps of dt [s].

    Args:
        alpha: mass-proportional damping rate of the organ [1/s].
        dt: [s].
        substep_count: in each haptic step.
        count: number of haptic steps.
        force_limit: the step whose total force of the tissue exceeds it is the last [N].
        pull_limit: the same for the pull of a jaw [N].
    """
    return StepPlan(dt, float(exp(-alpha * dt)), substep_count, count, force_limit, pull_limit)


def step_outcome(lanes: int, tool_count: int) -> StepOutcome:
    """An empty outcome for a number of lanes and of tools in each; no lane is stopped."""
    wrench, mean = np.zeros((2, lanes, tool_count, 6))
    count, fault = np.zeros((2, lanes), dtype=np.int64)
    force_peak, pull_peak = np.zeros((2, lanes))
    reference, stopped = np.zeros((lanes, tool_count, 3)), np.zeros(lanes, dtype=np.int32)
    return StepOutcome(wrench, mean, reference, stopped, count, fault, force_peak, pull_peak)


def steps_taken(model: OrganModel, state: OrganState, outcome: StepOutcome, lane: int) -> StepsTaken:
    """The result of one lane, whose organ is now in `state`."""
    code = int(outcome.fault[lane])
    fault = describe(model, state, outcome.mean[lane], code) if code != FAULT_NONE else ""
    force_peak, pull_peak = float(outcome.force_peak[lane]), float(outcome.pull_peak[lane])
    return StepsTaken(int(outcome.step_count[lane]), force_peak, fault, pull_peak, bool(outcome.stopped[lane]))


def describe(model: OrganModel, state: OrganState, wrench: FloatArray, fault: int) -> str:
    """One sentence on a FAULT_ code of a haptic step, from the wrench (n_tool, 6) of that step."""
    if fault == FAULT_WRENCH_NOT_FINITE:
        return "the contact wrench is not finite"
    if fault == FAULT_FORCE_CAP:
        force = float(np.sqrt(np.square(wrench[:, :3]).sum(axis=1)).max())
        return f"contact force {force:.4g} N is beyond the physical cap of {FORCE_CAP:g} N"
    return describe_fault(model, state, fault)
