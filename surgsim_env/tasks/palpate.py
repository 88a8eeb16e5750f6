"""Palpation: find one hidden lesion by touch and declare it while pressing on it."""

import json
import math

import numpy as np
from numpy.typing import NDArray

from msdm_core.kernels import OrganModel
from msdm_core.mesh import FloatArray
from msdm_core.regions import Lesion
from surgsim_env.anatomy import Anatomy
from surgsim_env.instrument import Instrument
from surgsim_env.levels import DrawnOrgan, Level
from surgsim_env.palpation.chart import make_chart
from surgsim_env.palpation.touch_memory import Indenter, TouchMemory
from surgsim_env.rewards import PALPATE_WEIGHTS, weighted
from surgsim_env.scenes import Endoscope
from surgsim_env.sensors import ForceReading
from surgsim_env.simulation import Simulation
from surgsim_env.tasks.task import Bounds, InfoValue, Start, Verdict
from surgsim_env.visibility import Disc

EPISODE_STEPS = 600
SPEED_FULL_SCALE = 0.02
DECLARE_VALUE = 0.8
DECLARE_STEPS = 3
SUCCESS_DISTANCE = 0.010

# The tip starts this far above the surface [m].
START_GAP = (0.002, 0.006)
# Bounds of the observation beyond the workspace [m] and on speed [m/s]; leaving them is a fault.
POSITION_SLACK = 0.005
SPEED_BOUND = 0.5


def touch_memory(anatomy: Anatomy) -> TouchMemory:
    """An empty memory for an anatomy's palpable face and its scene's sensor."""
    scene = anatomy.scene
    return TouchMemory(
        make_chart(anatomy.face, scene.instrument.tip_radius),
        Indenter(scene.instrument.tip_radius, scene.material),
        press_depth=scene.palpation.press_depth,
        force_range=scene.sensor.range,
    )


