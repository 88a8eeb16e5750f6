"""Organs side by side from rest, and their substeps, as tests advance them without simulations."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import exp
from msdm_core.kernels.structure_kernels import (
    ContactLaw,
    ContactShapes,
    LaneModel,
    LaneState,
    OrganModel,
    ToolResponse,
)
from msdm_core.kernels.substep_kernels import advance_substeps
from msdm_core.lanes.lanes import lane_responses, stack_states
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.compile import rest_state


def rest_lanes(
    organs: Sequence[OrganModel],
    *,
    shape_count: int = 0,
    dtype: Any = np.float64,
    lanes: int | None = None,
    own_rest: bool = False,
) -> LaneState:
    """The state at rest of organs side by side, with contact memory for `shape_count` shapes each.

    Lanes beyond the organs are empty (LANE_EMPTY) and do not move. Under gravity each organ is settled (`rest_state`).
    """
    resting = [rest_state(organ, shape_count=shape_count) for organ in organs]
    return stack_states(resting, organs[0], dtype=dtype, lanes=lanes, own_rest=own_rest)


def advance_lanes(
    model: LaneModel,
    state: LaneState,
    shapes: ContactShapes,
    contact: ContactLaw,
    dt: float,
    substep_count: int,
    wrench: FloatArray,
    response: ToolResponse | None = None,
) -> NDArray[np.int32]:
    """Advance organs side by side in place by `substep_count` steps of dt [s]: `advance_organ` for each of them.

    Args:
        model: the organs.
        state: their states; lanes whose `lane_fault` is not FAULT_NONE do not change by a bit.
        shapes: every lane's contact shapes, the lane as first index, moved along their twist.
        contact: the contact law of all lanes.
        dt: substep [s], stable (`stable_dt`).
        substep_count: how many.
        wrench: receives each lane's mean wrench on its tools [N, N m], shape (n_lane, n_tool, 6).
        response: how tools yield, the lane as first index; None where they follow their twist.

    Returns:
        `state.lane_fault` (n_lane,), a FAULT_ code each: what stopped a lane in this call or before it.
    """
    if response is None:
        response = lane_responses(shapes.tool_centre.shape[1], len(state.lane_fault))
    decay = float(exp(-model.alpha * dt))
    reference = shapes.tool_centre.copy()
    advance_substeps(model, state, shapes, contact, response, dt, decay, substep_count, reference, wrench)
    return state.lane_fault
