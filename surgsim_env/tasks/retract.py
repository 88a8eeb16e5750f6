"""Retraction of a lobe, grasped near its free edge, from a target in the endoscope's view."""

import json
import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any, ClassVar, Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import cbrt, cos, norm, sin
from msdm_core.kernels.structure_kernels import OrganModel
from msdm_core.material.regions import Capsule, Lesion
from msdm_core.mesh.tet_mesh import FloatArray, IntArray
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.instrument import Grasp, Instrument
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.scene.load import fill, make_retract_scene
from surgsim_env.scene.model import Endoscope, Retraction, RetractionCamera, Vector
from surgsim_env.tasks.channels import (
    LENGTH_SCALE,
    TIME_LEFT,
    TIP_POSITION,
    TIP_VELOCITY,
    force_scale,
    soft_force_share,
)
from surgsim_env.tasks.declaration import SPEED_FULL_SCALE, Channel, Command, ControlStep, Reward, Setup
from surgsim_env.tasks.task import InfoValue, Pictured, Scenario, Task
from surgsim_env.tasks.visibility import Disc, hiding_geoms, visible

EPISODE_STEPS = 600
# Full scale of a command to turn the wrist [rad/s].
TURNING_FULL_SCALE = 0.5
# Visible share of the target and its duration [s] for success.
SUCCESS_SHARE = 0.8
SUCCESS_TIME = 0.5
# Largest visible share of the target at the start of an episode.
HIDDEN_SHARE = 0.1

# The torque sensor is the force sensor times this lever [m].
TORQUE_LEVER = 0.01
# Bounds of the observation beyond the lobe [m], on unit vectors, on the jaw's opening [m] and on forces [N].
LOBE_SLACK = 0.1
AXIS_BOUND = 1.0 + 1e-6
OPENING_BOUND = 0.1
FORCE_BOUND = 200.0
# Observed points of the lobe, as shares of its length along the edge, its depth and its thickness: a
# row on the free edge, and one half way to the held edge.
ALONG = (0.0, 0.25, 0.5, 0.75, 1.0)
TRACKED = tuple((along, depth, 1.0) for depth in (1.0, 0.5) for along in ALONG)


def _lobe_lower(task: "RetractTask", instrument: Instrument) -> FloatArray:
    return np.tile(task.anatomy.mesh.points.min(axis=0) - LOBE_SLACK, len(ALONG))


def _lobe_middle(task: "RetractTask", instrument: Instrument) -> FloatArray:
    return 0.5 * (_lobe_lower(task, instrument) + _lobe_upper(task, instrument))


def _lobe_upper(task: "RetractTask", instrument: Instrument) -> FloatArray:
    return np.tile(task.anatomy.mesh.points.max(axis=0) + LOBE_SLACK, len(ALONG))


