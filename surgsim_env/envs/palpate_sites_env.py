"""SurgSim/PalpateSites-v0, one environment or many side by side: one step is one press."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.lane_group import LaneGroup
from surgsim_env.envs.surgical_env import Action, Info, SurgicalEnv
from surgsim_env.envs.vector_env import LaneVectorEnv
from surgsim_env.palpation.chart import Site
from surgsim_env.palpation.site_press import PressPhase, SitePress, press_alone, press_in_lanes, press_phases
from surgsim_env.tasks.palpate_sites import PalpateSitesTask


class PalpateSitesEnv(SurgicalEnv):
    """SurgSim/PalpateSites-v0: a step is a press."""

    task_class = PalpateSitesTask
    task: PalpateSitesTask

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self.phases: tuple[PressPhase, ...] = press_phases(self.scene)
        # A press that was made among others, for the next `step` to take.
        self._made: tuple[Site, SitePress] | None = None
        self._limited = self._saturated = False

    def load_state(self, state: bytes) -> None:
        """As `SurgicalEnv.load_state`; a press that was begun is forgotten."""
        super().load_state(state)
        self._made = None

    def _draw(self) -> None:
        self._made, self._limited, self._saturated = None, False, False
        super()._draw()

    def _maker(self) -> str:
        """As `SurgicalEnv._maker`, and the budget, on which observations and rewards depend."""
        return f"{super()._maker()}, budget={self.task.given_budget}"

    def begin_press(self, action: Action | FloatArray) -> SitePress:
        """Put the organ at rest and the tip over the site that an action names; the next `step` takes the press."""
        site = self.task.site(self._checked(action))
        seconds, tracks = self.task.felt.seconds, self.task.track_motion
        press = SitePress(self.simulation, site.point, site.normal, elapsed=seconds, tracks=tracks)
        self._made = (site, press)
        return press

    def _advance(self) -> float:
        """Make the press, unless it was made among others."""
        if self._made is None:
            press_alone(self.begin_press(self.last_action), self.phases)
        assert self._made is not None
        (site, press), self._made = self._made, None
        result = press.result()
        self._saturated = not self.simulation.fault and self.task.take(site, result, self.np_random)
        self._limited = result.workspace_limited
        return result.force_peak

    def _info(self, fault: str, saturated: bool, task_info: Info, rewards: dict[str, float]) -> Info:
        """Of the whole press, where a simulation says only whether the instrument is limited at its end."""
        info = super()._info(fault, self._saturated, task_info, rewards)
        return {**info, "workspace_limited": self._limited}


class PalpateSitesVectorEnv(LaneVectorEnv):
    """SurgSim/PalpateSites-v0 many times over: presses side by side."""

    single = PalpateSitesEnv
    _singles: list[PalpateSitesEnv]  # type: ignore[assignment]

    def __init__(self, num_envs: int = 1, **settings: Any) -> None:
        """Make the environments; arguments are those of `LaneVectorEnv`."""
        super().__init__(num_envs, **settings)
        self._presses: list[SitePress | None] = [None] * num_envs

    def _command(self, index: int, action: Action) -> None:
        super()._command(index, action)
        self._presses[index] = self._singles[index].begin_press(action)

    def _advance(self, group: LaneGroup, members: range, active: NDArray[np.bool_]) -> None:
        presses = [self._presses[index] if moves else None for index, moves in zip(members, active, strict=True)]
        press_in_lanes(group, presses, self._singles[members.start].phases)
