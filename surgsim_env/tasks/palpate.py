"""Palpation: find one hidden lesion by touch and declare it while pressing on it."""

import math
from collections.abc import Callable
from typing import Literal

import numpy as np

from msdm_core.arithmetic import exp, matmul
from msdm_core.material.regions import Lesion
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.instrument import Instrument
from surgsim_env.palpation.chart import MAP_SIDE, charted_face
from surgsim_env.palpation.face_frame import FaceFrame
from surgsim_env.palpation.touches import EXCESS_BOUND, Indenter, TouchMemory, felt_lesion_radius
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.scene.load import require_known
from surgsim_env.tasks.channels import (
    CONTACT_FORCE,
    TAXELS,
    TIME_LEFT,
    TIP_POSITION,
    TIP_VELOCITY,
    force_scale,
    soft_force_share,
)
from surgsim_env.tasks.declaration import SPEED_FULL_SCALE, Channel, Command, ControlStep, Reward, Setup
from surgsim_env.tasks.palpate_sites import CELL_BOUND, WIDE
from surgsim_env.tasks.task import InfoValue, Scenario, Task

# Control steps of an episode, for steps of 50 ms; EPISODE_STEPS_WIDE where the chart's longer side exceeds WIDE tip
# radii.
EPISODE_STEPS, EPISODE_STEPS_WIDE = 600, 1200
# Axes of commands.
FRAMES = ("world", "face")
# Bound of the depth and of the place of the tip over its radius, beyond any workspace.
PLACE_BOUND = 1000.0
# Largest force of a sensor over its range on each axis, on turned axes, with room for rounding.
FORCE_SLACK = math.sqrt(3.0) * (1.0 + 1e-6)
DECLARE_VALUE = 0.8
DECLARE_STEPS = 3
# Duration of a control step for which these numbers of steps are stated [s].
CONTROL_STEP = 0.05

# Height of the tip ball above the surface at the start [m].
START_GAP = (0.002, 0.006)


def touch_memory(anatomy: Anatomy) -> TouchMemory:
    """An empty memory for an anatomy's palpable face and its scene's sensor."""
    scene = anatomy.scene
    return TouchMemory(
        charted_face(anatomy),
        Indenter(scene.instrument.tip_radius, scene.material),
        press_depth=scene.palpation.press_depth,
        lesion_radius=felt_lesion_radius(scene),
        force_range=scene.sensor.range,
        force_noise=scene.sensor.noise,
    )


def _with_maps(size: int) -> Callable[["PalpateTask"], int]:
    """Size of a channel of memory=True."""
    return lambda task: 0 if task.memory is None or task.summarised else size


def _with_summary(size: int) -> Callable[["PalpateTask"], int]:
    """Size of a channel of memory="summary"."""
    return lambda task: size if task.summarised else 0


def _stiffest_bound(task: "PalpateTask", instrument: Instrument) -> FloatArray:
    assert task.memory is not None
    return np.array([1.0, 1.0, task.memory.bound])


def _in_frame(size: int, *, memory: bool = False) -> Callable[["PalpateTask"], int]:
    """Size of a channel of frame="face"; with `memory` of memory=True alone."""
    return lambda task: size if task.frame is not None and (not memory or _with_maps(1)(task)) else 0


def _tip_radius(task: "PalpateTask", instrument: Instrument | None) -> float:
    return task.anatomy.scene.instrument.tip_radius


def _step_weight(task: "PalpateTask", step: ControlStep) -> float:
    """Weight of a control step: episodes of any length cost alike, and a lesion's detection always pays."""
    assert task.episode_steps is not None
    return EPISODE_STEPS / task.episode_steps