@dataclass(frozen=True)
class RetractionDraw:
    """One episode's draw, SI units.

    Args:
        scale: factor on the whole lobe.
        youngs_modulus: of its tissue [Pa].
        capsule_stiffness: modulus times thickness of its capsule [N/m], 0 without one.
        held_share: held share of the anchored edge.
        target: centre of the disc on the bed [m].
        eye, looks_at: position of the endoscope and a point in the middle of its view [m].
        start: the tip's place [m].
    """

    scale: float
    youngs_modulus: float
    capsule_stiffness: float
    held_share: float
    target: Vector
    eye: Vector
    looks_at: Vector
    start: Vector
    # A lobe has none.
    lesions: ClassVar[tuple[Lesion, ...]] = ()

    @classmethod
    def draw(cls, anatomy: Anatomy, rng: np.random.Generator, *_: Any) -> Self:
        """Draw from the ranges of a scene's [retract] table, around its endoscope; a lobe has no level or lesions."""
        table, endoscope = anatomy.scene.retract, anatomy.scene.endoscope
        assert table is not None and endoscope is not None
        scale, modulus = float(rng.uniform(*table.scale)), float(rng.uniform(*table.youngs_modulus))
        capsule = float(rng.uniform(*table.capsule_stiffness)) if rng.uniform() < table.capsule_share else 0.0
        held = float(rng.uniform(*table.held_share))
        along, distance = float(rng.uniform(*table.target_along)), float(rng.uniform(*table.target_distance))
        eye, looks_at = _moved(endoscope, table.camera, rng)
        start = rng.uniform(table.start_lower, table.start_upper)
        target = (along, distance, TARGET_LIFT)
        return cls(scale, modulus, capsule, held, target, _vector(eye), _vector(looks_at), _vector(start))

    def to_json(self) -> str:
        """The draw as JSON, with numbers written exactly."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str, anatomy: Anatomy) -> Self:
        """The draw of a text from `to_json`."""
        return fill(cls, json.loads(text), "drawn")

    def compiled(self, anatomy: Anatomy) -> OrganModel:
        """The lobe of the episode, compiled."""
        plain = anatomy.specification()
        mesh = anatomy.mesh
        capsule = plain.capsule
        if self.capsule_stiffness > 0.0:
            capsule = Capsule(self.capsule_stiffness / CAPSULE_THICKNESS, CAPSULE_THICKNESS)
        specification = replace(
            plain,
            mesh=mesh.scaled(self.scale),
            materials=replace(anatomy.scene.material, youngs_modulus=self.youngs_modulus),
            capsule=capsule,
            anchors=held_nodes(mesh.points, anatomy.anchors, self.held_share),
        )
        return anatomy.compiled(specification)


class RetractTask(Task):
    """Grasp a lobe and fold it back until the endoscope sees the target under it.

    ## Description
    A lobe of soft tissue, held along one edge, lies on its bed and hides a disc. A robot's jaw grasps it near its free
    edge, with friction alone, and lifts or folds it until the endoscope sees at least 80 % of the disc for half a
    second while the jaw holds tissue. Tissue and jaw exchange forces 1000 times a second; the agent acts 20 times a
    second.

    ## Action Space
    `Box(-1, 1, (4 + n,), float32)`; n numbers turn the wrist: 0 for an instrument that does not turn, 1 or 3.

    ## Observation Space
    `Box((50,), float32)`, all bounds finite; 6 more (`tip_axes`) for an instrument that turns.
    `env.unwrapped.observation_slices` has the entries of each channel by its name. With `obs_mode="rgb"` it is the
    endoscope's picture instead: `Box(0, 255, (84, 84, 3), uint8)`.

    ## Rewards
    `info["reward_<term>"]` shows what each term paid. `visible` and `grasped` pay the change of their value, so that
    neither can be earned twice. An episode that ends in failure pays less than any that is truncated.

    ## Starting State
    The lobe's size and stiffness, its capsule, the held share of its edge, the target's place, the endoscope's pose,
    the sensors' biases and the tip's place are drawn for each episode from the ranges of the scene file. The lobe rests
    settled on its bed, the jaw is open, and at most 10 % of the target is visible: other draws are repeated.

    ## Episode End
    Terminated: 80 % of the target was visible for 0.5 s with tissue held between the pads (success; a shut jaw that
    scoops the lobe up does not succeed); in a haptic step the contact force exceeded the hard limit, or the jaw's pull
    exceeded the strength of the tissue; the simulation faulted (`info["sim_fault"]` says how, the observation is the
    last finite one). Truncated: 600 control steps (30 s).

    ## Info
    Fixed keys and types. Of the step: `sim_fault` (str, "" if none), `sensor_saturated`, `workspace_limited`,
    `hard_limit`, `torn`, `success`, `is_success`, `holds` (bool), `visible` (share), `grip_force`, `pull_force`,
    `friction_left` (what friction could still hold) and `force_peak` [N], `trocar_error_mm`, `added_mass` [kg], one
    `reward_<term>` each. Of the episode so far: `grip_force_peak`, `grip_force_mean`, `pull_force_peak`,
    `pull_force_mean` [N] (means over the steps that held something), `pull_impulse` [N s], `slips` (holds that began to
    slip, or were lost while the jaw was commanded to close), `path_length` of the tip [m], `strain_held`,
    `strain_middle`, `strain_free`: largest strain of an edge of the mesh in the lobe's thirds, from the held edge to
    the free one.
    Where the scene has `[limits] pressure`, `strain` or `dose`, and with `measure_tissue`, also `tissue_pressure` [Pa]
    and `tissue_strain`, the largest of the tissue at the end of the step, `tissue_extrapolated` (bool): strain beyond
    `strain_supported` of the material's stiffening, and `damaged` (bool): more than a limit is a safety stop. With
    `dose` also `tissue_dose` [Pa s], the largest integral of pressure over time at a place of the surface so far: a
    step adds its duration times the pressure at its end.

    ## Arguments
    * `scene`: a scene's name or the path of a scene file with a `[retract]` table, or that names such a file, as
      those of `surgsim organ` do; default "lobe".
    * `instrument`: the scene's own by default, or the name of an arm with a jaw, or the path of its TOML file.
    * `motion`: "none", "calm" or "free": how the patient breathes (docs/motion.md); by default as the scene says.

    ## Version History
    * v0: first version.
    """

    commands: ClassVar[tuple[Command, ...]] = (
        Command("velocity", 3, SPEED_FULL_SCALE, "m/s", "tip velocity along x, y, z"),
        Command(
            "turning", lambda task: task.turning_size, TURNING_FULL_SCALE, "rad/s", "rotation of the tip",
            size_text="0, 1 or 3",
        ),
        Command(
            "jaw", 1, meaning="target of the jaw, which moves at its limited speed: -1 closed, 1 open",
            default=lambda task: task.jaw_target,
        ),
    )  # fmt: skip
    channels: ClassVar[tuple[Channel, ...]] = (
        replace(TIP_POSITION, bounds_text="the lobe's bounding box with a margin"),
        TIP_VELOCITY,
        Channel(
            "tip_axes", lambda task: 6 if task.turning_size else 0, "", -AXIS_BOUND, AXIS_BOUND,
            read=lambda task, simulation: tip_axes(simulation.instrument),
            meaning="the tip's x and z axes in the world, of an instrument that turns", size_text="6 or 0",
        ),
        Channel(
            "opening", 1, "m", -OPENING_BOUND, OPENING_BOUND,
            read=lambda task, simulation: task.grasp.opening, meaning="gap between the pads", scale=LENGTH_SCALE,
        ),
        Channel(
            "contact_force", 3, "N", sensor=1.0, read=lambda task, simulation: jaw_wrench(simulation)[0],
            meaning="contact force on the jaw, mean of the last haptic step, through the sensor model",
            scale=force_scale, scale_text="soft limit",
        ),
        Channel(
            "contact_torque", 3, "N m", sensor=TORQUE_LEVER, read=lambda task, simulation: jaw_wrench(simulation)[1],
            meaning="its torque about the tip, likewise; its range is the force sensor's times 10 mm",
            scale=lambda task, instrument: TORQUE_LEVER * force_scale(task, instrument),
            scale_text="soft limit x 10 mm",
        ),
        Channel(
            "grip_force", 1, "N", 0.0, FORCE_BOUND, felt=True, read=lambda task, simulation: task.grasp.grip_force,
            meaning="the smaller of the two pads' normal forces", scale=force_scale, scale_text="soft limit",
        ),
        Channel(
            "pull_force", 1, "N", 0.0, FORCE_BOUND, felt=True, read=lambda task, simulation: task.grasp.pull_force,
            meaning="size of the sum of both fingers' forces", scale=force_scale, scale_text="soft limit",
        ),
        Channel(
            "holds", 1, "", 0.0, 1.0, read=lambda task, simulation: float(task.grasp.holds),
            meaning="1 where both pads press tissue",
        ),
        Channel(
            "edge_points", 3 * len(ALONG), "m", _lobe_lower, _lobe_upper,
            read=lambda task, simulation: simulation.organ_state.node_position[task.tracked_nodes[: len(ALONG)]],
            meaning="five points of the free edge, on top, along x", bounds_text="the lobe's box and 0.1 m",
            scale=LENGTH_SCALE, origin=_lobe_middle,
        ),
        Channel(
            "middle_points", 3 * len(ALONG), "m", _lobe_lower, _lobe_upper,
            read=lambda task, simulation: simulation.organ_state.node_position[task.tracked_nodes[len(ALONG) :]],
            meaning="five points half way to the held edge, likewise", bounds_text="the lobe's box and 0.1 m",
            scale=LENGTH_SCALE, origin=_lobe_middle,
        ),
        Channel(
            "visible", 1, "", 0.0, 1.0, read=lambda task, simulation: task.visible_share,
            meaning="share of the target that the endoscope sees",
        ),
        Channel(
            "target_place", 2, "m",
            low=lambda task, instrument: [task.table.target_along[0], task.table.target_distance[0]],
            high=lambda task, instrument: [task.table.target_along[1], task.table.target_distance[1]],
            read=lambda task, simulation: task.drawn.target[:2],
            meaning="x and y of the target", bounds_text="the scene's ranges", scale=LENGTH_SCALE,
            origin=lambda task, instrument: [np.mean(task.table.target_along), np.mean(task.table.target_distance)],
        ),
        TIME_LEFT,
    )  # fmt: skip
    # `visible` and `grasped` are CHANGES of numbers in [0, 1]: over an episode they sum to the last value less the
    # first (at most 0.1 visible, nothing grasped), however often it is won and lost again. The worst full episode of n
    # steps returns at least n (time + soft_force) - 0.1 visible; one that fails after k steps at most
    # k time + visible + grasped + failure + (n - k) forgone. As forgone = time + soft_force, the first is larger by
    #   -0.1 visible + k soft_force - visible - grasped - failure  >=  -0.4 - 600 x 0.01 - 4 - 1 + 12  =  0.6  at least:
    # a failed, faulted or aborted episode never returns more than the worst full one.
    rewards: ClassVar[tuple[Reward, ...]] = (
        Reward("time", -0.005, "step", "each control step"),
        Reward(
            "soft_force", -0.010, "step", "largest force of the step, 0 at the soft and 1 at the hard limit",
            soft_force_share,
        ),
        Reward("visible", 4.0, "change", "share of the target that is visible", lambda task, step: task.visible_share),
        Reward("grasped", 1.0, "change", "1 while tissue is between the pads", lambda task, step: task.grasp.holds),
        Reward("success", 10.0, "success", "visible for long enough, in a grasp"),
        Reward("torn", -12.0, "failure", "the jaw pulled harder than the tissue bears"),
        Reward("hard_force", -12.0, "failure", "the force exceeded the hard limit: a safety stop"),
        Reward("fault", -12.0, "failure", "the simulation could not go on"),
        Reward("forgone", -0.015, "step left", "the most expensive control step, so that a failure pays less"),
    )  # fmt: skip
    setup: ClassVar[Setup] = Setup(
        scene="lobe", episode_steps=EPISODE_STEPS, load=make_retract_scene, drawn=RetractionDraw
    )
    kept = ("goal_count", "jaw_target", "visible_share", "measured")
    # True for a task of two arms.
    takes_pair: ClassVar[bool] = False
    drawn: RetractionDraw | None

    def __init__(self, scenario: Scenario) -> None:
        """Retract the lobe of an anatomy.

        Raises:
            ValueError: a scene without a [retract] table or an endoscope, an instrument without a jaw or of two arms.
        """
        anatomy, scene, instrument = scenario.anatomy, scenario.anatomy.scene, scenario.instrument
        assert instrument is not None
        self.table, self._endoscope = _checked_scene(anatomy)
        if scene.family is not None:
            raise ValueError(
                f"scene {scene.name!r} is a family of organs, and retractions draw their lobe themselves: leave out "
                "its [family], or palpate it"
            )
        from surgsim_env.instruments.arm.pair import Pair

        if isinstance(instrument, Pair) and not self.takes_pair:
            raise ValueError(
                f"scene {scene.name!r}: instrument {scene.instrument.model!r} is two arms, and one is needed: take one "
                'such as instrument="psm_retractor", or SurgSim/BimanualRetract-v0'
            )
        if instrument.jaw is None:
            raise ValueError(
                f"scene {scene.name!r}: instrument {scene.instrument.model!r} has no jaw to grasp with; "
                'take one that has, such as instrument="psm_retractor"'
            )
        super().__init__(scenario)
        self.turning_size = instrument.turning_size
        self.tracked_nodes = _nearest_nodes(anatomy.mesh.points, lifted_box(self.table, anatomy.mesh.points))
        self._hiding = hiding_geoms(instrument.model)
        self.grasp: Grasp | None = None
        self.record = RetractionRecord()
        self.goal_count = 0
        self.jaw_target = 1.0
        self.visible_share = 0.0

    @property
    def target(self) -> Disc | None:
        """The disc to uncover, on its bed at rest; None before the first episode."""
        if self.drawn is None:
            return None
        return Disc(np.array(self.drawn.target), np.array([0.0, 0.0, 1.0]), self.table.target_radius)

    @property
    def pictured(self) -> Pictured:
        """The disc to uncover, and the pose of the endoscope in this episode; none before the first."""
        if self.drawn is None:
            return Pictured()
        return Pictured(self.target, Endoscope(self.drawn.eye, self.drawn.looks_at, self._endoscope.fov_deg))

    # ---- actions -----------------------------------------------------------------------------------------------

    def command(self, commands: dict[str, FloatArray], instrument: Instrument) -> None:
        """Set the tip's velocity and rotation, and the jaw's target."""
        instrument.command_velocity(commands["velocity"], commands.get("turning"))
        self.command_jaw(float(commands["jaw"][0]), instrument)

    def command_jaw(self, target: float, instrument: Instrument) -> None:
        """Set the jaw's target, limited to [-1, 1]: an action may exceed that by rounding."""
        self.jaw_target = min(max(target, -1.0), 1.0)
        instrument.command_jaw(self.jaw_target)

    # ---- an episode --------------------------------------------------------------------------------------------

    def draw(self, rng: np.random.Generator) -> FloatArray:
        """Forget the last episode; the tip's place was drawn with the lobe."""
        assert self.drawn is not None
        self.record = RetractionRecord()
        self.goal_count, self.jaw_target = 0, 1.0
        return np.array(self.drawn.start)

    def accepts(self, simulation: Simulation) -> bool:
        """True if the lobe hides the target: at most HIDDEN_SHARE of it is visible."""
        self.look(simulation)
        return self.visible_share <= HIDDEN_SHARE

    def look(self, simulation: Simulation) -> None:
        """Read the grasp and the visible share of the target."""
        self.grasp = simulation.grasp
        self.visible_share = self._look(simulation)

    def update(self, step: ControlStep) -> None:
        """Read the grasp and the target's visible share, and add a control step to the record."""
        simulation = step.simulation
        self.look(simulation)
        if self.step_count == 0:
            return
        assert self.grasp is not None
        box = lifted_box(self.table, simulation.organ_model.node_rest_position)
        strain = region_strains(simulation.organ_model, simulation.organ_state.node_position, box)
        tip = simulation.instrument.tip_position
        duration = self.anatomy.scene.timing.control_step
        self.record.note(self.grasp, simulation.pull_peak, tip, strain, self.jaw_target < 0.0, duration)

    def end(self, step: ControlStep) -> str:
        """Reason of the end: a failure, or success after SUCCESS_TIME at the goal."""
        harm = self.harm(step)
        self.goal_count = self.goal_count + 1 if not harm and self.at_goal(step.simulation) else 0
        lasted = self.goal_count >= round(SUCCESS_TIME / self.anatomy.scene.timing.control_step)
        return harm or ("success" if lasted else "")

    def harm(self, step: ControlStep) -> str:
        """Name of the failure in a control step; "" for none."""
        if step.fault:
            return "fault"
        if step.simulation.pull_peak > self.limits.tear_force:
            return "torn"
        return "hard_force" if step.force_peak > self.limits.hard_force else ""

    def at_goal(self, simulation: Simulation) -> bool:
        """True if the jaw holds tissue and the target is visible, a state to be kept for SUCCESS_TIME."""
        assert self.grasp is not None
        return self.grasp.holds and self.visible_share >= SUCCESS_SHARE

    def info(self, step: ControlStep | None, end: str) -> dict[str, InfoValue]:
        """Forces, the grasp, the visible share and the record; without a grasp after a reset or a fault."""
        grasp = self.grasp if step is not None and not step.fault else None
        return {
            "force_peak": 0.0 if step is None else step.force_peak,
            "hard_limit": end == "hard_force",
            "torn": end == "torn",
            "visible": self.visible_share,
            "holds": grasp is not None and grasp.holds,
            "grip_force": 0.0 if grasp is None else grasp.grip_force,
            "pull_force": 0.0 if grasp is None else grasp.pull_force,
            "friction_left": 0.0 if grasp is None else grasp.friction_left,
            **self.record.info(),
        }

    def _look(self, simulation: Simulation, *, past_instruments: bool = True) -> float:
        """Visible share of the target from the endoscope, past the organ and, with `past_instruments`, instruments."""
        instrument, drawn, target = simulation.instrument, self.drawn, self.target
        assert drawn is not None and target is not None
        target = target.moved(simulation.ground_shift(target.centre))
        triangles = self.anatomy.mesh.boundary_triangles
        nodes = simulation.organ_state.node_position
        hiding = self._hiding if past_instruments else self._hiding[:0]
        seen = visible(
            np.array(drawn.eye), target.points(), nodes, triangles, instrument.model, instrument.data, hiding
        )
        return float(seen.mean())

    # ---- saved states ------------------------------------------------------------------------------------------

    @property
    def measured(self) -> dict[str, Any]:
        """The record of the episode as a table for JSON."""
        return asdict(self.record)

    @measured.setter
    def measured(self, table: dict[str, Any]) -> None:
        self.record = RetractionRecord(**table)


