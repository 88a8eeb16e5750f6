"""SurgSim/PalpateSites-v0, one environment or many side by side: one step is one press."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from surgsim_env.anatomy import load_anatomy
from surgsim_env.lane_group import LaneGroup
from surgsim_env.levels import find_level
from surgsim_env.palpation.charted_face import Site
from surgsim_env.palpation.healthy_map import healthy_map
from surgsim_env.palpation.site_press import PressPhase, SitePress, press_alone, press_in_lanes, press_phases
from surgsim_env.scenes import make_scene, with_instrument
from surgsim_env.simulation import Simulation
from surgsim_env.surgical_env import Action, Info, SurgicalEnv
from surgsim_env.tasks.palpate_sites import PalpateSitesTask
from surgsim_env.vector_env import LaneVectorEnv


class PalpateSitesEnv(SurgicalEnv):
    """Find hidden lesions by choosing where to press, one press a step.

    ## Description
    Up to three stiff lesions, or none, lie hidden under the surface of a soft organ. The agent names sites on its
    palpable face; the environment presses each with the scene's ball tip, through the same force exchange a thousand
    times a second as `SurgSim/Palpate-v0`, and tells what was felt. One estimator, the same for every agent, makes of
    all presses where the lesions are (`surgsim_env.palpation.lesion_estimator`); the agent's part is where to press.

    A press: the organ at rest, the tip a clearance above the site; down along the surface normal at 40 mm/s to the
    scene's depth, or until the force is half way from the soft to the hard limit; rest for 0.1 s; force and depth are
    the means of the last 40 ms. The way from site to site is not simulated: its time is counted at 20 mm/s.

    ## Action Space
    `Box(-1, 1, (2,), float32)`: a place on the chart of the palpable face, the rectangle across the scene's approach
    that holds all sites which keep the face's margin. A place that may not be pressed is moved to the nearest site of
    the chart's grid that may.

    ## Observation Space
    With `memory=True` `Box((2 n n + 6,), float32)`, n x n sites of a fixed grid over the chart, row by row along its
    second axis (n is odd, 13 to 25, sites about half a tip's radius apart; phantom 13, so 344 numbers); with
    `memory=False` the last six alone: a true POMDP, for agents with a memory of their own. All bounds finite.

    | num | meaning | bounds |
    |---|---|---|
    | 0 to n n - 1 | log contrast of the latest press nearest to that site, 0 without one | +-2 |
    | n n to 2 n n - 1 | 1 where there was one | 0 to 1 |
    | -6, -5 | place of the last press on the chart | +-1 |
    | -4 | its force along the normal, through the sensor model, over the hard limit | +-sqrt(3) range |
    | -3 | its depth over the scene's press depth | +-2 |
    | -2 | its log contrast | +-2 |
    | -1 | share of the presses left | 0 to 1 |

    Contrast is stiffness (force over depth) over that of the scene's healthy organ of nominal modulus at this place, a
    map that is made once for each scene and kept on disk (`surgsim_env.palpation.healthy_map`).

    ## Rewards
    Named terms, weighted in `surgsim_env.rewards.PALPATE_SITES_WEIGHTS`; `info["reward_<term>"]` shows each. Each press
    costs in proportion to the error of the estimate after it; lesions found pay once. An episode that ends in harm pays
    less than any that makes all its presses.

    ## Starting State
    As the level says (`surgsim_env.levels`): number, places, sizes, covers and modulus ratios of the lesions, the
    modulus of the tissue around them, a capsule, the sensor's bias.

    ## Episode End
    Terminated: the presses of the budget are made (success where the error is at most 5 mm under a tip of 8 mm); the
    contact force passed the hard limit; the simulation came to a fault. Never truncated: the budget is the task's.

    ## Info
    Fixed keys and types. Of the press: `sim_fault` (str), `sensor_saturated`, `workspace_limited`, `hard_limit`,
    `stopped_by_force`, `contrast_cut` (bool), `force`, `force_peak` [N], `depth` [m], `stiffness` [N/m], `contrast`,
    `moved_mm`, `cost` (force over the soft limit, 1 at the hard one: a constraint for safe learning),
    `trocar_error_mm`, `added_mass` [kg], one `reward_<term>` each. Of the episode so far: `seconds`, `path_length` [m],
    `error_mm` (OSPA between estimated and true places, Schuhmacher et al. 2008, cutoff 20 mm under a tip of 8 mm),
    `found` (share of lesions with an estimate within 10 mm, likewise; without lesions 1 where none is claimed),
    `lesion_count_estimated`, `success`.

    ## Arguments
    * `scene`: a scene's name or the path of a scene file with a `[lesion]` table; default "phantom".
    * `level`: "easy", "standard" (default) or "hard".
    * `memory`: observe all presses (default), or the last one alone.
    * `budget`: presses of an episode; by default 25, or 60 where the chart is longer than ten tip radii.
    * `instrument`: "probe", the name of an arm or the path of an arm's TOML file; by default the scene's own.
    * `render_mode`, `camera`, `width`, `height`, ...: as in `SurgSim/Palpate-v0`.

    ## Version History
    * v0: first version.
    """

    task: PalpateSitesTask

    def __init__(
        self,
        scene: str = "phantom",
        level: str = "standard",
        memory: bool = True,
        budget: int | None = None,
        instrument: str | None = None,
        render_mode: str | None = None,
        **pictures: Any,
    ) -> None:
        chosen, plain = find_level(level), make_scene(scene)
        leveled = chosen.scene(with_instrument(plain, instrument))
        task = PalpateSitesTask(load_anatomy(leveled), chosen, healthy_map(plain), memory=memory, budget=budget)
        super().__init__(Simulation(task.anatomy), task, render_mode=render_mode, pictures=pictures)
        self.phases: tuple[PressPhase, ...] = press_phases(self.scene)
        # A press that was made among others, for the next `step` to take.
        self._made: tuple[Site, SitePress] | None = None
        self._limited = False

    def load_state(self, state: bytes) -> None:
        """As `SurgicalEnv.load_state`; a press that was begun is forgotten."""
        super().load_state(state)
        self._made = None

    def _draw(self) -> None:
        self._made, self._limited = None, False
        super()._draw()

    def begin_press(self, action: Action | FloatArray) -> SitePress:
        """Put the organ at rest and the tip over the site that an action names; the next `step` takes the press."""
        site = self.task.site(self._checked(action))
        press = SitePress(self.simulation, site.point, site.normal)
        self._made = (site, press)
        return press

    def _advance(self) -> float:
        """Make the press, unless it was made among others."""
        if self._made is None:
            press_alone(self.begin_press(self.last_action), self.phases)
        assert self._made is not None
        (site, press), self._made = self._made, None
        result = press.result()
        self.task.take(site, result)
        self._limited = result.workspace_limited
        return result.force_peak

    def _info(self, fault: str, saturated: bool, task_info: Info, rewards: dict[str, float]) -> Info:
        """Of the whole press, where a simulation says only whether the instrument is limited at its end."""
        info = super()._info(fault, saturated, task_info, rewards)
        return {**info, "workspace_limited": self._limited}


class PalpateSitesVectorEnv(LaneVectorEnv):
    """SurgSim/PalpateSites-v0 many times over: presses side by side."""

    single = PalpateSitesEnv
    episode_steps = math.inf
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
