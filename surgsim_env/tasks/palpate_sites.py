"""Palpation by single presses at chosen sites; an estimator locates the lesions from the readings."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from msdm_core.arithmetic import exp, matmul
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.sensors import ForceReading, TaxelReading
from surgsim_env.instruments.instrument import Instrument
from surgsim_env.palpation.chart import MAP_SIDE, TAXEL_BETWEEN, Site, charted_face, healthy_map_of
from surgsim_env.palpation.lesion_estimator import (
    ORGAN_GRADIENT_SPREAD,
    ORGAN_MAP_SPREAD,
    REFERENCE_LESION_RADIUS,
    LesionEstimate,
    LesionEstimator,
)
from surgsim_env.palpation.member_chart import member_map, still_template
from surgsim_env.palpation.scores import FOUND_SHARE, ospa, ospa_cutoff
from surgsim_env.palpation.site_press import PressResult
from surgsim_env.palpation.touches import GRADIENT_BOUND, LOG_CONTRAST_BOUND, SiteTouches, Touch, felt_lesion_radius
from surgsim_env.scene.levels import REFERENCE_TIP
from surgsim_env.tasks.channels import force_scale, soft_force_share
from surgsim_env.tasks.declaration import Channel, Command, ControlStep, Reward, Setup
from surgsim_env.tasks.task import InfoValue, Scenario, Task

# Presses of an episode; BUDGET_WIDE where the chart's longer side exceeds WIDE tip radii.
BUDGET, BUDGET_WIDE, WIDE = 25, 40, 10.0
# OSPA at which an episode succeeds [m], under a tip of REFERENCE_TIP; in proportion under others.
SUCCESS_ERROR = 0.005
# Bound of the observed depth over the scene's press depth.
DEPTH_BOUND = 2.0


# Bounds of a map's cell and a lesion's radius over the tip's radius, and of numbers of log contrast.
CELL_BOUND, LESION_BOUND, NOISE_BOUND = 100.0, 100.0, 100.0


def _map_size(task: "PalpateSitesTask") -> int:
    return MAP_SIDE * MAP_SIDE if task.memory else 0


def _with_memory(size: int) -> Callable[["PalpateSitesTask"], int]:
    return lambda task: size if task.memory else 0


def _force_bound(task: "PalpateSitesTask") -> float:
    return math.sqrt(3.0) * task.anatomy.scene.sensor.range / task.limits.hard_force


class PalpateSitesTask(Task):
    """Find hidden lesions by single presses at chosen sites.

    ## Description
    Up to three stiff lesions, or none, lie hidden under the surface of a soft organ. The agent names sites on its
    palpable face; the environment presses each with the scene's ball tip, through the force exchange of
    `SurgSim/Palpate-v0`, 1000 times a second, and observes the force. One estimator, the same for every agent, locates
    the lesions from all presses (`surgsim_env.palpation.lesion_estimator`); the agent chooses where to press.

    A press: the organ at rest, the tip a clearance above the site; down along the surface normal at 40 mm/s to the
    scene's depth, or until the force is half way from the soft to the hard limit; rest for 0.1 s; force and depth are
    the means of the last 40 ms. The way from site to site is not simulated: its time is counted at 20 mm/s.

    ## Action Space
    `Box(-1, 1, (2,), float32)`: a place on the chart of the palpable face, the rectangle across the scene's approach
    that holds all sites which keep the face's margin. A place that may not be pressed (over thin tissue, beside the
    rim, under a ligament or another support) is moved to the nearest site of the chart's grid that may.

    ## Observation Space
    With `memory=True` `Box((5055,), float32)`: maps of n x n sites, n = 41, 0.4 tip radii apart, over the middle
    of the chart, row by row along its second axis, the same size for every organ; sites are farther apart where 16 tip
    radii do not span the chart, as `map_cell` shows. With `memory=False` the last six numbers alone: a true POMDP, for
    agents with a memory of their own. All bounds finite.
    `env.unwrapped.observation_slices` has the entries of each channel by its name. An instrument with taxels observes
    their forces too, and the gradient of the contrast, from the shift of the centre of pressure; the estimator reads it
    (docs/palpation.md).

    Contrast is stiffness (force over depth) over that of the scene's healthy organ of nominal modulus at this place, a
    map that is made once for each scene and kept on disk (`surgsim_env.palpation.chart`).

    ## Rewards
    `info["reward_<term>"]` shows what each term paid. A control step is one press. Each press costs in
    proportion to the error of the estimate after it; lesions found pay once. An episode that ends in failure pays less
    than any that makes all its presses.

    ## Starting State
    Drawn from the ranges of the level (`surgsim_env.scene.levels`): number, places, sizes, covers and modulus ratios of
    the lesions, the modulus of the tissue around them, a capsule, the sensor's bias. The organ is at rest.

    ## Episode End
    Terminated: the presses of the budget are made (success if the error is at most 5 mm; distances are for a tip of
    8 mm radius and scale with it); the contact force exceeded the hard limit; the simulation faulted. Never truncated:
    the budget of presses belongs to the task.

    ## Info
    Fixed keys and types. Of the press: `sim_fault` (str), `sensor_saturated`, `workspace_limited`, `hard_limit`,
    `stopped_by_force`, `contrast_cut` (bool), `force`, `force_peak` [N], `depth` [m], `stiffness` [N/m], `contrast`,
    `moved_mm`, `cost` (force over the soft limit, 1 at the hard one: a constraint for safe learning),
    `trocar_error_mm`, `added_mass` [kg], one `reward_<term>` each. Of the episode so far: `seconds`, `path_length` [m],
    `error_mm` (OSPA between estimated and true places, Schuhmacher et al. 2008, cutoff 20 mm; -1 after a reset),
    `found` (share of lesions with an estimate within 10 mm; on an organ without lesions 1 if the estimate has none; 0
    after a reset), `lesion_count_estimated`, `success`, `is_success`. The info of a reset does not depend on the
    lesions; `error_mm`, `found` and the rewards of a step are the truth, for training and scores alone.
    Where the scene is a family of organs also `member` (str), the one that the episode plays, such as "train 7".
    Where the scene has `[limits] pressure`, `strain` or `dose`, and with `measure_tissue`, also `tissue_pressure` [Pa]
    and `tissue_strain`, the largest of the tissue at the end of the press, `tissue_extrapolated` (bool): strain beyond
    `strain_supported` of the material's stiffening, and `damaged` (bool): more than a limit is a safety stop. With
    `dose` also `tissue_dose` [Pa s], the largest integral of pressure over time at a place of the surface so far, over
    all presses: each part of a press (a control step inward, 10 ms of the rest and on a moving organ) adds its duration
    times the pressure at its end.

    ## Arguments
    * `scene`: a scene's name or the path of a scene file with a `[lesion]` table; default "phantom".
    * `motion`: "none", "calm" or "free": how the patient breathes (docs/motion.md); by default as the scene says.
    * `track_motion`: a press goes with the surface as a camera's markers show it (default), or to where it is at rest.
    * `level`: "easy", "standard" (default), "hard" or "clinical".
    * `memory`: observe all presses (default), or the last one alone.
    * `budget`: presses of an episode; by default 25, or 40 where the chart is longer than ten tip radii.
    * `split`: "train" (default), "validation" or "test": members of a family of organs, such as scene "liver_family",
      of which each episode draws one; `info["member"]` names it.
    * `instrument`: "probe", "tactile_probe" (a probe with taxels), the name of an arm or the path of an arm's TOML
      file; by default the scene's own.

    ## Version History
    * v0: first version.
    """

    commands = (Command("place", 2, meaning="the place to press on the chart of the palpable face"),)
    channels = (
        Channel(
            "contrast_map", _map_size, "", -LOG_CONTRAST_BOUND, LOG_CONTRAST_BOUND, felt=True,
            read=lambda task, simulation: task.felt.maps()[0],
            meaning="log contrast of the latest press nearest to each site, 0 without one", size_text="n n or 0",
        ),
        Channel(
            "pressed_map", _map_size, "", 0.0, 1.0, read=lambda task, simulation: task.felt.maps()[1],
            meaning="1 for each site where there was one", size_text="n n or 0",
        ),
        Channel(
            "face_map", _map_size, "", 0.0, 1.0, read=lambda task, simulation: task.charted.touch_map.pressable,
            meaning="1 for each site that may be pressed", size_text="n n or 0",
        ),
        Channel(
            "map_cell", _with_memory(1), "", 0.0, CELL_BOUND,
            read=lambda task, simulation: task.charted.cell / task.charted.tip_radius,
            meaning="distance between neighbouring sites over the tip's radius", size_text="1 or 0",
        ),
        Channel(
            "chart_share", _with_memory(2), "", 0.0, 1.0,
            read=lambda task, simulation: task.charted.chart.extent / (task.charted.cell * (MAP_SIDE - 1)),
            meaning="lengths of the chart's sides over the map's", size_text="2 or 0",
        ),
        Channel(
            "contrast_noise", _with_memory(1), "", 0.0, NOISE_BOUND,
            read=lambda task, simulation: task.estimator.noise,
            meaning="standard deviation of one log contrast by the force sensor", size_text="1 or 0",
        ),
        Channel(
            "excess_least", _with_memory(1), "", 0.0, NOISE_BOUND,
            read=lambda task, simulation: task.estimator.excess_least,
            meaning="least excess of the log contrast that the estimator takes for a lesion", size_text="1 or 0",
        ),
        Channel(
            "lesion_radius", _with_memory(1), "", 0.0, LESION_BOUND,
            read=lambda task, simulation: task.estimator.lesion_radius / task.charted.tip_radius,
            meaning="mean radius of the lesions that the scene hides over the tip's, at least 1", size_text="1 or 0",
        ),
        Channel(
            "last_place", 2, "", -1.0, 1.0, read=lambda task, simulation: task.felt.last.place,
            meaning="place of the last press on the chart",
        ),
        Channel(
            "last_force", 1, "",
            lambda task, instrument: -_force_bound(task), lambda task, instrument: _force_bound(task),
            read=lambda task, simulation: task.felt.last.force / task.limits.hard_force, felt=True,
            meaning="its force along the normal, through the sensor model, over the hard limit",
            bounds_text="+-sqrt(3) range / hard limit",
        ),
        Channel(
            "last_depth", 1, "", -DEPTH_BOUND, DEPTH_BOUND,
            read=lambda task, simulation: task.felt.last.depth / task.anatomy.scene.palpation.press_depth,
            meaning="its depth over the scene's press depth",
        ),
        Channel(
            "last_contrast", 1, "", -LOG_CONTRAST_BOUND, LOG_CONTRAST_BOUND, felt=True,
            read=lambda task, simulation: task.felt.last.log_contrast, meaning="its log contrast",
        ),
        Channel(
            "presses_left", 1, "", 0.0, 1.0, read=lambda task, simulation: 1.0 - task.step_count / task.budget,
            meaning="share of the presses left",
        ),
        Channel(
            "gradient_map", lambda task: 2 * _map_size(task) if task.taxel_reading is not None else 0, "",
            -GRADIENT_BOUND, GRADIENT_BOUND, felt=True,
            read=lambda task, simulation: task.charted.tip_radius * task.felt.maps()[2:].ravel(),
            meaning="with taxels: gradient of the log contrast along the chart's first and then its second axis, times "
            "the tip's radius, at each site", size_text="2 n n or 0",
        ),
        Channel(
            "gradient_noise", lambda task: int(task.memory and task.taxel_reading is not None), "", 0.0, NOISE_BOUND,
            read=lambda task, simulation: task.charted.tip_radius * task.estimator.gradient_noise,
            meaning="with taxels: standard deviation of one gradient by noise and healthy map, times the tip's radius",
            size_text="1 or 0",
        ),
        Channel(
            "taxels", lambda task: math.prod(task.taxel_shape), "N",
            lambda task, instrument: -task.anatomy.scene.instrument.taxels.range,
            lambda task, instrument: task.anatomy.scene.instrument.taxels.range,
            read=lambda task, simulation: task.felt.taxels if task.felt.taxels.size else np.zeros(task.taxel_shape),
            felt=True, meaning="forces of the last press on the taxels, row by row: along the row, along the column "
            "and into the tool, through their sensor model", size_text="3 a taxel", bounds_text="+-range",
            scale=force_scale, scale_text="soft limit",
        ),
    )  # fmt: skip
    # `error`, `soft_force` and `forgone` are in [0, 1] per press and count as shares of the budget of n presses: 0.04,
    # 0.01 and 0.05 a press for n = 25.
    #
    # `found` is the CHANGE of a number in [0, 1] and sums to its last value less the first (1 where there is nothing to
    # find and nothing is claimed, else 0): it cannot be earned twice. The worst full episode returns at least
    # error + soft_force - f, one that fails after k presses at most (1 - f) found + failure + (n - k) / n forgone,
    # where f is the first value of `found`. As forgone = error + soft_force, the first is larger by
    #   -f + k / n (error + soft_force) - (1 - f) - failure  >=  -1 - 1.25 + 2.5  =  0.25  at least:
    # a failed, faulted or aborted episode never returns more than the worst full one.
    rewards = (
        Reward(
            "error", -1.0, "step", "distance of the estimates from the truth (OSPA) over its cutoff and the budget",
            lambda task, step: task.error / task.cutoff / task.budget,
        ),
        Reward(
            "found", 1.0, "change", "share of the lesions with an estimate near them", lambda task, step: task.found
        ),
        Reward(
            "soft_force", -0.25, "step",
            "largest force of the press, 0 at the soft and 1 at the hard limit, over the budget",
            lambda task, step: soft_force_share(task, step) / task.budget,
        ),
        Reward("hard_force", -2.5, "failure", "the force exceeded the hard limit: a safety stop"),
        Reward("fault", -2.5, "failure", "the simulation could not go on"),
        Reward(
            "forgone", -1.25, "step left", "share of the budget that is left after a failure",
            lambda task, step: 1.0 - task.step_count / task.budget,
        ),
    )  # fmt: skip
    # The budget ends an episode.
    setup = Setup(level="standard", episode_steps=None)
    kept = ("given_budget", "record")

    def __init__(
        self,
        scenario: Scenario,
        *,
        memory: bool = True,
        budget: int | None = None,
        track_motion: bool = True,
    ) -> None:
        """Palpate an anatomy; a press is simulated or looked up, everything else is computed here.

        For each press the environment asks for its `site` and calls `take` with its result.

        Attributes that agents and scores may read: `estimator` (the benchmark's common estimator, on the lengths of
        `charted.chart`), `budget`, `step_count`, `felt` (record of the presses), `estimate`, `estimated` (its places on
        the face [m] (k, 3)), `truth` (the face's points nearest to the lesions' centres [m] (n_lesion, 3)), `error`
        (OSPA [m]), `found` (share of the lesions with an estimate near them).

        Args:
            scenario: with a level.
            memory: observe all presses; else the last one alone.
            budget: presses of an episode; by default 25, or 40 where the chart's longer side is above ten tip radii.
            track_motion: presses follow a moving surface.

        Raises:
            ValueError: a budget that is no whole number above 0.
        """
        super().__init__(scenario)
        scene, tip = self.anatomy.scene, self.anatomy.scene.instrument.tip_radius
        self.memory, self.track_motion = memory, track_motion
        if budget is not None and budget < 1:
            raise ValueError(f"budget is {budget!r}; it must be a whole number of presses, at least 1")
        self.given_budget = budget
        self._patches = None if scenario.instrument is None else scenario.instrument.patches
        self.reading, taxels = ForceReading(scene.sensor), scene.instrument.taxels
        self.taxel_reading = None if taxels is None else TaxelReading(taxels, self.taxel_shape)
        self.cutoff, self.tip_scale = ospa_cutoff(tip), tip / REFERENCE_TIP
        assert scenario.level is not None and scenario.scene is not None
        # The healthy maps of the scene and of a family's members belong to this anatomy.
        self._still = still_template(scenario.level.healthy(scenario.scene))
        self._chart()

    def _chart(self) -> None:
        """Take the chart of the anatomy's face, its healthy map, estimator and budget."""
        anatomy, scene = self.anatomy, self.anatomy.scene
        self.charted = charted_face(anatomy)
        chart = self.charted.chart
        between = 1 if self._patches is None else TAXEL_BETWEEN
        if anatomy.member is None:
            healthy = healthy_map_of(self._still, between)
        else:
            healthy = member_map(self._still, anatomy.member, between)
        wide = chart.extent.max() > WIDE * scene.instrument.tip_radius
        self.budget = self.given_budget if self.given_budget is not None else (BUDGET_WIDE if wide else BUDGET)
        self.felt = SiteTouches(self.charted, healthy, scene.palpation)
        healthy_force = float(healthy.grid[:, :, 0].mean()) * scene.palpation.press_depth
        self.estimator = LesionEstimator(
            chart.extent,
            lesion_radius=felt_lesion_radius(scene),
            noise=scene.sensor.noise / healthy_force,
            map_spread=0.0 if scene.mesh.block is not None else ORGAN_MAP_SPREAD,
            gradient_noise=self._gradient_noise(healthy_force),
        )
        self.truth = np.zeros((0, 3))
        self._believe()

    def _gradient_noise(self, force: float) -> float:
        """Standard deviation of a gradient by taxels under a force [N], and by the map [1/m]; 0 without taxels.

        By the taxels' noise s the centre of pressure sum N_i x_i / sum N_i has s sqrt(sum x_i^2) / F.
        """
        if self._patches is None:
            return 0.0
        places = self._patches.places
        away = self.charted.chart.along_axes(places - places.mean(axis=(0, 1, 2)))
        width = math.sqrt(0.5 * float((away * away).sum()))
        by_taxels = self._patches.taxels.noise * width / force / self.felt.gradient_gain
        scene = self.anatomy.scene
        by_map = ORGAN_GRADIENT_SPREAD * REFERENCE_LESION_RADIUS / felt_lesion_radius(scene)
        return math.hypot(by_taxels, 0.0 if scene.mesh.block is not None else by_map)

    # ---- the episode ------------------------------------------------------------------------------------------------

    def draw(self, rng: np.random.Generator) -> FloatArray:
        """Draw the sensor's bias and the map's error; the tip waits above the middle of the chart."""
        if self.charted is not charted_face(self.anatomy):
            self._chart()
        self.truth = self.drawn.places(self.anatomy)
        self.reading.reset(rng)
        if self.taxel_reading is not None:
            self.taxel_reading.reset(rng)
        assert self.level is not None
        if self.level.map_error:
            self.felt.map_shift = rng.normal(0.0, self.level.map_error, 2)
        self.felt.clear()
        self._believe()
        middle, scene = self.charted.site(np.zeros(2)), self.anatomy.scene
        gap = scene.instrument.tip_radius + scene.palpation.clearance
        return middle.point + middle.normal * gap

    def command(self, commands: dict[str, FloatArray], instrument: Instrument) -> None:
        """No command: the press moves the instrument."""

    def site(self, action: FloatArray) -> Site:
        """Site of an action (2,), or the nearest pressable site."""
        return self.charted.site(np.clip(action, -1.0, 1.0))

    def take(self, site: Site, result: PressResult, rng: np.random.Generator) -> bool:
        """Add the result of a press at a site, read through the sensor; True if the sensor saturated."""
        # Between presses the sensor bears nothing.
        self.reading.follow(np.zeros(3))
        reading, saturated = self.reading.read(result.force, rng, self.felt.seconds)
        taxels = None
        if self.taxel_reading is not None and result.taxels is not None:
            taxels, cut = self.taxel_reading.read(result.taxels, rng, self.felt.seconds)
            saturated = saturated or cut
        self.felt.add(site, result, float(matmul(reading, site.normal)), taxels)
        self._believe()
        return saturated

    def _believe(self) -> None:
        """Estimate the lesions from all touches, and compare with the truth."""
        felt = self.felt
        self.estimate: LesionEstimate = self.estimator.estimate(felt.places, felt.log_contrasts, felt.gradients)
        self.estimated = self.charted.surface(2.0 * self.estimate.points / self.charted.chart.extent - 1.0)
        self.error = ospa(self.truth, self.estimated, self.cutoff)
        self.found = self._found_share()

    def _found_share(self) -> float:
        """Share of lesions with an estimate near them; without lesions 1 for no estimate, else 0."""
        if len(self.truth) == 0:
            return float(len(self.estimated) == 0)
        distance = np.sqrt(np.square(self.truth[:, None] - self.estimated).sum(axis=2))
        return float((distance <= FOUND_SHARE * self.cutoff).any(axis=1).mean())

    # ---- judgement --------------------------------------------------------------------------------------------------

    def end(self, step: ControlStep) -> str:
        """Reason of the end: a fault, the hard limit, or a spent budget, "success" or "done"."""
        if harm := super().end(step):
            return harm
        if self.step_count < self.budget:
            return ""
        return "success" if self.error <= SUCCESS_ERROR * self.tip_scale else "done"

    def info(self, step: ControlStep | None, end: str) -> dict[str, InfoValue]:
        """Entries of `Task.info`, of the last press and of the estimate so far."""
        last: Touch = self.felt.last
        return {
            **super().info(step, end),
            "force": last.force,
            "depth": last.depth,
            "stiffness": last.stiffness,
            "contrast": float(exp(last.log_contrast)),
            "contrast_cut": last.cut,
            "stopped_by_force": last.stopped,
            "moved_mm": last.moved * 1000.0,
            "seconds": self.felt.seconds,
            "path_length": self.felt.path_length,
            # Before the first press they would tell whether there are lesions.
            "error_mm": -1.0 if step is None else self.error * 1000.0,
            "found": 0.0 if step is None else self.found,
            "lesion_count_estimated": float(len(self.estimated)),
        }

    # ---- saving -----------------------------------------------------------------------------------------------------

    @property
    def record(self) -> dict[str, Any]:
        """Record of the readings and the sensor's bias, as a table for JSON."""
        drift = {} if self.taxel_reading is None else {"drift": self.taxel_reading.get_state()}
        return {"bias": self.reading.get_state(), **drift, **self.felt.get_state()}

    @record.setter
    def record(self, table: dict[str, Any]) -> None:
        if self.charted is not charted_face(self.anatomy):
            self._chart()
        self.reading = self.reading.restored(table["bias"])
        if self.taxel_reading is not None:
            self.taxel_reading = self.taxel_reading.restored(table["drift"])
        self.felt.set_state(table)
        self.truth = self.drawn.places(self.anatomy)
        self._believe()
