"""Retraction: grasp a lobe near its free edge and fold it back, so that the endoscope sees what lies under it."""

import json

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.kernels import OrganModel
from msdm_core.mesh import FloatArray
from msdm_core.regions import Lesion
from surgsim_env.anatomy import Anatomy
from surgsim_env.arms.pair import Pair
from surgsim_env.grasp import Grasp
from surgsim_env.instrument import Instrument
from surgsim_env.retraction import Retraction
from surgsim_env.rewards import RETRACT_WEIGHTS, weighted
from surgsim_env.scenes import Endoscope, ForceSensor
from surgsim_env.sensors import ForceReading
from surgsim_env.simulation import Simulation
from surgsim_env.tasks.retraction_draw import RetractionDraw, draw_retraction, drawn_organ, lifted_box
from surgsim_env.tasks.retraction_record import RetractionRecord, region_strains
from surgsim_env.tasks.task import Bounds, InfoValue, Start, Verdict
from surgsim_env.visibility import Disc, hiding_geoms, visible

EPISODE_STEPS = 600
SPEED_FULL_SCALE = 0.02
# The wrist's turning [rad/s].
TURNING_FULL_SCALE = 0.5
# Success: this share of the target is seen for so long [s].
SUCCESS_SHARE = 0.8
SUCCESS_TIME = 0.5
# No more of it is seen when an episode begins.
HIDDEN_SHARE = 0.1

# The torque sensor is as good as the force sensor at this lever [m].
TORQUE_LEVER = 0.01
# Bounds of the observation beyond workspace and lobe [m], on speed [m/s], opening [m] and forces [N]; leaving them is a
# fault.
POSITION_SLACK = 0.005
LOBE_SLACK = 0.1
SPEED_BOUND = 0.5
OPENING_BOUND = 0.1
FORCE_BOUND = 200.0
# Places of the lobe whose nodes are observed: shares of its length along the edge, its depth and its thickness.
TRACKED = tuple((along, depth, 1.0) for depth in (1.0, 0.5) for along in (0.0, 0.25, 0.5, 0.75, 1.0))


