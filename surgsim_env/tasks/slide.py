"""Palpation by a sliding, tactile tip: a map of hidden lesions within a time, without a healthy map."""

import math
from dataclasses import replace

import numpy as np

from msdm_core.arithmetic import matmul, norm
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.instruments.instrument import Instrument
from surgsim_env.palpation.chart import MAP_SIDE, charted_face
from surgsim_env.palpation.face_frame import FaceFrame
from surgsim_env.palpation.lesion_estimator import LESIONS_MOST
from surgsim_env.palpation.scores import map_errors, map_score, ospa_cutoff
from surgsim_env.scene.levels import REFERENCE_TIP
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import Scene
from surgsim_env.tasks.channels import SPEED_BOUND, TAXELS, TIME_LEFT, force_scale, soft_force_share
from surgsim_env.tasks.declaration import Channel, Command, ControlStep, Reward, Setup
from surgsim_env.tasks.palpate_sites import CELL_BOUND, SUCCESS_ERROR
from surgsim_env.tasks.task import InfoValue, Scenario, Task

# Duration of an episode [s].
EPISODE_TIME = 20.0
# Full scale of the speed along the surface [tip radii / s].
SLIDE_SPEED = 4.0
# Distance ahead of the tip at which the way must be pressable, at full speed [tip radii].
LOOKAHEAD = 1.0
# Largest speed along the normal [tip radii / s], and height of a lifted tip above the surface [tip radii].
NORMAL_SPEED, LIFT_HEIGHT = 2.0, 0.5
# Share of the force's error that a control step takes away on tissue as stiff as soft limit over press depth. Tissue
# over a lesion is up to twice as stiff: 1 would overshoot there.
FORCE_GAIN = 0.4
# Numbers of a declared lesion.
LESION_NUMBERS = ("presence", "across", "along", "radius")
# Bounds of the tip's place on the chart, of lengths over the tip's radius, and of the thickness observed.
PLACE_BOUND, LENGTH_BOUND, THICKNESS_BOUND = 100.0, 1000.0, 20.0
# Gap of the tip above the surface at the start [m].
START_GAP = 0.003
# Largest dose of the tissue where the scene states none [Pa s]: chosen, some ten times that of a sweep over a face of
# `liver_family`.
DOSE = 5e4


def _tip_radius(task: "SlideTask", instrument: Instrument | None) -> float:
    return task.anatomy.scene.instrument.tip_radius


def load_slide_scene(scene: str) -> Scene:
    """Scene of a name or file, with the dose limit DOSE where it has none."""
    made = make_scene(scene)
    return made if made.limits.dose is not None else replace(made, limits=replace(made.limits, dose=DOSE))


def _on_map(task: "SlideTask") -> int:
    return MAP_SIDE * MAP_SIDE if task.shows_face else 0


