"""The force exchange between organ and instrument: one haptic step to read, and many in one compiled call."""

import math
from typing import NamedTuple

import mujoco
import numpy as np

from msdm_core.errors import OrganDivergedError
from msdm_core.kernels import FAULT_NONE, ContactLaw, OrganModel, OrganState
from msdm_core.mesh import FloatArray
from msdm_core.stepping import advance_organ, describe_fault
from surgsim_env import mujoco_library
from surgsim_env.haptic_kernels import (
    FAULT_FORCE_CAP,
    FAULT_WRENCH_NOT_FINITE,
    FORCE_CAP,
    advance_haptic_steps,
    check_wrench,
)
from surgsim_env.tool_bodies import ToolBodies


def haptic_step(
    model: OrganModel,
    state: OrganState,
    instrument: ToolBodies,
    contact: ContactLaw,
    dt: float,
    substep_count: int,
    wrench: FloatArray,
) -> None:
    """Advance organ and instrument together by one haptic step; `wrench` (n_tool, 6) [N, N m] receives the mean.

    The instrument's shapes are read from the current step (mj_step1) and carried along their twist through the organ's
    substeps; the MEAN wrench of the tissue, torque about each tool's centre of mass at the start, acts on the tool in
    mj_step2: the organ's change of momentum is minus that wrench times the step, exactly.

    Within the step the twist answers each substep's wrench at the rate J (M + dt D)^-1 (q + J^T w), as MuJoCo answers
    their mean, and so ends where MuJoCo's does. MuJoCo then places the tool dt v_end on, ahead of where the organ saw
    it by delta = (dt^2 / m) int_0^1 s F(s dt) ds, F being all force on it. That step of the shapes costs the energy
    F(dt) . delta: at frequency w its mean is |F|^2 dt^2 / (2 m) (1 - cos w dt) / (w dt)^2, never negative, so that the
    exchange takes energy and gives none, but for k delta^2 / 2, which the least mass of `tool_mass` keeps small. With
    the twist held through the step delta would be dt^2 / m times the mean force, which is out of step with F(dt):
    tissue vibrating above about 370 Hz under the tool then gains energy until damping stops it.

    Raises:
        OrganDivergedError: an inverted tet, a number that is not finite, or a force beyond FORCE_CAP.
    """
    mujoco.mj_step1(instrument.model, instrument.data)
    instrument.drive()
    instrument.read_shapes()
    instrument.read_response()
    fault = advance_organ(model, state, instrument.shapes, contact, dt, substep_count, wrench, instrument.response)
    if fault == FAULT_NONE:
        fault = check_wrench(wrench)
    if fault != FAULT_NONE:
        raise OrganDivergedError(describe(model, state, wrench, fault))
    instrument.apply_wrench(wrench)
    mujoco.mj_step2(instrument.model, instrument.data)


class StepsTaken(NamedTuple):
    """What came of some haptic steps.

    Fields:
        count: how many were finished
        force_peak: their largest total force [N]
        fault: what ended them, or ""
        pull_peak: the largest pull of a jaw, the size of the sum of its fingers' forces [N]
    """

    count: int
    force_peak: float
    fault: str
    pull_peak: float = 0.0


def compiled_steps(
    model: OrganModel,
    state: OrganState,
    instrument: ToolBodies,
    contact: ContactLaw,
    dt: float,
    substep_count: int,
    wrench: FloatArray,
    count: int,
    force_limit: float,
    pull_limit: float = math.inf,
) -> StepsTaken:
    """`haptic_step` up to `count` times in one compiled call without the interpreter's lock, equal to the bit.

    It ends with the step whose total force passes `force_limit` [N], or a jaw's pull `pull_limit` [N]; a fault is told,
    not raised, and leaves `wrench` as the last good step had it.

    Raises:
        RuntimeError: MuJoCo's functions are not known to the linker (says why).
        TypeError: tools with a `drive` of their own: compiled code knows the `servo` alone.
    """
    if type(instrument).drive is not ToolBodies.drive:
        raise TypeError(f"{type(instrument).__name__} drives itself in Python; call haptic_step in a loop")
    if missing := mujoco_library.missing():
        raise RuntimeError(f"haptic steps cannot be compiled: {missing}; call haptic_step in a loop")
    tools = instrument.views()
    decay = math.exp(-model.alpha * dt)
    taken, fault, peak, pull_peak = advance_haptic_steps(
        model, state, contact, instrument.shapes, instrument.response, tools, dt, decay, substep_count, wrench, count,
        force_limit, pull_limit,
    )  # fmt: skip
    told = describe(model, state, tools.wrench, fault) if fault != FAULT_NONE else ""
    return StepsTaken(taken, peak, told, pull_peak)


def describe(model: OrganModel, state: OrganState, wrench: FloatArray, fault: int) -> str:
    """One sentence on a FAULT_ code of a haptic step; `wrench` is the one that showed it."""
    if fault == FAULT_WRENCH_NOT_FINITE:
        return "the contact wrench is not finite"
    if fault == FAULT_FORCE_CAP:
        force = float(np.sqrt((wrench[:, :3] ** 2).sum(axis=1)).max())
        return f"contact force {force:.4g} N is beyond the physical cap of {FORCE_CAP:g} N"
    return describe_fault(model, state, fault)