class RetractTask:
    """SurgSim/Retract-v0 on one anatomy with one instrument that has a jaw."""

    weights = RETRACT_WEIGHTS
    # Reward terms of what ends an episode in harm; the first that is true counts.
    failures: tuple[str, ...] = ("fault", "torn", "hard_force")
    lesions: tuple[Lesion, ...] = ()
    # Whether two arms do it.
    takes_pair = False

    def __init__(self, anatomy: Anatomy, instrument: Instrument) -> None:
        """Retract the lobe of an anatomy.

        Raises:
            ValueError: a scene without a [retract] table or an endoscope, an instrument without a jaw or of two arms.
        """
        scene = anatomy.scene
        self.table, self._endoscope = _checked_scene(anatomy)
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
        self.anatomy = anatomy
        self.limits = scene.limits
        self.turning_size = instrument.turning_size
        self.action_size = 3 + self.turning_size + 1
        # Where an action has the jaw's target.
        self.jaw_place = 3 + self.turning_size
        sensor = scene.sensor
        self.force_reading = ForceReading(sensor)
        self.torque_reading = ForceReading(
            ForceSensor(sensor.noise * TORQUE_LEVER, sensor.bias * TORQUE_LEVER, sensor.range * TORQUE_LEVER)
        )
        self.tracked_nodes = _nearest_nodes(anatomy.mesh.points, lifted_box(self.table, anatomy.mesh.points))
        self._hiding = hiding_geoms(instrument.model)
        self.drawn: RetractionDraw | None = None
        self.record = RetractionRecord()
        self.step_count = 0
        self.goal_count = 0
        self.jaw_target = 1.0
        self.visible_share = 0.0
        self._reached = dict[str, float]()

    # What the environment and pictures ask ---------------------------------------------------------------------------

    @property
    def force_limit(self) -> float:
        """A control step ends with the haptic step whose force passes this, and the episode with it [N]."""
        return self.limits.hard_force

    @property
    def pull_limit(self) -> float:
        """Likewise with the pull of the jaw: tissue tears [N]."""
        return self.limits.tear_force

    @property
    def target(self) -> Disc | None:
        """The disc that is to be seen; None before the first episode."""
        if self.drawn is None:
            return None
        return Disc(np.array(self.drawn.target), np.array([0.0, 0.0, 1.0]), self.table.target_radius)

    @property
    def endoscope(self) -> Endoscope | None:
        """Where the endoscope stands in this episode; None before the first."""
        if self.drawn is None:
            return None
        return Endoscope(self.drawn.eye, self.drawn.looks_at, self._endoscope.fov_deg)

    def bounds(self, instrument: Instrument) -> Bounds:
        """Bounds of the observation, from the tip's workspace and the lobe's box [m]."""
        points = self.anatomy.mesh.points
        sensor = self.force_reading.sensor
        wrench = np.repeat([sensor.range, self.torque_reading.sensor.range], 3)
        tracked = np.tile(points.min(axis=0) - LOBE_SLACK, len(TRACKED))
        tracked_high = np.tile(points.max(axis=0) + LOBE_SLACK, len(TRACKED))
        along, distance = self.table.target_along, self.table.target_distance
        speed, axes = np.full(3, SPEED_BOUND), np.full(6 if self.turning_size else 0, 1.0 + 1e-6)
        low = [instrument.lower - POSITION_SLACK, -speed, -axes, [-OPENING_BOUND], -wrench, np.zeros(3), tracked]
        high = [instrument.upper + POSITION_SLACK, speed, axes, [OPENING_BOUND], wrench]
        high += [[FORCE_BOUND, FORCE_BOUND, 1.0], tracked_high]
        return Bounds(
            np.concatenate([*low, [0.0, along[0], distance[0], 0.0]]),
            np.concatenate([*high, [1.0, along[1], distance[1], 1.0]]),
        )

    # What scripts ask ------------------------------------------------------------------------------------------------

    @property
    def speed_limit(self) -> float:
        """The fastest that an action can ask the tip to move along an axis [m/s]."""
        return SPEED_FULL_SCALE

    def action(
        self, velocity: FloatArray, *, turning: FloatArray | None = None, jaw: float | None = None
    ) -> FloatArray:
        """The action that asks for a tip velocity [m/s] (3,), turning [rad/s] and a jaw target; shape (action_size,).

        The tip does not turn, and the jaw goes on to its last target, where nothing else is said.
        """
        turn = np.zeros(self.turning_size) if turning is None else np.asarray(turning) / TURNING_FULL_SCALE
        return np.concatenate(
            [np.asarray(velocity, dtype=np.float64) / SPEED_FULL_SCALE, turn, [self.jaw_target if jaw is None else jaw]]
        )

    @property
    def force_entries(self) -> tuple[int, ...]:
        """The entries of the observation that are forces: the jaw's wrench, its grip and its pull."""
        first = self._first_force
        return tuple(range(first, first + 8))

    def sensed_force(self, observation: NDArray[np.floating]) -> FloatArray:
        """The force sensor's reading in an observation [N], shape (3,)."""
        first = self._first_force
        return np.asarray(observation[first : first + 3], dtype=np.float64)

    # An episode ------------------------------------------------------------------------------------------------------

    def reset(self, rng: np.random.Generator) -> Start:
        """Draw the lobe, the target, the endoscope, the sensor's bias and the tip's start."""
        self.drawn = draw_retraction(self.table, self._endoscope, rng)
        self.force_reading.reset(rng)
        self.torque_reading.reset(rng)
        self.record = RetractionRecord()
        self.step_count = self.goal_count = 0
        self.jaw_target = 1.0
        return Start(drawn_organ(self.anatomy, self.drawn), np.array(self.drawn.start))

    def accepts(self, simulation: Simulation) -> bool:
        """Whether the lobe hides the target: at most HIDDEN_SHARE of it is seen."""
        self.visible_share = self._look(simulation)
        self._reached = self._progress(simulation, self._grasp(simulation))
        return self.visible_share <= HIDDEN_SHARE

    def command(self, action: FloatArray, instrument: Instrument) -> None:
        """Set the tip's velocity and turning, and the jaw's target."""
        turning = action[3:-1] * TURNING_FULL_SCALE if self.turning_size else None
        instrument.command_velocity(action[:3] * SPEED_FULL_SCALE, turning)
        self.command_jaw(float(action[-1]), instrument)

    def command_jaw(self, target: float, instrument: Instrument) -> None:
        """Set the jaw's target from -1 to 1; actions may leave that by rounding, the jaw's own command may not."""
        self.jaw_target = min(max(target, -1.0), 1.0)
        instrument.command_jaw(self.jaw_target)

    def begin(self, action: FloatArray) -> None:
        """Begin a control step: count it."""
        self.step_count += 1

    def observe(self, simulation: Simulation, rng: np.random.Generator) -> tuple[FloatArray, bool]:
        """What the table of `RetractEnv` says; and whether a sensor saturated."""
        instrument, drawn = simulation.instrument, self.drawn
        assert drawn is not None
        grasp = self._grasp(simulation)
        self.visible_share = self._look(simulation)
        force, torque = self._jaw_wrench(simulation)
        force, force_cut = self.force_reading.read(force, rng)
        torque, torque_cut = self.torque_reading.read(torque, rng)
        values = np.concatenate(
            [
                instrument.tip_position,
                instrument.tip_velocity,
                self._tip_axes(instrument),
                [grasp.opening],
                force,
                torque,
                [grasp.grip_force, grasp.pull_force, float(grasp.holds)],
                simulation.organ_state.node_position[self.tracked_nodes].ravel(),
                [self.visible_share, drawn.target[0], drawn.target[1], 1.0 - self.step_count / EPISODE_STEPS],
            ]
        )
        return values, force_cut or torque_cut

    def judge(self, simulation: Simulation, force_peak: float, fault: str) -> Verdict:
        """End a control step: see what is seen, what was grasped and what it took.

        Args:
            simulation: as the step left it.
            force_peak: largest contact force of its haptic steps [N].
            fault: what the simulation came to, or an empty string.
        """
        harm = self._harm(simulation, force_peak, fault)
        before, grasp = self._reached, None
        if not fault:
            grasp = self._grasp(simulation)
            self._note(simulation, grasp)
            self._reached = self._progress(simulation, grasp)
        at_goal = grasp is not None and not harm and self._at_goal(simulation, grasp)
        self.goal_count = self.goal_count + 1 if at_goal else 0
        success = self.goal_count >= round(SUCCESS_TIME / self.anatomy.scene.timing.control_step)
        terminated = bool(harm) or success
        excess = self.limits.excess(force_peak)
        terms = {
            "time": 1.0,
            "soft_force": min(max(excess, 0.0), 1.0),
            **{name: self._reached[name] - before[name] for name in before},
            "success": float(success),
            **{name: float(harm == name) for name in self.failures},
            "forgone": float(EPISODE_STEPS - self.step_count) if harm else 0.0,
        }
        return Verdict(
            terminated=terminated,
            truncated=not terminated and self.step_count >= EPISODE_STEPS,
            rewards=weighted(terms, self.weights),
            info={**self._info(simulation, grasp, force_peak, harm), "success": success},
        )

    def blank_info(self) -> dict[str, InfoValue]:
        """The info of a reset: the same keys and types as a verdict's."""
        return {**self._info(None, None, 0.0, ""), "success": False}

    def get_state(self) -> str:
        """Draw, biases, counters and measures as JSON, exact."""
        assert self.drawn is not None
        return json.dumps(
            {
                "drawn": self.drawn.to_json(),
                "record": self.record.to_json(),
                "bias": [self.force_reading.bias.tolist(), self.torque_reading.bias.tolist()],
                "counts": [self.step_count, self.goal_count],
                "jaw_target": self.jaw_target,
                "visible": self.visible_share,
                "reached": self._reached,
            }
        )

    def set_state(self, text: str) -> OrganModel:
        """Restore what `get_state` gave; returns the lobe of that episode."""
        table = json.loads(text)
        self.drawn = RetractionDraw.from_json(table["drawn"])
        self.record = RetractionRecord.from_json(table["record"])
        self.force_reading.bias, self.torque_reading.bias = map(np.array, table["bias"])
        self.step_count, self.goal_count = table["counts"]
        self.jaw_target = table["jaw_target"]
        self.visible_share, self._reached = table["visible"], table["reached"]
        return drawn_organ(self.anatomy, self.drawn)

    # Its parts -------------------------------------------------------------------------------------------------------

    def _harm(self, simulation: Simulation, force_peak: float, fault: str) -> str:
        """Which of `failures` a control step came to; "" for none."""
        if fault:
            return "fault"
        if simulation.pull_peak > self.pull_limit:
            return "torn"
        return "hard_force" if force_peak > self.force_limit else ""

    def _progress(self, simulation: Simulation, grasp: Grasp) -> dict[str, float]:
        """What is reached, each from 0 to 1: its changes pay."""
        return {"visible": self.visible_share, "grasped": float(grasp.holds)}

    def _at_goal(self, simulation: Simulation, grasp: Grasp) -> bool:
        """Whether this is what shall last for SUCCESS_TIME."""
        return self.visible_share >= SUCCESS_SHARE

    def _look(self, simulation: Simulation, *, past_instruments: bool = True) -> float:
        """Share of the target that the endoscope sees; past the organ alone where instruments shall not count."""
        instrument, target, drawn = simulation.instrument, self.target, self.drawn
        assert target is not None and drawn is not None
        triangles = self.anatomy.mesh.boundary_triangles
        nodes = simulation.organ_state.node_position
        hiding = self._hiding if past_instruments else self._hiding[:0]
        seen = visible(
            np.array(drawn.eye), target.points(), nodes, triangles, instrument.model, instrument.data, hiding
        )
        return float(seen.mean())

    @property
    def _first_force(self) -> int:
        return 7 + (6 if self.turning_size else 0)

    def _grasp(self, simulation: Simulation) -> Grasp:
        grasp = simulation.grasp
        assert grasp is not None
        return grasp

    def _jaw_wrench(self, simulation: Simulation) -> tuple[FloatArray, FloatArray]:
        """Tissue's force [N] and torque about the tip [N m] on both fingers, (3,) each."""
        instrument = simulation.instrument
        assert instrument.jaw is not None
        tools = instrument.jaw.tools
        wrench = simulation.contact_wrench[tools]
        levers = instrument.shapes.tool_centre[tools] - instrument.tip_position
        torque = (wrench[:, 3:] + np.cross(levers, wrench[:, :3])).sum(axis=0)
        return wrench[:, :3].sum(axis=0), torque

    def _tip_axes(self, instrument: Instrument) -> FloatArray:
        """Two axes of the tip in the world, (6,), where it turns; nothing (0,) where it does not."""
        if not self.turning_size:
            return np.zeros(0)
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, instrument.tip_pose_in(instrument.data)[1])
        return rotation.reshape(3, 3)[:, [0, 2]].T.ravel()

    def _note(self, simulation: Simulation, grasp: Grasp) -> None:
        box = lifted_box(self.table, simulation.organ_model.node_rest_position)
        strain = region_strains(simulation.organ_model, simulation.organ_state.node_position, box)
        tip = simulation.instrument.tip_position
        duration = self.anatomy.scene.timing.control_step
        self.record.note(grasp, simulation.pull_peak, tip, strain, self.jaw_target < 0.0, duration)

    def _info(
        self, simulation: Simulation | None, grasp: Grasp | None, force_peak: float, harm: str
    ) -> dict[str, InfoValue]:
        return {
            "force_peak": force_peak,
            "hard_limit": harm == "hard_force",
            "torn": harm == "torn",
            "visible": self.visible_share,
            "holds": grasp is not None and grasp.holds,
            "grip_force": 0.0 if grasp is None else grasp.grip_force,
            "pull_force": 0.0 if grasp is None else grasp.pull_force,
            "friction_left": 0.0 if grasp is None else grasp.friction_left,
            **self.record.info(),
        }


def _checked_scene(anatomy: Anatomy) -> tuple[Retraction, Endoscope]:
    """The tables of a scene that a retraction needs."""
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
    """The nodes nearest to the TRACKED places of what is lifted, (n_tracked,)."""
    low, high = box
    places = low + np.array(TRACKED) * (high - low)
    return np.array([int(np.argmin(((points - place) ** 2).sum(axis=1))) for place in places])