class SlideTask(Task):
    """Map hidden lesions with a tactile tip that slides over a breathing organ.

    ## Description
    Up to three stiff lesions, or none, lie hidden under the surface of a soft organ. A probe with taxels slides over
    its palpable face, and the agent maps the lesions while it slides: number, places and radii. The surface of the
    organ is known, up to an error of registration; the stiffness of the healthy organ is not: thin tissue, a rim and a
    ligament feel stiff too, and only knowledge of such organs tells them from lesions. Tissue and tip exchange forces
    1000 times a second; the agent acts 20 times a second.

    ## Action Space
    `Box(-1, 1, (15,), float32)`. `slide` moves the tip along the surface; a way off the face's pressable sites ends at
    the nearest of them. `press` is the set point of the force along the surface's normal, held by a proportional
    controller on the sensor's reading; below 0 it lifts the tip half a radius above the surface. `lesions` is the map,
    declared anew in each control step: for each of three lesions its presence (declared above 0), place on the chart,
    and radius, (1 + value) tip radii.

    ## Observation Space
    `Box(float32)`, all bounds finite; 48 numbers are of 4 x 4 taxels. It is the last reading alone: a POMDP, for agents
    with a memory of their own. Where the patient breathes, the tip's place is relative to the moving surface, as
    markers show it.

    ## Rewards
    `info["reward_<term>"]` shows what each term paid. The return is the mean over the time of the map's score, less the
    cost of force; the score is (1 - OSPA / cutoff + Dice) / 2: of places on the chart (Schuhmacher, Vo & Vo 2008, eq.
    1, cutoff 2.5 tip radii) and of the areas of discs around them (Dice 1945). The true place of a lesion is the
    surface point nearest to its centre. After a failure nothing more is paid.

    ## Starting State
    Drawn from the ranges of the level (`surgsim_env.scene.levels`), as for `SurgSim/PalpateSites-v0`, with the error of
    registration [m] along each side of the chart; the tip is above a random pressable place, at rest.

    ## Episode End
    Terminated: after 20 s (400 control steps; success if OSPA of the last map is at most 5 mm for a tip of 8 mm radius,
    in proportion for others); the contact force exceeded the hard limit; tissue was damaged; the simulation faulted.

    ## Info
    Fixed keys and types: `sim_fault` (str), `sensor_saturated`, `workspace_limited`, `hard_limit`, `success`,
    `is_success` (bool), `force_peak` [N], `cost` (force above the soft limit, 1 at the hard one), `error_mm` (OSPA of
    the declared map; -1 after a reset), `dice`, `map_score` (sum of the scores so far over the number of control steps
    of an episode: what follows a failure counts 0), `path_length` [m] in contact, `trocar_error_mm`, `added_mass` [kg],
    one `reward_<term>` each. `member` (str) where the scene is a family; `tissue_pressure` [Pa], `tissue_strain` and
    more as for `SurgSim/PalpateSites-v0`. In the last step the true map, as `lesions` of the action would declare it:
    `lesion_1_presence`, `lesion_1_across`, `lesion_1_along`, `lesion_1_radius` and so on, before that and for lesions
    that are not there -1.

    ## Arguments
    * `scene`: a scene's name or the path of a scene file with a `[lesion]` table; default "liver_family".
    * `instrument`: default "tactile_probe"; or "probe", the name of an arm or the path of an arm's TOML file.
    * `level`: "easy", "standard", "hard" or "clinical" (default).
    * `motion`: "none", "calm" or "free"; by default as the level says: "calm" for "clinical".
    * `face`: observe the map of the pressable sites, the same in every step of an episode; default False.
    * `episode_steps`: control steps of an episode; by default those of 20 s.
    * `split`: "train" (default), "validation" or "test": members of a family of organs, of which each episode draws
      one; `info["member"]` names it.

    ## Version History
    * v0: first version.
    """

    commands = (
        Command("slide", 2, meaning="tip velocity along the chart's sides, over 4 tip radii a second"),
        Command("press", 1, meaning="set point of the normal force over the soft limit; below 0: lift the tip"),
        Command(
            "lesions",
            LESIONS_MOST * len(LESION_NUMBERS),
            meaning="the declared map: presence, place on the chart (2) and radius of each lesion",
        ),
    )
    channels = (
        Channel(
            "place", 2, "", -PLACE_BOUND, PLACE_BOUND, read=lambda task, simulation: task.place,
            meaning="place of the tip on the chart of the palpable face, -1 to 1 along its sides",
        ),
        Channel(
            "tip_depth", 1, "m", lambda task, instrument: -LENGTH_BOUND * _tip_radius(task, instrument),
            lambda task, instrument: LENGTH_BOUND * _tip_radius(task, instrument),
            read=lambda task, simulation: task.tip_depth, scale=_tip_radius, scale_text="tip radius",
            bounds_text="+-1000 tip radii", meaning="depth of the ball below the registered surface at rest",
        ),
        Channel(
            "tip_velocity", 3, "m/s", -SPEED_BOUND, SPEED_BOUND,
            read=lambda task, simulation: task.frame.vector(simulation.instrument.tip_velocity),
            scale=lambda task, instrument: SLIDE_SPEED * _tip_radius(task, instrument),
            scale_text="4 tip radii / s", meaning="tip velocity on the axes of the face: across, along, outward",
        ),
        Channel(
            "contact_force", 3, "N", sensor=1.0,
            read=lambda task, simulation: task.frame.vector(simulation.contact_force), scale=force_scale,
            scale_text="soft limit", meaning="contact force on the tip on these axes, mean of the last haptic step, "
            "through the sensor model",
        ),
        Channel(
            "surface_normal", 3, "", -1.0, 1.0, read=lambda task, simulation: task.frame.vector(task.surface_normal),
            meaning="outward normal of the registered surface below the tip, on these axes",
        ),
        Channel(
            "thickness", 1, "", 0.0, THICKNESS_BOUND, read=lambda task, simulation: task.thickness,
            meaning="thickness of the organ below it over the tip's radius, at most 20",
        ),
        Channel(
            "map_cell", 1, "", 0.0, CELL_BOUND,
            read=lambda task, simulation: task.charted.cell / task.charted.tip_radius,
            meaning="distance between neighbouring sites of the map over the tip's radius",
        ),
        Channel(
            "chart_share", 2, "", 0.0, 1.0,
            read=lambda task, simulation: task.charted.chart.extent / (task.charted.cell * (MAP_SIDE - 1)),
            meaning="lengths of the chart's sides over the map's",
        ),
        TIME_LEFT,
        TAXELS,
        Channel(
            "face_map", _on_map, "", 0.0, 1.0, read=lambda task, simulation: task.charted.touch_map.pressable,
            meaning="with `face`: 1 for each site that may be pressed, on a map of n x n sites as "
            "`SurgSim/PalpateSites-v0` has", size_text="n n or 0",
        ),
    )  # fmt: skip
    # A control step costs at most 0.25 / n: to go on after a safety stop would always have paid more than -0.5.
    rewards = (
        Reward(
            "map", 1.0, "step", "score of the declared map over the number of control steps",
            lambda task, step: task.score / task.episode_steps,
        ),
        Reward(
            "soft_force", -0.25, "step",
            "largest force of the step, 0 at the soft and 1 at the hard limit, over the number of control steps",
            lambda task, step: soft_force_share(task, step) / task.episode_steps,
        ),
        Reward("hard_force", -0.5, "failure", "the force exceeded the hard limit: a safety stop"),
        Reward("fault", -0.5, "failure", "the simulation could not go on"),
    )  # fmt: skip
    setup = Setup(
        scene="liver_family",
        instrument="tactile_probe",
        level="clinical",
        episode_steps=None,
        load=load_slide_scene,
    )
    kept = (
        *("registration", "declared", "place", "tip_depth", "surface_normal", "thickness", "score_sum", "path_length"),
        "last_tip",
    )

    def __init__(self, scenario: Scenario, *, face: bool = False, episode_steps: int | None = None) -> None:
        """Map the lesions of an anatomy.

        Attributes that agents with a view of the truth and scores may read: `true_map`, `lesions`, `charted`,
        `declared`, `error` (OSPA [m]), `dice`.

        Args:
            scenario: with a level.
            face: observe the map of the pressable sites.
            episode_steps: control steps of an episode.

        Raises:
            ValueError: `episode_steps` that is no whole number above 0.
        """
        super().__init__(scenario)
        own_steps = round(EPISODE_TIME / self.anatomy.scene.timing.control_step)
        self.episode_steps = own_steps if episode_steps is None else episode_steps
        if self.episode_steps < 1:
            raise ValueError(f"episode_steps is {episode_steps!r}; it must be a whole number of steps, at least 1")
        self.shows_face = face
        self._forget()
        self._chart()

    def _chart(self) -> None:
        """Take the chart and the frame of the anatomy's face."""
        self.charted = charted_face(self.anatomy)
        self.frame = FaceFrame.of(self.charted)
        self.cutoff = ospa_cutoff(self.charted.tip_radius)

    def _forget(self) -> None:
        """Begin an episode: nothing is declared."""
        self.declared = np.full((LESIONS_MOST, len(LESION_NUMBERS)), -1.0)
        self.registration, self.place, self.surface_normal = np.zeros(3), np.zeros(2), np.zeros(3)
        self.tip_depth = self.thickness = 0.0
        self.score = self.score_sum = self.error = self.dice = self.path_length = 0.0
        self.last_tip: FloatArray | None = None

    # ---- the episode ------------------------------------------------------------------------------------------------

    def draw(self, rng: np.random.Generator) -> FloatArray:
        """Draw the error of registration; the tip waits above a random pressable place."""
        self._chart()
        self._forget()
        assert self.level is not None
        chart = self.charted.chart
        offset = rng.normal(0.0, self.level.map_error, 2) if self.level.map_error else np.zeros(2)
        self.registration = offset[0] * chart.across + offset[1] * chart.along
        sites = self.charted.touch_map.places[self.charted.touch_map.pressable]
        start = self.charted.site(sites[rng.integers(len(sites))])
        return start.point + start.normal * (self.charted.tip_radius + START_GAP)

    @property
    def true_map(self) -> FloatArray:
        """Places on the chart of the face's points nearest to the lesions' centres, and radii [m], (n_lesion, 3)."""
        radii = [lesion.radius for lesion in self.lesions]
        return np.column_stack([self.charted.chart.place(self.drawn.places(self.anatomy)), np.array(radii)])

    def command(self, commands: dict[str, FloatArray], instrument: Instrument) -> None:
        """Slide along the surface toward pressable sites, hold the force along the normal, and keep the map."""
        self.declared = commands["lesions"].reshape(LESIONS_MOST, len(LESION_NUMBERS)).copy()
        chart, radius, duration = self.charted.chart, self.charted.tip_radius, self.anatomy.scene.timing.control_step
        here, slide = chart.plane_point(self.place), commands["slide"]
        # Farther ahead than a cell of the map, so that the tip follows a border in place of stopping there.
        way = self._pressable(here + LOOKAHEAD * radius * slide) - here
        length, speed = float(norm(way)), SLIDE_SPEED * radius * min(float(norm(slide)), 1.0)
        way *= 0.0 if length == 0.0 else min(speed / length, 1.0 / duration)
        normal, outward = self.surface_normal, -self.charted.face.approach
        along = way[0] * chart.across + way[1] * chart.along
        # Along the surface, with the same way on the chart, unless that is steeper than any face.
        along -= outward * float(matmul(along, normal)) / max(float(matmul(outward, normal)), 0.1)
        inward = self._inward_speed(float(commands["press"][0]), duration)
        instrument.command_velocity(along - min(max(inward, -NORMAL_SPEED * radius), NORMAL_SPEED * radius) * normal)

    def _inward_speed(self, press: float, duration: float) -> float:
        """Speed against the normal [m/s] toward a set point of the force over the soft limit."""
        if press < 0.0:
            return -(LIFT_HEIGHT * self.charted.tip_radius + self.tip_depth) / duration
        force = float(matmul(self.frame.in_world(self.sensed["contact_force"]), self.surface_normal))
        missing = press - force / self.limits.soft_force
        return FORCE_GAIN * missing * self.anatomy.scene.palpation.press_depth / duration

    def _pressable(self, target: FloatArray) -> FloatArray:
        """A place of the chart's plane [m] (2,), or that of the nearest pressable site."""
        chart, touch_map = self.charted.chart, self.charted.touch_map
        site = touch_map.nearest(2.0 * (target - chart.lower) / chart.extent - 1.0)
        if site >= 0 and touch_map.pressable[site]:
            return target
        points = chart.lower + touch_map.sites[touch_map.pressable]
        return points[np.argmin(np.square(points - target).sum(axis=1))]

    def update(self, step: ControlStep) -> None:
        """Locate the tip over the registered surface, and score the declared map."""
        simulation = step.simulation
        tip = simulation.instrument.tip_reading
        tip = tip - simulation.ground_shift(tip)
        self.place = self.charted.chart.place(tip)
        registered = tip + self.registration
        surface, self.surface_normal, thickness = self.anatomy.face.below(registered)
        self.tip_depth = self.charted.tip_radius - float(matmul(registered - surface, self.surface_normal))
        self.thickness = min(thickness / self.charted.tip_radius, THICKNESS_BOUND)
        if self.step_count == 0:
            return
        if simulation.contact_centre is not None and self.last_tip is not None:
            self.path_length += float(norm(tip - self.last_tip))
        self.last_tip = tip
        self._judge_map()
        self.score_sum += self.score

    def _judge_map(self) -> None:
        """OSPA, Dice and score of the declared map."""
        chart, truth = self.charted.chart, self.true_map
        shown = self.declared[self.declared[:, 0] > 0.0]
        radii = self.charted.tip_radius * (1.0 + shown[:, 3])
        truth = np.column_stack([chart.plane_point(truth[:, :2]), truth[:, 2]])
        declared = np.column_stack([chart.plane_point(shown[:, 1:3]), radii])
        sites = chart.lower + self.charted.touch_map.sites
        self.error, self.dice = map_errors(sites, truth, declared, self.cutoff)
        self.score = map_score(self.error, self.dice, self.cutoff)

    # ---- judgement --------------------------------------------------------------------------------------------------

    def end(self, step: ControlStep) -> str:
        """Reason of the end: a fault, the hard limit, or the end of the time, "success" or "done"."""
        harm = super().end(step)
        if harm or self.step_count < (self.episode_steps or math.inf):
            return harm
        return "success" if self.error <= SUCCESS_ERROR * self.charted.tip_radius / REFERENCE_TIP else "done"

    def info(self, step: ControlStep | None, end: str) -> dict[str, InfoValue]:
        """Entries of `Task.info`, and of the declared map."""
        return {
            **super().info(step, end),
            "error_mm": -1.0 if step is None else self.error * 1000.0,
            "dice": self.dice,
            "map_score": self.score_sum / (self.episode_steps or 1),
            "path_length": self.path_length,
            **self._true_map(shown=bool(end)),
        }

    def _true_map(self, *, shown: bool) -> dict[str, InfoValue]:
        """The true map as an action would declare it; -1 if it is not shown."""
        rows = np.full((LESIONS_MOST, len(LESION_NUMBERS)), -1.0)
        if shown:
            for row, (across, along, radius) in zip(rows, self.true_map):
                row[:] = 1.0, across, along, radius / self.charted.tip_radius - 1.0
        return {
            f"lesion_{number}_{name}": value
            for number, row in enumerate(rows.tolist(), start=1)
            for name, value in zip(LESION_NUMBERS, row, strict=True)
        }
