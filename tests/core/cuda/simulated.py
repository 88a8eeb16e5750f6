"""Presses on a device that numba simulates, beside the same presses on the processor.

    NUMBA_ENABLE_CUDASIM=1 python -m tests.core.cuda.simulated

A process of its own, as numba chooses the simulator when it is imported.
"""

import json

import numpy as np

from msdm_core.cuda.organs import DeviceOrgans
from msdm_core.kernels.structure_kernels import FAULT_NONE, ToolResponse
from msdm_core.lanes.lanes import stack_shapes
from msdm_core.material.regions import Damping
from msdm_core.organ.compile import rest_state
from msdm_core.organ.stepping import advance_organ
from tests.core import oracle
from tests.core.lanes.test_lanes import LAW, tool, varied, yielding

SUBSTEP, SUBSTEPS, STEPS = 5e-5, 3, 3
LANES = 3
# The lane that a fault stops.
BROKEN = 1


def presses(lane_count: int, dtype: type) -> dict[str, float]:
    """The largest relative differences of wrenches and velocities of all lanes but the broken one."""
    base = oracle.block((0.03, 0.02, 0.02), (3, 2, 2), anchored_below=0.0, damping=Damping(alpha=20.0, beta=0.0))
    organs = [varied(base, seed) for seed in range(lane_count)]
    states = [rest_state(organ, shape_count=2) for organ in organs]
    # A tet squeezed to a third, which is held in order.
    for state in states:
        state.node_position[-1, 2] -= 0.006
    tools = [tool(lane, depth=0.0015) for lane in range(lane_count)]
    device = DeviceOrgans(base, lane_count, tools[0], LAW, SUBSTEP, SUBSTEPS, dtype=dtype, threads=8, block_count=1)
    if lane_count > 1:
        states[BROKEN].node_position[-1] = states[BROKEN].node_position[0]
    device.put(organs, states)
    responses = [yielding(lane) for lane in range(lane_count)]
    device.put_tools(stack_shapes(tools, lane_count), ToolResponse(*(np.stack(rows) for rows in zip(*responses))))
    device.advance(STEPS)
    worst = {"wrench": 0.0, "velocity": 0.0, "engaged": 0.0, "squeezed": 1.0}
    for lane in range(lane_count):
        if lane_count > 1 and lane == BROKEN:
            continue
        for _ in range(STEPS):
            wrench = np.zeros((1, 6))
            assert (
                advance_organ(organs[lane], states[lane], tools[lane], LAW, SUBSTEP, SUBSTEPS, wrench, responses[lane])
                == FAULT_NONE
            )
            responses[lane].tool_lag[:] = 0.0
        alone = states[lane]
        velocity, engaged = (
            getattr(device.state, name).copy_to_host()[lane] for name in ("node_velocity", "contact_engaged")
        )
        mean = device.tools.mean.copy_to_host()[lane]
        worst["wrench"] = max(worst["wrench"], float(np.abs(mean - wrench).max() / np.abs(wrench).max()))
        difference = np.abs(velocity - alone.node_velocity).max() / np.abs(alone.node_velocity).max()
        worst["velocity"] = max(worst["velocity"], float(difference))
        worst["engaged"] += float((engaged != alone.contact_engaged).sum())
        worst["squeezed"] = min(worst["squeezed"], float(alone.volume_ratio_smallest[0]))
    faults = device.state.fault.copy_to_host()
    worst["fault"] = float(faults[BROKEN]) if lane_count > 1 else 0.0
    return worst


if __name__ == "__main__":
    print(
        json.dumps(
            {
                "float64": presses(LANES, np.float64),
                "float32": presses(LANES, np.float32),
                "alone": presses(1, np.float64),
            }
        )
    )
