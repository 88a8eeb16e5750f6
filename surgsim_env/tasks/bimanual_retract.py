"""Retraction with two hands: the left arm exposes the target, the right one touches it."""

import json
import math

import numpy as np
from numpy.typing import NDArray

from msdm_core.kernels import OrganModel
from msdm_core.mesh import FloatArray
from surgsim_env.anatomy import Anatomy
from surgsim_env.arms.pair import Pair
from surgsim_env.grasp import Grasp
from surgsim_env.instrument import Instrument
from surgsim_env.rewards import BIMANUAL_WEIGHTS
from surgsim_env.sensors import ForceReading
from surgsim_env.simulation import Simulation
from surgsim_env.tasks.retract import (
    FORCE_BOUND,
    POSITION_SLACK,
    SPEED_BOUND,
    SPEED_FULL_SCALE,
    SUCCESS_SHARE,
    TURNING_FULL_SCALE,
    RetractTask,
)
from surgsim_env.tasks.task import Bounds, InfoValue, Start

# The right tip touches the target with such a force [N].
TOUCH_FORCE = (0.3, 1.0)
# And with its ball, not with the neck behind it: nothing of the ball is farther above the target than this [m].
TOUCH_GAP = 0.0002
# The arms may press each other with no more than this [N].
COLLISION_FORCE = 2.0
# The right tip is near the target within this distance: what nearness pays is measured by it [m].
NEAR = 0.10
# Bounds of the arms' distance [m], of which no more than 50 mm is looked at.
DISTANCE_BOUND = 0.1
# Entries of an action: the left arm's velocity, turning and jaw, then the right one's velocity and turning.
LEFT_SIZE, RIGHT_SIZE = 7, 6


