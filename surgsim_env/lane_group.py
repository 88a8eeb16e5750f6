"""Simulations of one scene that advance side by side in one compiled call, each as it would alone."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.kernels import FAULT_NONE, OrganModel
from msdm_core.lane_organs import same_rest, set_lane, stack_organs
from msdm_core.lane_view_kernels import LANE_EMPTY
from msdm_core.lanes import get_lane, lane_responses, lane_shapes, lanes_of, put_lane, stack_shapes
from surgsim_env.exchange import StepsTaken, describe
from surgsim_env.lane_haptic_kernels import advance_lane_haptic_steps
from surgsim_env.simulation import Simulation


class LaneGroup:
    """As many simulations as there are lanes: 8 in float64, 16 or 8 in float32.

    Their organs have the same tets; rest shapes and anchors are shared till a simulation comes with others, and each
    lane's own from then on.

    Between control steps every simulation holds its own state, so that tasks, saving and loading see no difference; a
    control step copies them into the lanes and back, which costs a hundredth of it.
    """

    def __init__(self, simulations: Sequence[Simulation], dtype: type = np.float64, lanes: int | None = None) -> None:
        """Take simulations of one scene, at most as many as there are lanes."""
        self.simulations = list(simulations)
        first = self.simulations[0]
        self._dtype, self._lanes = dtype, lanes
        self._stack()
        count = len(self._model.lanes)
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
        if not self._own_rest and not all(
            one.organ_model is known or same_rest(one.organ_model, self._organs[0])
            for one, known in zip(self.simulations, self._organs, strict=True)
        ):
            self._stack()
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

    def _stack(self) -> None:
        """Make lanes for the simulations as they are now."""
        self._organs: list[OrganModel] = [one.organ_model for one in self.simulations]
        self._own_rest = not all(same_rest(self._organs[0], organ) for organ in self._organs)
        settings: dict[str, Any] = {"dtype": self._dtype, "lanes": self._lanes, "own_rest": self._own_rest}
        self._model = stack_organs(self._organs, **settings)
        self._state = lanes_of([one.organ_state for one in self.simulations], self._organs[0], **settings)

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
        # Tasks read where the shapes are: torques are about their tools' centres.
        for own, moved in zip(simulation.instrument.shapes, lane_shapes(self._shapes, lane), strict=True):
            own[...] = moved
        simulation.take_over(organ_state, self._wrench[lane], taken)
