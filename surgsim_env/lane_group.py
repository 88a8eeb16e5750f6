"""Simulations of one scene that advance side by side in one compiled call, each as it would alone."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from msdm_core.kernels import FAULT_NONE, OrganModel
from msdm_core.lane_kernels import LANE_EMPTY
from msdm_core.lanes import get_lane, lane_responses, put_lane, rest_lanes, set_lane, stack_organs, stack_shapes
from surgsim_env.exchange import StepsTaken, describe
from surgsim_env.lane_haptic_kernels import advance_lane_haptic_steps
from surgsim_env.simulation import Simulation


class LaneGroup:
    """As many simulations as there are lanes: 8 in float64, 16 or 8 in float32.

    Between control steps every simulation holds its own state, so that tasks, saving and loading see no difference; a
    control step copies them into the lanes and back, which costs a hundredth of it.
    """

    def __init__(self, simulations: Sequence[Simulation], dtype: type = np.float64, lanes: int | None = None) -> None:
        """Take simulations of one scene, at most as many as there are lanes."""
        self.simulations = list(simulations)
        first = self.simulations[0]
        self._organs: list[OrganModel] = [one.organ_model for one in self.simulations]
        self._model = stack_organs(self._organs, dtype=dtype, lanes=lanes)
        count = len(self._model.lanes)
        shapes = first.instrument.shapes
        self._state = rest_lanes(self._organs, shape_count=len(shapes.shape_radius), dtype=dtype, lanes=count)
        self._shapes = stack_shapes([one.instrument.shapes for one in self.simulations], count)
        tools = first.instrument.tool_count
        self._response = lane_responses(tools, count)
        self._wrench, self._mean = np.zeros((2, count, tools, 6))
        self._reference = np.zeros((count, tools, 3))
        self._taken, self._fault = np.zeros((2, count), dtype=np.int64)
        self._peak, self._pull_peak = np.zeros((2, count))

    def control_step(
        self, active: NDArray[np.bool_], count: int, force_limit: float, pull_limit: float = math.inf
    ) -> None:
        """Advance the active simulations (n,) by up to `count` haptic steps; each is told what came of it.

        Called from several threads for several groups: the compiled call does not hold the interpreter's lock.
        """
        for lane, simulation in enumerate(self.simulations):
            self._load(lane, simulation, bool(active[lane]))
        first = self.simulations[0]
        views = [one.instrument.views() for one in self.simulations]
        # Always as many as there are lanes: another number would be compiled anew.
        views += [views[-1]] * (len(self._taken) - len(views))
        advance_lane_haptic_steps(
            self._model, self._state, first.contact, self._shapes, self._response,
            tuple(views), first.substep_dt,
            math.exp(-self._model.alpha * first.substep_dt), first.substep_count, self._wrench, count, force_limit,
            pull_limit, self._reference, self._mean, self._taken, self._fault, self._peak, self._pull_peak,
        )  # fmt: skip
        for lane in np.flatnonzero(active):
            self._unload(int(lane))

    def _load(self, lane: int, simulation: Simulation, active: bool) -> None:
        if not active:
            self._state.lane_fault[lane] = LANE_EMPTY
            return
        if simulation.organ_model is not self._organs[lane]:
            set_lane(self._model, lane, simulation.organ_model)
            self._organs[lane] = simulation.organ_model
        put_lane(self._state, lane, simulation.organ_state)
        self._wrench[lane] = simulation.contact_wrench

    def _unload(self, lane: int) -> None:
        simulation, code = self.simulations[lane], int(self._fault[lane])
        organ_state = get_lane(self._state, lane)
        message = ""
        if code != FAULT_NONE:
            message = describe(simulation.organ_model, organ_state, self._mean[lane], code)
        taken = StepsTaken(int(self._taken[lane]), float(self._peak[lane]), message, float(self._pull_peak[lane]))
        simulation.take_over(organ_state, self._wrench[lane], taken)
