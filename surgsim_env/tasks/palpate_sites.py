"""Palpation press by press: choose sites to press on; what was felt there is made an estimate of the lesions below."""

import json
import math

import numpy as np

from msdm_core.kernels import OrganModel
from msdm_core.mesh import FloatArray
from msdm_core.regions import Lesion
from surgsim_env.anatomy import Anatomy
from surgsim_env.instrument import Instrument
from surgsim_env.levels import REFERENCE_TIP, DrawnOrgan, Level
from surgsim_env.palpation.charted_face import Site
from surgsim_env.palpation.healthy_map import HealthyMap, charted_face
from surgsim_env.palpation.lesion_estimator import LesionEstimate, LesionEstimator
from surgsim_env.palpation.ospa import ospa, ospa_cutoff
from surgsim_env.palpation.site_press import PressResult
from surgsim_env.palpation.site_touches import LOG_CONTRAST_BOUND, SiteTouches, Touch
from surgsim_env.rewards import PALPATE_SITES_WEIGHTS, weighted
from surgsim_env.scenes import Endoscope
from surgsim_env.sensors import ForceReading
from surgsim_env.simulation import Simulation
from surgsim_env.tasks.task import Bounds, InfoValue, Start, Verdict
from surgsim_env.visibility import Disc

# Presses of an episode; BUDGET_WIDE where the chart's longer side is above so many tip radii.
BUDGET, BUDGET_WIDE, WIDE = 25, 60, 10.0
# A lesion is found where an estimate is so near to it [m], and an episode succeeds where OSPA ends so small [m], under
# a tip of 8 mm, in proportion under others.
FOUND_DISTANCE = 0.010
SUCCESS_ERROR = 0.005
# Bound of the observed depth over the scene's press depth.
DEPTH_BOUND = 2.0


