"""The haptic steps of one control step for organs side by side, MuJoCo's included: `haptic_kernels` for many."""

from numba import njit

from msdm_core.kernels import FAULT_NONE
from msdm_core.lane_kernels import advance_lane_substeps
from msdm_core.lane_view_kernels import LANE_EMPTY, response_of, shapes_of
from surgsim_env.haptic_kernels import begin_step, end_step, pull_force, total_force


@njit(nogil=True, error_model="numpy")
def _begin_lane(tools, shapes, response, reference, lane):
    begin_step(tools, shapes_of(shapes, lane), response_of(response, lane))
    reference[lane] = tools.reference


@njit(nogil=True, error_model="numpy")
def _end_lane(tools, mean, wrench):
    tools.wrench[:, :] = mean
    return end_step(tools, wrench)


@njit(cache=True, nogil=True, error_model="numpy")
def advance_lane_haptic_steps(
    model, state, law, shapes, response, tools, dt, decay, substep_count, wrench, count, force_limit, pull_limit,
    reference, mean, taken, fault, peak, pull_peak,
):  # fmt: skip
    """Advance organs side by side and their tools by `count` haptic steps, each fewer where it has to stop.

    What `haptic_kernels.advance_haptic_steps` does with each of them; a lane that is done stands still.

    Model: model, law
    In:    dt [s] of a substep, decay = exp(-alpha dt), substep_count, force_limit and pull_limit [N],
           tools: one ToolViews a lane
    Out:   state, shapes, response, tools; wrench: of each lane's last good haptic step (n_lane, n_tool, 6);
           taken: how many steps were finished, fault: a FAULT_ code, peak, pull_peak: largest
           `total_force` and `pull_force` [N], all (n_lane,)
    Scratch: reference (n_lane, n_tool, 3), mean (n_lane, n_tool, 6)
    """
    for lane in range(len(tools)):
        taken[lane] = 0
        fault[lane] = FAULT_NONE
        peak[lane], pull_peak[lane] = 0.0, 0.0
    for _ in range(count):
        for lane in range(len(tools)):
            if state.lane_fault[lane] != FAULT_NONE:
                continue
            _begin_lane(tools[lane], shapes, response, reference, lane)
        advance_lane_substeps(model, state, shapes, law, response, dt, decay, substep_count, reference, mean)
        running = False
        for lane in range(len(tools)):
            if state.lane_fault[lane] == LANE_EMPTY or fault[lane] != FAULT_NONE:
                continue
            fault[lane] = state.lane_fault[lane]
            if fault[lane] != FAULT_NONE:
                continue
            fault[lane] = _end_lane(tools[lane], mean[lane], wrench[lane])
            if fault[lane] != FAULT_NONE:
                state.lane_fault[lane] = LANE_EMPTY
                continue
            taken[lane] += 1
            peak[lane] = max(peak[lane], total_force(wrench[lane]))
            pull_peak[lane] = max(pull_peak[lane], pull_force(tools[lane].jaws, wrench[lane]))
            if peak[lane] > force_limit or pull_peak[lane] > pull_limit:
                state.lane_fault[lane] = LANE_EMPTY
            else:
                running = True
        if not running:
            return