class BimanualRetractTask(RetractTask):
    """SurgSim/BimanualRetract-v0 on one anatomy with a pair of arms.

    The target counts as exposed where the left jaw holds tissue and the organ leaves SUCCESS_SHARE of it uncovered,
    seen from the endoscope; instruments do not count, as the right tip itself stands before what it touches. It counts
    as touched where the centre of the right tip is above the disc and the tip presses what lies under it with
    TOUCH_FORCE.
    """

    weights = BIMANUAL_WEIGHTS
    failures = ("fault", "torn", "hard_force", "collided")
    takes_pair = True

    def __init__(self, anatomy: Anatomy, instrument: Instrument) -> None:
        """Retract the lobe of an anatomy with two arms.

        Raises:
            ValueError: what RetractTask refuses, an instrument that is no pair of a jaw with pads and a ball, a scene
                without a place for the right tip to start from or without supports that can be touched.
        """
        if not isinstance(instrument, Pair):
            raise ValueError(
                f"scene {anatomy.scene.name!r}: instrument {anatomy.scene.instrument.model!r} is one arm, and two are "
                'needed: take instrument="psm_pair", or two arms such as "psm_retractor+six_axis"'
            )
        _check_tips(instrument)
        super().__init__(anatomy, instrument)
        if self.table.right_start_lower is None or self.table.right_start_upper is None or not anatomy.scene.supports:
            raise ValueError(
                f"scene {anatomy.scene.name!r}: two hands need retract.right_start_lower, right_start_upper and "
                "[[supports]] that bear the target: add them, or take a scene that has them, such as 'lobe'"
            )
        self.action_size = LEFT_SIZE + RIGHT_SIZE
        self.jaw_place = LEFT_SIZE - 1
        self.right_reading = ForceReading(anatomy.scene.sensor)
        self.touch_force = self.uncovered_share = 0.0

    def bounds(self, instrument: Instrument) -> Bounds:
        """Bounds of the observation: those of one arm, then the right arm's."""
        left = super().bounds(instrument)
        speed, axes = np.full(3, SPEED_BOUND), np.full(6, 1.0 + 1e-6)
        force = np.full(3, self.right_reading.sensor.range)
        low = [instrument.lower - POSITION_SLACK, -speed, -axes, -force, [0.0, 0.0, -DISTANCE_BOUND]]
        high = [instrument.upper + POSITION_SLACK, speed, axes, force, [FORCE_BOUND, 1.0, DISTANCE_BOUND]]
        return Bounds(np.concatenate([left.low, *low]), np.concatenate([left.high, *high]))

    def action(
        self,
        velocity: FloatArray,
        *,
        turning: FloatArray | None = None,
        jaw: float | None = None,
        right: FloatArray | None = None,
        right_turning: FloatArray | None = None,
    ) -> FloatArray:
        """The action that asks for the left tip's velocity [m/s] (3,), turning [rad/s] and jaw, and the right one's.

        What is left out stays still.
        """
        still = np.zeros(3)
        return np.concatenate(
            [
                super().action(velocity, turning=turning, jaw=jaw),
                (still if right is None else np.asarray(right)) / SPEED_FULL_SCALE,
                (still if right_turning is None else np.asarray(right_turning)) / TURNING_FULL_SCALE,
            ]
        )

    def right_force(self, observation: NDArray[np.floating]) -> FloatArray:
        """The right arm's force reading in an observation [N], shape (3,)."""
        return np.asarray(observation[-6:-3], dtype=np.float64)

    def reset(self, rng: np.random.Generator) -> Start:
        """Draw an episode of retraction, and the right arm's start and bias."""
        start = super().reset(rng)
        assert self.table.right_start_lower is not None and self.table.right_start_upper is not None
        right = rng.uniform(self.table.right_start_lower, self.table.right_start_upper)
        self.right_reading.reset(rng)
        self.touch_force = self.uncovered_share = 0.0
        return Start(start.organ, np.stack([start.tip_position, right]))

    def command(self, action: FloatArray, instrument: Instrument) -> None:
        """Set both tips' velocities and turnings, and the left jaw's target."""
        left, right = action[:LEFT_SIZE], action[LEFT_SIZE:]
        instrument.command_velocity(
            np.stack([left[:3], right[:3]]) * SPEED_FULL_SCALE, np.stack([left[3:6], right[3:6]]) * TURNING_FULL_SCALE
        )
        self.command_jaw(float(left[6]), instrument)

    def observe(self, simulation: Simulation, rng: np.random.Generator) -> tuple[FloatArray, bool]:
        """What the table of `BimanualRetractEnv` says; and whether a sensor saturated."""
        values, cut = super().observe(simulation, rng)
        pair = _pair(simulation)
        arm = pair.arms["right"]
        self._feel(simulation)
        force, right_cut = self.right_reading.read(pair.contact_force("right", simulation.contact_wrench), rng)
        more = [arm.tip_position, arm.tip_velocity, arm.tip_rotation[:, [0, 2]].T.ravel(), force]
        measures = [self.touch_force, self.uncovered_share, pair.distance]
        return np.concatenate([values, *more, measures]), cut or right_cut

    def get_state(self) -> str:
        """Draw, biases, counters and measures as JSON, exact."""
        right = {"bias": self.right_reading.bias.tolist(), "felt": [self.uncovered_share, self.touch_force]}
        return json.dumps({"left": super().get_state(), **right})

    def set_state(self, text: str) -> OrganModel:
        """Restore what `get_state` gave; returns the lobe of that episode."""
        table = json.loads(text)
        self.right_reading.bias = np.array(table["bias"])
        self.uncovered_share, self.touch_force = table["felt"]
        return super().set_state(table["left"])

    def _feel(self, simulation: Simulation) -> None:
        """Look at what the organ leaves uncovered and at what the right tip presses."""
        pair, supports = _pair(simulation), self.anatomy.scene.supports
        self.uncovered_share = self._look(simulation, past_instruments=False)
        self.touch_force = max(pair.touch_force("right", support.name) for support in supports)

    def _harm(self, simulation: Simulation, force_peak: float, fault: str) -> str:
        harm = super()._harm(simulation, force_peak, fault)
        if harm:
            return harm
        if self.touch_force > self.force_limit:
            return "hard_force"
        return "collided" if _pair(simulation).collision_force > COLLISION_FORCE else ""

    def _progress(self, simulation: Simulation, grasp: Grasp) -> dict[str, float]:
        self._feel(simulation)
        away = np.linalg.norm(self._from_target(simulation))
        return {
            "visible": self.uncovered_share,
            "grasped": float(grasp.holds),
            "near": max(1.0 - float(away) / NEAR, 0.0),
            "touched": float(self._touches(simulation)),
        }

    def _at_goal(self, simulation: Simulation, grasp: Grasp) -> bool:
        return grasp.holds and self.uncovered_share >= SUCCESS_SHARE and self._touches(simulation)

    def _touches(self, simulation: Simulation) -> bool:
        x, y, height = self._from_target(simulation)
        above = math.hypot(x, y) <= self.table.target_radius and float(height) <= TOUCH_GAP
        return above and TOUCH_FORCE[0] <= self.touch_force <= TOUCH_FORCE[1]

    def _from_target(self, simulation: Simulation) -> FloatArray:
        """From the target's centre to the right tip's lowest point [m], (3,)."""
        target = self.target
        assert target is not None
        lowest = _pair(simulation).arms["right"].tip_position - target.normal * self.anatomy.scene.instrument.tip_radius
        return lowest - target.centre

    def _info(
        self, simulation: Simulation | None, grasp: Grasp | None, force_peak: float, harm: str
    ) -> dict[str, InfoValue]:
        touches, collision = False, 0.0
        if simulation is not None and grasp is not None:
            touches, collision = self._touches(simulation), _pair(simulation).collision_force
        return {
            **super()._info(simulation, grasp, force_peak, harm),
            "collided": harm == "collided",
            "uncovered": self.uncovered_share,
            "touch_force": self.touch_force,
            "touches": touches,
            "collision_force": collision,
        }


def _check_tips(pair: Pair) -> None:
    """The left arm can hold tissue, the right one can touch."""
    left, right = pair.arms["left"], pair.arms["right"]
    if left.jaw is None or not left.jaw.has_pads:
        raise ValueError(
            f"the left {left.where} has no jaw with flat pads to hold tissue with; take one that has, such as "
            "'psm_retractor'"
        )
    if right.arm.description.tip.ball is None:
        raise ValueError(
            f"the right {right.where} has no ball at its tip to touch with; take one that has, such as 'psm_palpator'"
        )


def _pair(simulation: Simulation) -> Pair:
    instrument = simulation.instrument
    assert isinstance(instrument, Pair)
    return instrument