class PalpateSitesTask:
    """SurgSim/PalpateSites-v0 on one anatomy; a press is simulated or looked up, all else is here.

    An episode: `reset` (or `begin_episode` with an organ that was drawn elsewhere); for each press `begin`, `site`,
    `take` with what the press came to, `observe`, `judge`.

    Fields that agents and scores may read:
        estimator: the benchmark's common estimator, on the lengths of `charted.chart`
        site_count: sites on a side of the observation's grid
        budget, step_count: presses of an episode, and those made
        felt: what the presses told
        estimate, estimated: what that makes one believe, and where it is on the face [m] (k, 3)
        truth: the face's points nearest to the lesions' centres [m] (n_lesion, 3)
        error, found: OSPA [m], and the share of lesions with an estimate near them
    """

    action_size = 2
    weights = PALPATE_SITES_WEIGHTS
    pull_limit = math.inf
    target: Disc | None = None
    endoscope: Endoscope | None = None

    def __init__(
        self, anatomy: Anatomy, level: Level, healthy: HealthyMap, *, memory: bool = True, budget: int | None = None
    ) -> None:
        """Palpate an anatomy.

        Args:
            anatomy: of a scene that `level.scene` gave.
            level: what an episode draws.
            healthy: stiffness of the scene's healthy organ over its chart.
            memory: observe all presses; else the last one alone.
            budget: presses of an episode; by default 25, or 60 where the chart's longer side is above ten tip radii.

        Raises:
            ValueError: a budget that is no whole number above 0.
        """
        scene = anatomy.scene
        self.anatomy, self.level, self.memory = anatomy, level, memory
        self.charted = charted_face(anatomy)
        chart, tip = self.charted.chart, scene.instrument.tip_radius
        if budget is None:
            budget = BUDGET_WIDE if chart.extent.max() > WIDE * tip else BUDGET
        if isinstance(budget, bool) or not isinstance(budget, int) or budget < 1:
            raise ValueError(f"budget is {budget!r}; it must be a whole number of presses, at least 1")
        self.budget, self.site_count = budget, chart.side_count
        self.limits = scene.limits
        self.reading = ForceReading(scene.sensor)
        self.felt = SiteTouches(self.charted, healthy, scene.palpation)
        healthy_force = float(healthy.grid.mean()) * scene.palpation.press_depth
        self.estimator = LesionEstimator(chart.extent, tip_radius=tip, noise=scene.sensor.noise / healthy_force)
        self.cutoff, self.tip_scale = ospa_cutoff(tip), tip / REFERENCE_TIP
        self.drawn: DrawnOrgan | None = None
        self.truth = np.zeros((0, 3))
        self._clear()

    def _clear(self) -> None:
        self.felt.clear()
        self.step_count = 0
        self._pending: tuple[Site, PressResult] | None = None
        self._believe()
        self._found_before = self.found

    # ---- the episode ------------------------------------------------------------------------------------------------

    @property
    def lesions(self) -> tuple[Lesion, ...]:
        """The lesions of the episode; none before the first."""
        return () if self.drawn is None else self.drawn.lesions

    @property
    def force_limit(self) -> float:
        """The episode ends with a press whose force passes this [N]."""
        return self.limits.hard_force

    def reset(self, rng: np.random.Generator) -> Start:
        """Draw the organ and the sensor's bias; the tip waits above the middle of the chart."""
        drawn = self.level.draw(self.anatomy, rng)
        self.begin_episode(drawn, rng)
        middle, scene = self.charted.site(np.zeros(2)), self.anatomy.scene
        gap = scene.instrument.tip_radius + scene.palpation.clearance
        return Start(drawn.compiled(self.anatomy), middle.point + middle.normal * gap)

    def begin_episode(self, drawn: DrawnOrgan, rng: np.random.Generator, truth: FloatArray | None = None) -> None:
        """Begin with an organ that was drawn; `truth` (n_lesion, 3) [m] is `drawn.places` where that is known."""
        self.drawn = drawn
        self.truth = drawn.places(self.anatomy) if truth is None else truth
        self.reading.reset(rng)
        self._clear()

    def accepts(self, simulation: Simulation) -> bool:
        """Every draw is an episode."""
        return True

    def command(self, action: FloatArray, instrument: Instrument) -> None:
        """Nothing: a press commands the instrument as it goes."""

    def begin(self, action: FloatArray) -> None:
        """Count a press."""
        self.step_count += 1

    def site(self, action: FloatArray) -> Site:
        """The site that an action (2,) asks to press, or the nearest that may be pressed."""
        return self.charted.site(np.clip(action, -1.0, 1.0))

    def take(self, site: Site, result: PressResult) -> None:
        """Take what a press at a site came to; `observe` reads the sensor."""
        self._pending = (site, result)

    def observe(self, simulation: Simulation | None, rng: np.random.Generator) -> tuple[FloatArray, bool]:
        """The observation after the press that was taken last, and whether the sensor saturated."""
        saturated = False
        if self._pending is not None:
            (site, result), self._pending = self._pending, None
            reading, saturated = self.reading.read(result.force, rng)
            self.felt.add(site, result, float(reading @ site.normal))
            self._believe()
        return self._observation(), saturated

    def _believe(self) -> None:
        """Estimate the lesions from all touches, and compare with the truth."""
        self.estimate: LesionEstimate = self.estimator.estimate(self.felt.places, self.felt.log_contrasts)
        self.estimated = self.charted.surface(2.0 * self.estimate.points / self.charted.chart.extent - 1.0)
        self.error = ospa(self.truth, self.estimated, self.cutoff)
        self.found = self._found_share()

    def _found_share(self) -> float:
        """Share of lesions with an estimate near them; without lesions 1 where there is no estimate either."""
        if len(self.truth) == 0:
            return float(len(self.estimated) == 0)
        distance = np.sqrt(((self.truth[:, None] - self.estimated) ** 2).sum(axis=2))
        return float((distance <= FOUND_DISTANCE * self.tip_scale).any(axis=1).mean())

    # ---- observation and judgement ----------------------------------------------------------------------------------

    @property
    def force_entries(self) -> list[int]:
        """Entries of the observation that come from the force sensor."""
        sites = self.site_count**2 if self.memory else 0
        return [*range(sites), 2 * sites + 2, 2 * sites + 4]

    def bounds(self, instrument: Instrument | None) -> Bounds:
        """Bounds of the observation; leaving them is a fault."""
        sites = self.site_count**2 if self.memory else 0
        force = math.sqrt(3.0) * self.anatomy.scene.sensor.range / self.limits.hard_force
        last = [1.0, 1.0, force, DEPTH_BOUND, LOG_CONTRAST_BOUND]
        high = [*[LOG_CONTRAST_BOUND] * sites, *[1.0] * sites, *last, 1.0]
        low = [*[-LOG_CONTRAST_BOUND] * sites, *[0.0] * sites, *[-value for value in last], 0.0]
        return Bounds(np.array(low), np.array(high))

    def _observation(self) -> FloatArray:
        touch = self.felt.last
        force = touch.force / self.limits.hard_force
        depth = touch.depth / self.anatomy.scene.palpation.press_depth
        left = 1.0 - self.step_count / self.budget
        last = np.array([*touch.place, force, depth, touch.log_contrast, left])
        return np.concatenate([self.felt.maps(), last]) if self.memory else last

    def judge(self, simulation: Simulation | None, force_peak: float, fault: str) -> Verdict:
        """End a press: say what it was worth and whether it was the last; `simulation` is not looked at."""
        hard = not fault and force_peak > self.limits.hard_force
        done, failed = self.step_count >= self.budget, bool(fault) or hard
        over = max(self.limits.excess(force_peak), 0.0)
        terms = {
            "error": self.error / self.cutoff / self.budget,
            "found": self.found - self._found_before,
            "soft_force": min(over, 1.0) / self.budget,
            "hard_force": float(hard),
            "fault": float(bool(fault)),
            "forgone": 1.0 - self.step_count / self.budget if failed else 0.0,
        }
        self._found_before = self.found
        success = done and not failed and self.error <= SUCCESS_ERROR * self.tip_scale
        return Verdict(
            terminated=failed or done,
            truncated=False,
            rewards=weighted(terms, PALPATE_SITES_WEIGHTS),
            info={**self._told(), "hard_limit": hard, "success": success, "force_peak": force_peak, "cost": over},
        )

    def blank_info(self) -> dict[str, InfoValue]:
        """The info of a reset: the same keys and types as a verdict's."""
        return {**self._told(), "hard_limit": False, "success": False, "force_peak": 0.0, "cost": 0.0}

    def _told(self) -> dict[str, InfoValue]:
        last: Touch = self.felt.last
        return {
            "force": last.force,
            "depth": last.depth,
            "stiffness": last.stiffness,
            "contrast": math.exp(last.log_contrast),
            "contrast_cut": last.cut,
            "stopped_by_force": last.stopped,
            "moved_mm": last.moved * 1000.0,
            "seconds": self.felt.seconds,
            "path_length": self.felt.path_length,
            "error_mm": self.error * 1000.0,
            "found": self.found,
            "lesion_count_estimated": float(len(self.estimated)),
        }

    # ---- saving -----------------------------------------------------------------------------------------------------

    def get_state(self) -> str:
        """What was drawn and felt, as exact JSON."""
        assert self.drawn is not None
        return json.dumps(
            {
                "drawn": self.drawn.to_json(),
                "bias": self.reading.bias.tolist(),
                "felt": self.felt.get_state(),
                "step_count": self.step_count,
                "budget": self.budget,
                "found_before": self._found_before,
            }
        )

    def set_state(self, text: str) -> OrganModel:
        """Restore what `get_state` gave; returns the organ of that episode.

        Raises:
            ValueError: the episode has another budget, which what is observed and paid goes with.
        """
        table = json.loads(text)
        if table["budget"] != self.budget:
            raise ValueError(
                f"the state is of an episode of {table['budget']} presses, this environment's have {self.budget}: make "
                f"it with budget={table['budget']}"
            )
        self.drawn = DrawnOrgan.from_json(table["drawn"], self.anatomy)
        self.truth = self.drawn.places(self.anatomy)
        self.reading.bias = np.array(table["bias"])
        self.felt.set_state(table["felt"])
        self.step_count = table["step_count"]
        self._pending = None
        self._believe()
        self._found_before = table["found_before"]
        return self.drawn.compiled(self.anatomy)