def jaw_wrench(simulation: Simulation) -> tuple[FloatArray, FloatArray]:
    """The tissue's force [N] and torque about the tip [N m] on both fingers of a jaw, (3,) each."""
    instrument = simulation.instrument
    assert instrument.jaw is not None
    tools = instrument.jaw.tools
    wrench = simulation.contact_wrench[tools]
    levers = instrument.shapes.tool_centre[tools] - instrument.tip_position
    torque = (wrench[:, 3:] + np.cross(levers, wrench[:, :3])).sum(axis=0)
    return wrench[:, :3].sum(axis=0), torque


def tip_axes(instrument: Instrument) -> FloatArray:
    """The x and z axes of the tip in the world, one after the other, (6,)."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, instrument.tip_pose_in(instrument.data)[1])
    return rotation.reshape(3, 3)[:, [0, 2]].T.ravel()


def _checked_scene(anatomy: Anatomy) -> tuple[Retraction, Endoscope]:
    """The [retract] and [endoscope] tables of a scene."""
    scene = anatomy.scene
    for name, table in (("retract", scene.retract), ("endoscope", scene.endoscope)):
        if table is None:
            raise ValueError(
                f"scene {scene.name!r} has no [{name}] table, which a retraction needs: add one, or take a scene that "
                "has it, such as 'lobe'"
            )
    assert scene.retract is not None and scene.endoscope is not None
    return scene.retract, scene.endoscope


def _nearest_nodes(points: FloatArray, box: tuple[FloatArray, FloatArray]) -> NDArray[np.int64]:
    """Nodes nearest to the TRACKED places in the lifted box, (n_tracked,)."""
    low, high = box
    places = low + np.array(TRACKED) * (high - low)
    return np.array([int(np.argmin(np.square(points - place).sum(axis=1))) for place in places])


# ---- draw of an episode ----------------------------------------------------------------------------------------

# Thickness of a drawn capsule [m]; only its product with the modulus counts.
CAPSULE_THICKNESS = 1e-4
# Height of a target above its bed [m], so that the bed does not hide it.
TARGET_LIFT = 1e-4


def lifted_box(table: Retraction, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corner of the lifted part's box, for nodes at `points` [m], (3,) each."""
    if table.flap is None:
        return points.min(axis=0), points.max(axis=0)
    return np.array(table.flap.lower), np.array(table.flap.upper)