class PalpateTask:
    """SurgSim/Palpate-v0 on one anatomy."""

    action_size = 4
    weights = PALPATE_WEIGHTS
    pull_limit = math.inf
    target: Disc | None = None
    endoscope: Endoscope | None = None

    def __init__(self, anatomy: Anatomy, level: Level | None = None, *, memory: bool = False) -> None:
        """Palpate an anatomy.

        Args:
            anatomy: of a scene, or of what `level.scene` made of one.
            level: what an episode draws, but for the number of lesions, which is one; the scene's ranges by default.
            memory: whether the observation holds what was felt so far.

        Raises:
            ValueError: the scene says of no lesion how it is drawn.
        """
        if anatomy.scene.lesion is None:
            raise ValueError(
                f"scene {anatomy.scene.name!r} has no [lesion] table, so that there is nothing to find in it: "
                "add one, or take a scene that has it, such as 'phantom'"
            )
        self.anatomy = anatomy
        self.limits = anatomy.scene.limits
        self.reading = ForceReading(anatomy.scene.sensor)
        self.level = level
        self.drawn: DrawnOrgan | None = None
        self.memory = touch_memory(anatomy) if memory else None
        self.step_count = 0
        self.declare_count = 0
        self._declare_value = 0.0

    @property
    def lesions(self) -> tuple[Lesion, ...]:
        """The lesion of the episode; none before the first."""
        return () if self.drawn is None else self.drawn.lesions

    @property
    def lesion(self) -> Lesion | None:
        """The lesion of the episode; None before the first."""
        return self.lesions[0] if self.lesions else None

    def bounds(self, instrument: Instrument) -> Bounds:
        """Bounds of the observation, from the tip's workspace [m]."""
        speed, force = np.full(3, SPEED_BOUND), np.full(3, self.anatomy.scene.sensor.range)
        low = np.concatenate([instrument.lower - POSITION_SLACK, -speed, -force, [0.0]])
        high = np.concatenate([instrument.upper + POSITION_SLACK, speed, force, [1.0]])
        if self.memory is None:
            return Bounds(low, high)
        felt = np.full(self.memory.chart.side_count**2, self.memory.bound)
        still = np.zeros_like(felt)
        return Bounds(
            np.concatenate([low, -felt, still, [-1.0, -1.0, -self.memory.bound]]),
            np.concatenate([high, felt, still + 1.0, [1.0, 1.0, self.memory.bound]]),
        )

    @property
    def force_entries(self) -> list[int]:
        """Numbers of the observation that come from the force sensor: the reading, what memory makes of it."""
        felt = 0 if self.memory is None else self.memory.chart.side_count**2
        last = [] if self.memory is None else [10 + 2 * felt + index for index in range(3)]
        return [6, 7, 8, *range(10, 10 + felt), *last]

    def reset(self, rng: np.random.Generator) -> Start:
        """Draw the lesion (and what else the level draws), the sensor's bias and the tip's start."""
        if self.level is None:
            self.drawn = DrawnOrgan((self.anatomy.random_lesion(rng),))
        else:
            self.drawn = self.level.draw(self.anatomy, rng, lesion_count=1)
        self.reading.reset(rng)
        self.step_count = 0
        self.declare_count = 0
        self._declare_value = 0.0
        if self.memory is not None:
            self.memory.forget()
        above, outward = self.anatomy.face.random_point(rng, self.anatomy.scene.palpation.face_margin)
        gap = self.anatomy.scene.instrument.tip_radius + rng.uniform(*START_GAP)
        return Start(self.drawn.compiled(self.anatomy), above + outward * gap)

    def accepts(self, simulation: Simulation) -> bool:
        """Every drawn lesion can be found."""
        return True

    def command(self, action: FloatArray, instrument: Instrument) -> None:
        """Set the tip velocity that an action asks for."""
        instrument.command_velocity(self.velocity(action))

    def velocity(self, action: FloatArray) -> FloatArray:
        """The tip velocity that an action asks for [m/s], shape (3,)."""
        return np.asarray(action[:3], dtype=np.float64) * SPEED_FULL_SCALE

    def action(self, velocity: FloatArray, *, declare: bool = False) -> FloatArray:
        """The action that asks for a tip velocity [m/s] (3,): `velocity` the other way round; shape (4,)."""
        return np.append(np.asarray(velocity, dtype=np.float64) / SPEED_FULL_SCALE, float(declare))

    @property
    def speed_limit(self) -> float:
        """The fastest that an action can ask the tip to move along an axis [m/s]."""
        return SPEED_FULL_SCALE

    def sensed_force(self, observation: NDArray[np.floating]) -> FloatArray:
        """The force sensor's reading in an observation [N], shape (3,)."""
        return np.asarray(observation[6:9], dtype=np.float64)

    def begin(self, action: FloatArray) -> None:
        """Begin a control step: count it and note what the action declares."""
        self.step_count += 1
        self._declare_value = float(action[3])

    @property
    def force_limit(self) -> float:
        """A control step ends with the haptic step whose force passes this, and the episode with it [N]."""
        return self.limits.hard_force

    def observe(self, simulation: Simulation, rng: np.random.Generator) -> tuple[FloatArray, bool]:
        """Tip position, tip velocity, force reading, time left, what is remembered; whether the sensor saturated."""
        reading, saturated = self.reading.read(simulation.contact_force, rng)
        left = 1.0 - self.step_count / EPISODE_STEPS
        instrument = simulation.instrument
        seen = [instrument.tip_position, instrument.tip_velocity, reading, [left]]
        if self.memory is not None:
            self._remember(self.memory, instrument.tip_position, reading)
            seen += [self.memory.contrast, self.memory.visited, self.memory.stiffest()]
        return np.concatenate(seen), saturated

    def _remember(self, memory: TouchMemory, tip: FloatArray, reading: FloatArray) -> None:
        """Take a reading in, at the depth of the ball below the resting surface."""
        surface, normal = self.anatomy.face.project(tip)
        depth = memory.indenter.radius - float((tip - surface) @ normal)
        memory.feel(memory.chart.place(surface), depth, float(reading @ normal))

    def judge(self, simulation: Simulation, force_peak: float, fault: str) -> Verdict:
        """End a control step: see whether something was declared, and say how it ends.

        Args:
            simulation: as the step left it.
            force_peak: largest contact force of its haptic steps [N].
            fault: what the simulation came to, or an empty string.
        """
        hard = not fault and force_peak > self.force_limit
        declared = not fault and not hard and self._declares(simulation)
        error = self.declared_error(simulation) if declared else None
        found = error is not None and error <= SUCCESS_DISTANCE
        terminated = bool(fault) or hard or declared
        excess = self.limits.excess(force_peak)
        terms = {
            "time": 1.0,
            "soft_force": min(max(excess, 0.0), 1.0),
            "found": float(found),
            "wrong": float(declared and not found),
            "hard_force": float(hard),
            "fault": float(bool(fault)),
            "forgone": float(EPISODE_STEPS - self.step_count) if terminated and not found else 0.0,
        }
        return Verdict(
            terminated=terminated,
            truncated=not terminated and self.step_count >= EPISODE_STEPS,
            rewards=weighted(terms, PALPATE_WEIGHTS),
            info={
                "force_peak": force_peak,
                "cost": max(excess, 0.0),
                "hard_limit": hard,
                "declared": declared,
                "success": found,
                "error_mm": -1.0 if error is None else error * 1000.0,
            },
        )

    def blank_info(self) -> dict[str, InfoValue]:
        """The info of a reset: the same keys and types as a verdict's."""
        return {
            "force_peak": 0.0,
            "cost": 0.0,
            "hard_limit": False,
            "declared": False,
            "success": False,
            "error_mm": -1.0,
        }

    def _declares(self, simulation: Simulation) -> bool:
        pressing = self._declare_value > DECLARE_VALUE and simulation.contact_centre is not None
        self.declare_count = self.declare_count + 1 if pressing else 0
        return self.declare_count >= DECLARE_STEPS

    def declared_error(self, simulation: Simulation) -> float:
        """Distance along the resting surface from the touched patch to the point nearest to the lesion's centre [m]."""
        place = simulation.contact_centre
        assert self.lesion is not None and self.lesion.centre is not None and place is not None
        truth, _ = self.anatomy.face.project(self.lesion.centre)
        return float(self.anatomy.along_surface(truth, place[None])[0])

    def get_state(self) -> str:
        """What was drawn, bias and counters as JSON, exact (numbers are written in full)."""
        assert self.drawn is not None
        return json.dumps(
            {
                "drawn": self.drawn.to_json(),
                "bias": self.reading.bias.tolist(),
                "counts": [self.step_count, self.declare_count],
                "declare_value": self._declare_value,
                "memory": None if self.memory is None else [self.memory.product.tolist(), self.memory.square.tolist()],
            }
        )

    def set_state(self, text: str) -> OrganModel:
        """Restore what `get_state` gave; returns the organ of that episode."""
        table = json.loads(text)
        self.drawn = DrawnOrgan.from_json(table["drawn"], self.anatomy)
        self.reading.bias = np.array(table["bias"])
        self.step_count, self.declare_count = table["counts"]
        self._declare_value = table["declare_value"]
        if self.memory is not None:
            self.memory.product, self.memory.square = np.array(table["memory"])
        return self.drawn.compiled(self.anatomy)
