"""Simulations of one scene side by side in one compiled call, with the same results as alone."""

import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from msdm_core.kernels.structure_kernels import LANE_EMPTY, OrganModel
from msdm_core.lanes.lanes import (
    lane_responses,
    lane_shapes,
    put_lane,
    same_rest,
    set_lane,
    stack_organs,
    stack_shapes,
    stack_states,
    take_lane,
)
from surgsim_env.coupling.exchange import step_outcome, step_plan, steps_taken
from surgsim_env.coupling.haptic_kernels import advance_lane_haptic_steps
from surgsim_env.coupling.simulation import Simulation


def core_count() -> int:
    """Number of cores of this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class LaneGroup:
    """Up to as many simulations as there are lanes: 8 in float64, 16 or 8 in float32.

    Their organs have the same tets. Rest shapes and anchors are shared until a simulation has different ones; from then
    on each lane has its own.

    Between control steps every simulation holds its own state, so that tasks, saving and loading see no difference. A
    control step copies the states into the lanes and back, which takes 1 % of its time.
    """

    def __init__(self, simulations: Sequence[Simulation], dtype: type = np.float64, lanes: int | None = None) -> None:
        """Group simulations of one scene, at most as many as there are lanes."""
        self.simulations = list(simulations)
        first = self.simulations[0]
        self._dtype, self._lanes = dtype, lanes
        self._stack()
        count = len(self._model.lanes)
        self._shapes = stack_shapes([simulation.instrument.shapes for simulation in self.simulations], count)
        tools = first.instrument.tool_count
        self._response = lane_responses(tools, count)
        self._outcome = step_outcome(count, tools)

    def control_step(
        self, moving: Sequence[Simulation], count: int, force_limit: float, pull_limit: float = math.inf
    ) -> None:
        """Advance some of the simulations by up to `count` haptic steps, as `Simulation.control_step` does alone.

        Several threads may do so for several groups, because the compiled call releases the interpreter's lock.
        """
        if not self._own_rest and not all(
            simulation.organ_model is known or same_rest(simulation.organ_model, self._organs[0])
            for simulation, known in zip(self.simulations, self._organs, strict=True)
        ):
            self._stack()
        for lane, simulation in enumerate(self.simulations):
            if simulation in moving:
                self._load(lane, simulation)
            else:
                self._state.lane_fault[lane] = LANE_EMPTY
        first = self.simulations[0]
        views = [simulation.instrument.views(compiled=True) for simulation in self.simulations]
        # Always as many as there are lanes: numba would compile another number anew.
        views += [views[-1]] * (len(self._outcome.step_count) - len(views))
        drives = [simulation.drive for simulation in self.simulations]
        drives += [drives[-1]] * (len(self._outcome.step_count) - len(drives))
        plan = step_plan(self._model.alpha, first.substep_dt, first.substep_count, count, force_limit, pull_limit)
        outcome = self._outcome._replace(stopped=self._state.lane_fault)
        advance_lane_haptic_steps(
            self._model,
            self._state,
            first.contact,
            self._shapes,
            self._response,
            tuple(views),
            tuple(drives),
            plan,
            outcome,
        )
        for lane, simulation in enumerate(self.simulations):
            if simulation in moving:
                self._unload(lane, simulation)

    def _stack(self) -> None:
        """Make lanes for the present organs of the simulations."""
        self._organs: list[OrganModel] = [simulation.organ_model for simulation in self.simulations]
        self._own_rest = not all(same_rest(self._organs[0], organ) for organ in self._organs)
        settings: dict[str, Any] = {"dtype": self._dtype, "lanes": self._lanes, "own_rest": self._own_rest}
        self._model = stack_organs(self._organs, **settings)
        self._state = stack_states(
            [simulation.organ_state for simulation in self.simulations], self._organs[0], **settings
        )

    def _load(self, lane: int, simulation: Simulation) -> None:
        simulation.begin_in_lanes()
        if simulation.organ_model is not self._organs[lane]:
            set_lane(self._model, lane, simulation.organ_model)
            self._organs[lane] = simulation.organ_model
        put_lane(self._state, lane, simulation.organ_state)
        self._outcome.wrench[lane] = simulation.contact_wrench

    def _unload(self, lane: int, simulation: Simulation) -> None:
        take_lane(self._state, lane, simulation.organ_state)
        taken = steps_taken(simulation.organ_model, simulation.organ_state, self._outcome, lane)
        # Tasks read the shapes: torques are about their tools' centres.
        for own, moved in zip(simulation.instrument.shapes, lane_shapes(self._shapes, lane), strict=True):
            own[...] = moved
        simulation.end_in_lanes(self._outcome.wrench[lane], taken)