def held_nodes(points: FloatArray, anchors: IntArray, share: float) -> IntArray:
    """Anchored nodes in the middle share of the edge, along x."""
    along = points[anchors, 0]
    middle, half = 0.5 * (along.min() + along.max()), 0.5 * np.ptp(along)
    # A node that lies on the border by rounding is held.
    return anchors[np.abs(along - middle) <= share * half * (1.0 + 1e-9)]


def _moved(endoscope: Endoscope, camera: RetractionCamera, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Position and viewed point of an endoscope shifted uniformly within a ball and turned about an axis across it."""
    way = rng.normal(size=3)
    shift = way / norm(way) * camera.shift * cbrt(rng.uniform())
    view = np.subtract(endoscope.target, endoscope.position)
    across = np.cross(view, rng.normal(size=3))
    across /= norm(across)
    angle = math.radians(camera.turn_deg) * rng.uniform()
    # The axis lies across the view, so that turning it (Rodrigues) needs no third term.
    turned = view * float(cos(angle)) + np.cross(across, view) * float(sin(angle))
    eye = np.asarray(endoscope.position) + shift
    return eye, eye + turned


def _vector(values: FloatArray) -> Vector:
    x, y, z = values.tolist()
    return x, y, z


# ---- measures of an episode -------------------------------------------------------------------------------------

# The lobe's thirds, from the anchored edge to the free one.
REGIONS = ("held", "middle", "free")
# Remaining friction over grip force at and below which a hold slips.
SLIP_SHARE = 0.02


@dataclass
class RetractionRecord:
    """Running measures of an episode; `info` names them.

    Fields:
        steps: control steps so far
        held_steps: of these, with tissue between the pads
        grip_peak, pull_peak: largest grip force and pull [N]; the pull's of every haptic step
        grip_sum, pull_sum: summed over the steps that held something [N]
        impulse: the pull's integral over time [N s]
        slips: holds that began to slip, or were lost while the jaw was commanded to close
        path: length of the path of the tip [m]
        strain: largest strain of an edge in each of REGIONS, lengthening over length at rest
    """

    steps: int = 0
    held_steps: int = 0
    grip_peak: float = 0.0
    pull_peak: float = 0.0
    grip_sum: float = 0.0
    pull_sum: float = 0.0
    impulse: float = 0.0
    slips: int = 0
    path: float = 0.0
    strain: list[float] = field(default_factory=lambda: [0.0] * len(REGIONS))
    slipping: bool = False
    held: bool = False
    tip: list[float] | None = None

    def note(
        self, grasp: Grasp, pull_peak: float, tip: FloatArray, strain: list[float], closing: bool, duration: float
    ) -> None:
        """Take in a control step.

        Args:
            grasp: at its end.
            pull_peak: largest pull of its haptic steps [N].
            tip: position at its end [m], (3,).
            strain: largest strain of each region at its end.
            closing: True if the jaw's target is nearer to closed than to open.
            duration: of the step [s].
        """
        self.steps += 1
        if grasp.holds:
            self.held_steps += 1
            self.grip_sum += grasp.grip_force
            self.pull_sum += grasp.pull_force
        self.grip_peak = max(self.grip_peak, grasp.grip_force)
        self.pull_peak = max(self.pull_peak, pull_peak, grasp.pull_force)
        self.impulse += grasp.pull_force * duration
        slipping = grasp.holds and grasp.friction_left <= SLIP_SHARE * grasp.grip_force
        lost = self.held and not grasp.holds and closing
        self.slips += int((slipping and not self.slipping) or lost)
        self.slipping, self.held = slipping, grasp.holds
        if self.tip is not None:
            self.path += float(norm(tip - self.tip))
        self.tip = tip.tolist()
        self.strain = [max(pair) for pair in zip(self.strain, strain)]

    def info(self) -> dict[str, bool | float | str]:
        """Measures so far, by their keys in `info`."""
        held = max(self.held_steps, 1)
        return {
            "grip_force_peak": self.grip_peak,
            "grip_force_mean": self.grip_sum / held,
            "pull_force_peak": self.pull_peak,
            "pull_force_mean": self.pull_sum / held,
            "pull_impulse": self.impulse,
            "slips": float(self.slips),
            "path_length": self.path,
            **{f"strain_{region}": value for region, value in zip(REGIONS, self.strain)},
        }


def region_strains(model: OrganModel, node_position: FloatArray, box: tuple[FloatArray, FloatArray]) -> list[float]:
    """Largest strain of an edge in each third of the lifted part, by the edge's middle at rest along y.

    The strain of an edge is its lengthening over its length at rest; shortening counts as 0.

    Args:
        model: the organ.
        node_position: of its nodes now [m], (n_node, 3).
        box: corners of the lifted part's box [m], (3,) each; other edges do not count.
    """
    first, second = model.spring_nodes.T
    lengths = norm(node_position[first] - node_position[second], axis=1)
    strain = lengths / model.spring_rest_length - 1.0
    rest = model.node_rest_position
    middle = 0.5 * (rest[first] + rest[second])
    lifted = ((middle >= box[0]) & (middle <= box[1])).all(axis=1)
    low, high = float(box[0][1]), float(box[1][1])
    share = (len(REGIONS) * (middle[:, 1] - low) / (high - low)).astype(np.int64)
    third = np.where(lifted, np.minimum(share, len(REGIONS) - 1), -1)
    return [float(strain[third == region].max(initial=0.0)) for region in range(len(REGIONS))]
