"""SurgSim/PalpateSites-v0: one step is one press."""

from collections.abc import Sequence
from typing import Any

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.lane_group import LaneGroup
from surgsim_env.envs.surgical_env import Info, Observation, SurgicalEnv
from surgsim_env.palpation.site_press import PressPhase, SitePress, press_alone, press_in_lanes, press_phases
from surgsim_env.tasks.palpate_sites import PalpateSitesTask


class PalpateSitesEnv(SurgicalEnv):
    """SurgSim/PalpateSites-v0: a step is a press."""

    task_class = PalpateSitesTask
    task: PalpateSitesTask
    # Of the last step; a reset drops it.
    _press: SitePress | None = None

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self.phases: tuple[PressPhase, ...] = press_phases(self.scene)

    def begin(self, action: FloatArray) -> None:
        """Put the organ at rest and the tip over the site of a `checked` action (2,)."""
        super().begin(action)
        self._site, task = self.task.site(action), self.task
        self._press = SitePress(
            self.simulation, self._site.point, self._site.normal, elapsed=task.felt.seconds, tracks=task.track_motion
        )

    def advance(self, group: Sequence[Any], lanes: LaneGroup | None = None) -> None:
        """As `SurgicalEnv.advance`, by a press."""
        if lanes is not None:
            press_in_lanes(lanes, [env._press for env in group], self.phases)
        elif self._press is not None:
            press_alone(self._press, self.phases)

    def finish(self) -> tuple[Observation, float, bool, bool, Info]:
        """Observe and judge the press."""
        assert self._press is not None
        fault = self.simulation.fault
        self._saturated = not fault and self.task.take(self._site, self._press.result(), self.np_random)
        return super().finish()

    @property
    def force_peak(self) -> float:
        """Largest contact force of the last press [N]."""
        return 0.0 if self._press is None else self._press.force_peak

    def _draw(self) -> None:
        self._press, self._saturated = None, False
        super()._draw()

    def _maker(self) -> str:
        """As `SurgicalEnv._maker`, with the budget: observations and rewards depend on it."""
        return f"{super()._maker()}, budget={self.task.given_budget}"

    def _info(self, fault: str, saturated: bool, task_info: Info, rewards: dict[str, float]) -> Info:
        """As `SurgicalEnv._info`, with workspace_limited of the whole press instead of its end."""
        limited = self._press is not None and self._press.result().workspace_limited
        return {**super()._info(fault, self._saturated, task_info, rewards), "workspace_limited": limited}