class PalpateTask(Task):
    """Find a hidden lesion by touch.

    ## Description
    A robot's ball tip presses a soft organ (a tetrahedral mass-spring-damper model, Sala et al. 2011) with one stiff
    lesion hidden under its surface. Tissue and tip exchange forces 1000 times a second; the agent acts 20 times a
    second. It succeeds by pressing on the lesion and declaring it.

    ## Action Space
    `Box(-1, 1, (4,), float32)`

    ## Observation Space
    `Box((11,), float32)`, all bounds finite. `env.unwrapped.observation_slices` has the entries of each channel by its
    name.

    With `memory="summary"` seven numbers more, enough for a small network: how much of the face was felt, and the ways
    to the stiffest place and to fresh sites. With `memory=True` `Box((5057,), float32)`: what the sensor felt so far
    (`surgsim_env.palpation.touches`) on a map of n = 41 x 41 sites, 0.4 tip radii apart, over the middle of the
    palpable face (`surgsim_env.palpation.chart`), row by row, the same size for every organ; farther apart where 16 tip
    radii do not span the face.

    An instrument with taxels has three numbers more for each (`scenes/README.md`).

    With `frame="face"` nine numbers more, with `memory=True` 12: where the tip is on the organ's registered surface at
    rest, in tip radii and on the axes of its face (`surgsim_env.palpation.face_frame`), which commands are along too.
    A policy that reads these and the maps alone can play organs of any size and pose.

    ## Rewards
    `info["reward_<term>"]` shows what each term paid. A failure (a wrong declaration, the hard limit, a fault) also
    costs as much as the most expensive control step for each control step left, so that continuing the search never
    pays less.

    ## Starting State
    Radius, cover and modulus ratio of the lesion, its place on the palpable face, the sensor's bias and the tip's place
    2 to 6 mm above the surface are drawn for each episode from the ranges of the scene file. The organ is at rest. With
    a `level` the organ's modulus and a capsule are drawn too, and lesions and sensor have the level's ranges
    (`surgsim_env.scene.levels`).

    ## Episode End
    Terminated: the lesion was declared (success within the radius of the smallest lesion that the scene hides, measured
    along the surface from the point nearest to its centre: 6 mm on `phantom`, 18 mm on `liver`); the contact
    force exceeded the hard limit in a haptic step; the simulation faulted (`info["sim_fault"]` says how, the
    observation is the last finite one). Truncated: 600 control steps (30 s), or 1200 (60 s) where the chart of the face
    is longer than ten tip radii, as on `liver`; fewer of a longer `control_step`, which last as long.

    ## Info
    Fixed keys and types: `sim_fault` (str, "" if none), `sensor_saturated`, `workspace_limited` (by the box, or by an
    arm's joint and speed limits), `hard_limit`, `declared`, `success`, `is_success` (bool), `force_peak` [N], `cost`
    (force above the soft limit, 1 at the hard one: a constraint for safe learning), `error_mm` (-1 if nothing was
    declared), `trocar_error_mm` (distance of the shaft's axis from the trocar; -1 for the probe, which passes
    through none), `added_mass` [kg] (by mass scaling, 0 without and after a reset), one `reward_<term>` each.
    Where the scene is a family of organs also `member` (str), the one that the episode plays, such as "train 7".
    Where the scene has `[limits] pressure`, `strain` or `dose`, and with `measure_tissue`, also `tissue_pressure` [Pa]
    and `tissue_strain`, the largest of the tissue at the end of the step, `tissue_extrapolated` (bool): strain beyond
    `strain_supported` of the material's stiffening, and `damaged` (bool): more than a limit is a safety stop. With
    `dose` also `tissue_dose` [Pa s], the largest integral of pressure over time at a place of the surface so far: a
    step adds its duration times the pressure at its end.

    ## Arguments
    * `scene`: a scene's name (`surgsim_env.list_scenes()`) or the path of a scene file; default "phantom".
    * `instrument`: "probe", "tactile_probe" (a probe with taxels), the name of an arm (`surgsim_env.list_arms()`, such
      as "psm_palpator") or the path of an arm's TOML file (docs/arms.md); by default the scene's own. An arm enters the
      body at the scene's `[port]`, and its tip points along the scene's approach as far as its joints allow.
    * `motion`: "none", "calm" or "free": how the patient breathes (docs/motion.md); by default as the scene says.
    * `level`: "easy", "standard", "hard" or "clinical" (`surgsim_env.scene.levels`); None, the default: the scene's own
      ranges.
    * `memory`: False (default): the agent has to remember by itself; True: maps of what was felt so far; "summary": the
      seven numbers of a search.
    * `frame`: "world" (default), or "face": the velocity command is along the axes of the palpable face, across, along
      and outward, and the observation has the channels of that frame.
    * `episode_steps`: control steps until truncation; by default 600 or 1200, as above.
    * `split`: "train" (default), "validation" or "test": members of a family of organs, such as scene "liver_family",
      of which each episode draws one; `info["member"]` names it.

    ## Version History
    * v0: first version.
    """

    commands = (
        Command(
            "velocity",
            3,
            SPEED_FULL_SCALE,
            "m/s",
            "tip velocity along x, y, z, or along the axes of `frame`",
            axes=lambda task: None if task.frame is None else task.frame.axes,
        ),
        Command("declare", 1, meaning='above 0.8 for 0.15 s (3 control steps), in contact: "the lesion is here"'),
    )
    channels = (
        TIP_POSITION,
        TIP_VELOCITY,
        CONTACT_FORCE,
        TIME_LEFT,
        Channel(
            "contrast", _with_maps(MAP_SIDE * MAP_SIDE),
            low=lambda task, instrument: -task.memory.bound,
            high=lambda task, instrument: task.memory.bound,
            read=lambda task, simulation: task.memory.contrast,
            meaning="with `memory`: force over healthy tissue's at that depth, for each site; 0 where nothing was felt",
            felt=True, size_text="n or 0", bounds_text="+-bound",
        ),
        Channel(
            "visited", _with_maps(MAP_SIDE * MAP_SIDE), "", 0.0, 1.0,
            read=lambda task, simulation: task.memory.visited,
            meaning="with `memory`: 1 for each site where something was felt", size_text="n or 0",
        ),
        Channel(
            "face", _with_maps(MAP_SIDE * MAP_SIDE), "", 0.0, 1.0,
            read=lambda task, simulation: task.memory.map.pressable,
            meaning="with `memory`: 1 for each site that lies on the palpable face", size_text="n or 0",
        ),
        Channel(
            "stiffest", _with_maps(3),
            low=lambda task, instrument: -_stiffest_bound(task, instrument), high=_stiffest_bound,
            read=lambda task, simulation: task.memory.stiffest(),
            meaning="with `memory`: where on the face's chart it is stiffest, by a fit, and the contrast there",
            felt=True, size_text="3 or 0", bounds_text="+-1, +-bound",
        ),
        Channel(
            "tip_place", _in_frame(3), "m",
            low=lambda task, instrument: -PLACE_BOUND * _tip_radius(task, instrument),
            high=lambda task, instrument: PLACE_BOUND * _tip_radius(task, instrument),
            read=lambda task, simulation: task.frame.point(task.resting_place(simulation)),
            meaning='with `frame="face"`: tip position from the middle of the chart, on the axes of the face',
            size_text="3 or 0", bounds_text="+-1000 tip radii", scale=_tip_radius, scale_text="tip radius",
        ),
        Channel(
            "tip_depth", 1, "m",
            low=lambda task, instrument: -PLACE_BOUND * _tip_radius(task, instrument),
            high=lambda task, instrument: PLACE_BOUND * _tip_radius(task, instrument),
            read=lambda task, simulation: task.tip_depth,
            meaning="depth of the ball below the surface at rest",
            bounds_text="+-1000 tip radii", scale=_tip_radius, scale_text="tip radius",
        ),
        Channel(
            "surface_normal", _in_frame(3), "", -1.0, 1.0,
            read=lambda task, simulation: task.frame.vector(task.surface_normal),
            meaning='with `frame="face"`: outward normal of the surface at rest where it is nearest to the tip',
            size_text="3 or 0",
        ),
        Channel(
            "face_force", _in_frame(3), "N",
            low=lambda task, instrument: -FORCE_SLACK * task.anatomy.scene.sensor.range,
            high=lambda task, instrument: FORCE_SLACK * task.anatomy.scene.sensor.range,
            read=lambda task, simulation: task.frame.vector(task.sensed["contact_force"]),
            meaning='with `frame="face"`: `contact_force` on the axes of the face', felt=True,
            size_text="3 or 0", bounds_text="+-sqrt(3) range", scale=force_scale, scale_text="soft limit",
        ),
        Channel(
            "map_cell", _in_frame(1, memory=True), "", 0.0, CELL_BOUND,
            read=lambda task, simulation: task.charted.cell / task.charted.tip_radius,
            meaning='with `frame="face"` and `memory`: distance between neighbouring sites over the tip\'s radius',
            size_text="1 or 0",
        ),
        Channel(
            "chart_share", _in_frame(2, memory=True), "", 0.0, 1.0,
            read=lambda task, simulation: task.charted.chart.extent / (task.charted.cell * (MAP_SIDE - 1)),
            meaning='with `frame="face"` and `memory`: lengths of the chart\'s sides over the map\'s',
            size_text="2 or 0",
        ),
        Channel(
            "felt_share", _with_summary(1), "", 0.0, 1.0,
            read=lambda task, simulation: task.searched[:1],
            meaning='with `memory="summary"`: share of the face\'s sites where something was felt', size_text="1 or 0",
        ),
        Channel(
            "mean_contrast", _with_summary(1),
            low=lambda task, instrument: -task.memory.bound,
            high=lambda task, instrument: task.memory.bound,
            read=lambda task, simulation: task.searched[1:2],
            meaning='with `memory="summary"`: mean contrast of the felt sites',
            felt=True, size_text="1 or 0", bounds_text="+-bound",
        ),
        Channel(
            "stiffest_excess", _with_summary(1), "", -EXCESS_BOUND, EXCESS_BOUND,
            read=lambda task, simulation: task.searched[2:3],
            meaning='with `memory="summary"`: contrast of the stiffest place over that mean, less 1',
            felt=True, size_text="1 or 0", scale=0.25,
        ),
        Channel(
            "stiffest_way", _with_summary(2), "m",
            low=lambda task, instrument: -PLACE_BOUND * _tip_radius(task, instrument),
            high=lambda task, instrument: PLACE_BOUND * _tip_radius(task, instrument),
            read=lambda task, simulation: task.searched[3:5],
            meaning='with `memory="summary"`: from the tip to the stiffest place, along the sides of the face\'s chart',
            felt=True, size_text="2 or 0", bounds_text="+-1000 tip radii", scale=_tip_radius, scale_text="tip radius",
        ),
        Channel(
            "unfelt_way", _with_summary(2), "m",
            low=lambda task, instrument: -PLACE_BOUND * _tip_radius(task, instrument),
            high=lambda task, instrument: PLACE_BOUND * _tip_radius(task, instrument),
            read=lambda task, simulation: task.searched[5:],
            meaning='with `memory="summary"`: from the tip to the middle of the sites around it that are not felt yet',
            size_text="2 or 0", bounds_text="+-1000 tip radii", scale=_tip_radius, scale_text="tip radius",
        ),
        TAXELS,
    )  # fmt: skip
    rewards = (
        Reward("time", -0.005, "step", "each control step, times 600 over those of the episode", _step_weight),
        Reward(
            "soft_force", -0.010, "step",
            "largest force of the step, 0 at the soft and 1 at the hard limit, times 600 over the steps of the episode",
            lambda task, step: _step_weight(task, step) * soft_force_share(task, step),
        ),
        Reward("found", 10.0, "success", "declared within the success distance"),
        Reward("wrong", -5.0, "failure", "declared elsewhere"),
        Reward("hard_force", -5.0, "failure", "the force exceeded the hard limit: a safety stop"),
        Reward("fault", -5.0, "failure", "the simulation could not go on"),
        Reward(
            "forgone", -0.015, "step left", "the most expensive control step, so that a failure pays less",
            lambda task, step: _step_weight(task, step) * (task.episode_steps - task.step_count),
        ),
    )  # fmt: skip
    # The number of control steps follows from the size of the face.
    setup = Setup(lesion_count=1, episode_steps=None)
    kept = ("declare_count", "_declare_value", "readings")

    def __init__(
        self,
        scenario: Scenario,
        *,
        memory: bool | Literal["summary"] = False,
        frame: str = "world",
        episode_steps: int | None = None,
    ) -> None:
        """Palpate an anatomy.

        Args:
            scenario: of a scene with the ranges of a lesion.
            memory: the observation holds maps of the readings so far, or their "summary".
            frame: "world", or "face": commands and observations of the tip along the axes of the face.
            episode_steps: control steps of an episode; by default 600, or 1200 on a face longer than ten tip radii.

        Raises:
            ValueError: a scene without a [lesion] table, an unknown memory or frame (names the known), or
                `episode_steps` that is no whole number above 0.
        """
        scene = scenario.anatomy.scene
        if scene.lesion is None:
            raise ValueError(
                f"scene {scene.name!r} has no [lesion] table, so that there is nothing to find in it: "
                "add one, or take a scene that has it, such as 'phantom'"
            )
        if memory not in (False, True, "summary"):
            raise ValueError(f'memory is {memory!r}; it must be False, True or "summary"')
        require_known("frame", frame, FRAMES)
        if episode_steps is not None and episode_steps < 1:
            raise ValueError(f"episode_steps is {episode_steps!r}; it must be a whole number of steps, at least 1")
        super().__init__(scenario)
        self.charted = charted_face(self.anatomy)
        wide = self.charted.chart.extent.max() > WIDE * self.charted.tip_radius
        # The members of a family have the number of their template.
        share = CONTROL_STEP / scene.timing.control_step
        self.episode_steps = episode_steps or max(1, round(share * (EPISODE_STEPS_WIDE if wide else EPISODE_STEPS)))
        self.declare_steps = max(1, round(share * DECLARE_STEPS))
        self.memory = touch_memory(self.anatomy) if memory else None
        self.summarised = memory == "summary"
        # `TouchMemory.summary` of the tip's place.
        self.searched = np.zeros(7)
        self.frame = FaceFrame.of(self.charted) if frame == "face" else None
        # Depth of the ball below the surface at rest [m], and the outward normal there.
        self.tip_depth, self.surface_normal = 0.0, np.zeros(3)
        self.declare_count = 0
        self._declare_value = 0.0
        self._error: float | None = None

    def _chart(self) -> None:
        """Take the chart of the episode's member, an empty memory on it, and its frame."""
        if self.charted is (charted := charted_face(self.anatomy)):
            return
        self.charted = charted
        if self.memory is not None:
            self.memory = touch_memory(self.anatomy)
        if self.frame is not None:
            self.frame = FaceFrame.of(charted)

    @property
    def success_distance(self) -> float:
        """Largest distance of a right declaration from the lesion [m]: a blind one succeeds in at most 20 %."""
        assert self.anatomy.scene.lesion is not None
        return self.anatomy.scene.lesion.radius[0]

    @property
    def lesion(self) -> Lesion | None:
        """The lesion of the episode; None before the first."""
        return self.lesions[0] if self.lesions else None

    def draw(self, rng: np.random.Generator) -> FloatArray:
        """Draw the tip's place above the palpable face, and forget the last episode."""
        self._chart()
        self.declare_count = 0
        self._declare_value = 0.0
        if self.memory is not None:
            self.memory.forget()
        above, outward = self.anatomy.face.random_point(rng, self.anatomy.scene.palpation.face_margin)
        gap = self.anatomy.scene.instrument.tip_radius + rng.uniform(*START_GAP)
        return above + outward * gap

    def command(self, commands: dict[str, FloatArray], instrument: Instrument) -> None:
        """Command the tip's velocity, and keep the declared value."""
        super().command(commands, instrument)
        self._declare_value = float(commands["declare"][0])

    def resting_place(self, simulation: Simulation) -> FloatArray:
        """Tip position by the encoders relative to the organ at rest [m], (3,): less the ground's displacement."""
        tip = simulation.instrument.tip_reading
        return tip - simulation.ground_shift(tip)

    def update(self, step: ControlStep) -> None:
        """Measure the ball's depth below the surface at rest, and add the force reading to the memory."""
        memory = self.memory
        tip = self.resting_place(step.simulation)
        surface, normal = self.anatomy.face.project(tip)
        depth = self.charted.tip_radius - float(matmul(tip - surface, normal))
        self.tip_depth, self.surface_normal = depth, normal
        if memory is not None:
            place = memory.chart.place(surface)
            memory.feel(place, depth, float(matmul(self.sensed["contact_force"], normal)))
            if self.summarised:
                self.searched = memory.summary(place)

    def potential(self, step: ControlStep) -> float:
        """Potential for `shaping`: exp(-d / (1.5 r)) + s / 5, from the truth.

        With the tip's distance d from a press of the scene's depth, three quarters deep, on the surface over the
        lesion, the tip's radius r, and with memory the felt share s of the face.
        """
        assert self.lesion is not None and self.lesion.centre is not None
        radius, depth = self.charted.tip_radius, self.anatomy.scene.palpation.press_depth
        over, outward = self.anatomy.face.project(self.lesion.centre)
        way = self.resting_place(step.simulation) - (over + outward * (radius - 0.75 * depth))
        felt = 0.0 if self.memory is None else float(self.memory.visited[self.memory.map.pressable].mean())
        return float(exp(-math.sqrt(float(matmul(way, way))) / (1.5 * radius))) + 0.2 * felt

    def end(self, step: ControlStep) -> str:
        """Reason of the end: a fault, the hard limit, or a declaration, "found" or "wrong"."""
        end = super().end(step)
        declared = not end and self._declares(step.simulation)
        self._error = self.declared_error(step.simulation) if declared else None
        if self._error is None:
            return end
        return "found" if self._error <= self.success_distance else "wrong"

    def info(self, step: ControlStep | None, end: str) -> dict[str, InfoValue]:
        """Entries of `Task.info` and of the declaration, with its error."""
        declared = end in ("found", "wrong")
        assert not declared or self._error is not None
        return {
            **super().info(step, end),
            "declared": declared,
            "error_mm": self._error * 1000.0 if declared and self._error is not None else -1.0,
        }

    def _declares(self, simulation: Simulation) -> bool:
        pressing = self._declare_value > DECLARE_VALUE and simulation.contact_centre is not None
        self.declare_count = self.declare_count + 1 if pressing else 0
        return self.declare_count >= self.declare_steps

    def declared_error(self, simulation: Simulation) -> float:
        """Distance along the resting surface from the touched patch to the point nearest to the lesion's centre [m]."""
        place = simulation.contact_centre
        assert self.lesion is not None and self.lesion.centre is not None and place is not None
        truth, _ = self.anatomy.face.project(self.lesion.centre)
        return float(self.anatomy.along_surface(truth, place[None])[0])

    @property
    def readings(self) -> FloatArray | None:
        """Sums of the memory, product and square (2, n_site); None without memory."""
        return None if self.memory is None else np.array([self.memory.product, self.memory.square])

    @readings.setter
    def readings(self, sums: FloatArray | None) -> None:
        self._chart()
        self.memory = None if self.memory is None or sums is None else self.memory.restored(*sums)
