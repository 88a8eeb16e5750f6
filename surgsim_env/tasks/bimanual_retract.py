"""Retraction with two arms: the left one exposes the target, the right one touches it."""

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from msdm_core.arithmetic import norm
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.instrument import Instrument
from surgsim_env.tasks.channels import LENGTH_SCALE, SPEED_BOUND, TIP_POSITION, force_scale, soft_force_share
from surgsim_env.tasks.declaration import SPEED_FULL_SCALE, Channel, Command, ControlStep, Reward
from surgsim_env.tasks.retract import AXIS_BOUND, FORCE_BOUND, SUCCESS_SHARE, TURNING_FULL_SCALE, RetractTask
from surgsim_env.tasks.task import InfoValue, Scenario

if TYPE_CHECKING:
    from surgsim_env.instruments.arm.pair import Pair

# Force of the right tip on the target [N].
TOUCH_FORCE = (0.3, 1.0)
# Largest height of the lowest point of its ball above the target [m]: the neck behind the ball does not touch.
TOUCH_GAP = 0.0002
# Largest force between the arms [N].
COLLISION_FORCE = 2.0
# Distance of the right tip from the target at which nearness begins to pay [m].
NEAR = 0.10
# Bound of the arms' distance [m], which is computed up to 50 mm.
DISTANCE_BOUND = 0.1


def _right(simulation: Simulation) -> Any:
    return _pair(simulation).arms["right"]


class BimanualRetractTask(RetractTask):
    """Lift a lobe with one arm and touch the target under it with the other.

    ## Description
    The lobe of `SurgSim/Retract-v0` hides a disc on its bed. The left of two robot arms grasps the lobe and folds it
    back; the right one reaches under it and touches the disc gently for half a second. Tissue, bed and arms exchange
    forces 1000 times a second; one agent commands both arms 20 times a second. `surgsim_env.envs.bimanual_parallel` is
    the same for two agents.

    ## Action Space
    `Box(-1, 1, (13,), float32)`

    ## Observation Space
    `Box((74,), float32)`, all bounds finite: the 56 numbers of `SurgSim/Retract-v0` with the left arm, then those of
    the right one. `env.unwrapped.observation_slices` has the entries of each channel by its name.

    ## Rewards
    `info["reward_<term>"]` shows what each term paid. Four terms pay the change of their value, so that they cannot be
    earned twice. An episode that ends in failure pays less than any that is truncated.

    ## Starting State
    That of `SurgSim/Retract-v0`, and the right tip at a random place on the free side.

    ## Episode End
    Terminated: for 0.5 s, at the end of each control step, the left jaw held tissue, the organ left at least 80 % of
    the target uncovered as seen from the endoscope (instruments do not count, as the right tip itself stands before the
    target), and the right ball, its centre above the disc, pressed what lies under it with 0.3 to 1.0 N (success); in a
    haptic step the contact force on the tissue exceeded the hard limit, or the jaw's pull exceeded the strength of the
    tissue; at the end of a control step the force between right arm and bed exceeded the hard limit, or the force
    between the arms exceeded 2 N; the simulation faulted. Truncated: 600 control steps (30 s).

    ## Info
    That of `SurgSim/Retract-v0`, and `collided`, `touches` (bool), `uncovered` (share), `touch_force`,
    `collision_force` [N].
    Where the scene has `[limits] pressure`, `strain` or `dose`, and with `measure_tissue`, also `tissue_pressure` [Pa]
    and `tissue_strain`, the largest of the tissue at the end of the step, `tissue_extrapolated` (bool): strain beyond
    `strain_supported` of the material's stiffening, and `damaged` (bool): more than a limit is a safety stop. With
    `dose` also `tissue_dose` [Pa s], the largest integral of pressure over time at a place of the surface so far: a
    step adds its duration times the pressure at its end.

    ## Arguments
    Those of `SurgSim/Retract-v0`; `instrument` is "psm_pair", or two arms (names or TOML files) as "LEFT+RIGHT":
    the left one has a jaw with flat pads, the right one a ball at its tip, as "psm_retractor+six_axis".

    ## Version History
    * v0: first version.
    """

    commands: ClassVar[tuple[Command, ...]] = (
        Command("velocity", 3, SPEED_FULL_SCALE, "m/s", "left tip's velocity along x, y, z"),
        Command("turning", 3, TURNING_FULL_SCALE, "rad/s", "rotation of the left tip"),
        Command(
            "jaw", 1, meaning="target of the left jaw, which moves at its limited speed: -1 closed, 1 open",
            default=lambda task: task.jaw_target,
        ),
        Command("right", 3, SPEED_FULL_SCALE, "m/s", "right tip's velocity"),
        Command("right_turning", 3, TURNING_FULL_SCALE, "rad/s", "rotation of the right tip"),
    )  # fmt: skip
    channels: ClassVar[tuple[Channel, ...]] = (
        *RetractTask.channels,
        replace(
            TIP_POSITION, name="right_position", bounds_text="the lobe's bounding box with a margin",
            read=lambda task, simulation: _right(simulation).tip_reading,
            meaning="right tip's position: the centre of its ball",
        ),
        Channel(
            "right_velocity", 3, "m/s", -SPEED_BOUND, SPEED_BOUND,
            read=lambda task, simulation: _right(simulation).tip_velocity, meaning="right tip's velocity",
            scale=SPEED_FULL_SCALE,
        ),
        Channel(
            "right_axes", 6, "", -AXIS_BOUND, AXIS_BOUND,
            read=lambda task, simulation: _right(simulation).tip_rotation[:, [0, 2]].T,
            meaning="the right tip's x and z axes in the world",
        ),
        Channel(
            "right_force", 3, "N", sensor=1.0, late_bias=True,
            read=lambda task, simulation: _pair(simulation).contact_force("right", simulation.contact_wrench),
            meaning="the tissue's force on the right arm, through the sensor model",
            scale=force_scale, scale_text="soft limit",
        ),
        Channel(
            "touch_force", 1, "N", 0.0, FORCE_BOUND, felt=True, read=lambda task, simulation: task.touch_force,
            meaning="force between the right arm and the bed", scale=force_scale, scale_text="soft limit",
        ),
        Channel(
            "uncovered", 1, "", 0.0, 1.0, read=lambda task, simulation: task.uncovered_share,
            meaning="share of the target that the organ leaves uncovered, seen from the endoscope",
        ),
        Channel(
            "arm_distance", 1, "m", -DISTANCE_BOUND, DISTANCE_BOUND,
            read=lambda task, simulation: _pair(simulation).distance, meaning="distance of the arms, at most 0.05 m",
            scale=LENGTH_SCALE,
        ),
    )  # fmt: skip
    # By the inequality of RetractTask; `near` may begin as high as 1, so that the margin is
    #   -0.4 - 1 - 6 - 4 - 1 - 1 - 1 + 15  =  0.6  at least.
    rewards: ClassVar[tuple[Reward, ...]] = (
        Reward("time", -0.005, "step", "each control step"),
        Reward(
            "soft_force", -0.010, "step", "largest force of the step, 0 at the soft and 1 at the hard limit",
            soft_force_share,
        ),
        Reward(
            "visible", 4.0, "change", "share of the target that the organ leaves uncovered",
            lambda task, step: task.uncovered_share,
        ),
        Reward("grasped", 1.0, "change", "1 while tissue is between the pads", lambda task, step: task.grasp.holds),
        Reward(
            "near", 1.0, "change", "nearness of the right tip to the target: 1 on it, 0 from 0.1 m on",
            lambda task, step: task.nearness(step.simulation),
        ),
        Reward(
            "touched", 1.0, "change", "1 while the right tip presses the target with 0.3 to 1.0 N",
            lambda task, step: task.touches(step.simulation),
        ),
        Reward("success", 10.0, "success", "touched, while exposed, for long enough"),
        Reward("torn", -15.0, "failure", "the jaw pulled harder than the tissue bears"),
        Reward("hard_force", -15.0, "failure", "the force exceeded the hard limit: a safety stop"),
        Reward("collided", -15.0, "failure", "the arms pressed each other"),
        Reward("fault", -15.0, "failure", "the simulation could not go on"),
        Reward("forgone", -0.015, "step left", "the most expensive control step, so that a failure pays less"),
    )  # fmt: skip
    setup = replace(RetractTask.setup, instrument="psm_pair")
    kept = (*RetractTask.kept, "uncovered_share", "touch_force")
    takes_pair = True

    def __init__(self, scenario: Scenario) -> None:
        """Retract the lobe of an anatomy with two arms.

        Raises:
            ValueError: what RetractTask refuses, an instrument that is no pair of a jaw with pads and a ball, a scene
                without a place for the right tip to start from or without supports that can be touched.
        """
        from surgsim_env.instruments.arm.pair import Pair

        scene = scenario.anatomy.scene
        if not isinstance(scenario.instrument, Pair):
            raise ValueError(
                f"scene {scene.name!r}: instrument {scene.instrument.model!r} is one arm, and two are "
                'needed: take instrument="psm_pair", or two arms such as "psm_retractor+six_axis"'
            )
        _check_tips(scenario.instrument)
        super().__init__(scenario)
        if self.table.right_start_lower is None or self.table.right_start_upper is None or not scene.supports:
            raise ValueError(
                f"scene {scene.name!r}: two hands need retract.right_start_lower, right_start_upper and "
                "[[supports]] that bear the target: add them, or take a scene that has them, such as 'lobe'"
            )
        self.touch_force = self.uncovered_share = 0.0

    def command(self, commands: dict[str, FloatArray], instrument: Instrument) -> None:
        """Set both tips' velocities and rotations, and the left jaw's target."""
        velocity = np.stack([commands["velocity"], commands["right"]])
        turning = np.stack([commands["turning"], commands["right_turning"]])
        instrument.command_velocity(velocity, turning)
        self.command_jaw(float(commands["jaw"][0]), instrument)

    def draw(self, rng: np.random.Generator) -> FloatArray:
        """Draw the right arm's start."""
        left = super().draw(rng)
        assert self.table.right_start_lower is not None and self.table.right_start_upper is not None
        right = rng.uniform(self.table.right_start_lower, self.table.right_start_upper)
        self.touch_force = self.uncovered_share = 0.0
        return np.stack([left, right])

    def look(self, simulation: Simulation) -> None:
        """Read the grasp, the visible and the uncovered share of the target, and the force on the supports."""
        super().look(simulation)
        self._feel(simulation)

    def _feel(self, simulation: Simulation) -> None:
        pair, supports = _pair(simulation), self.anatomy.scene.supports
        self.uncovered_share = self._look(simulation, past_instruments=False)
        self.touch_force = max(pair.touch_force("right", support.name) for support in supports)

    def harm(self, step: ControlStep) -> str:
        """As `RetractTask.harm`; also a hard touch of the bed, and arms that press each other."""
        harm = super().harm(step)
        if harm:
            return harm
        if self.touch_force > self.limits.hard_force:
            return "hard_force"
        return "collided" if _pair(step.simulation).collision_force > COLLISION_FORCE else ""

    def at_goal(self, simulation: Simulation) -> bool:
        """True if the jaw holds tissue, the target is exposed and the right tip touches it."""
        assert self.grasp is not None
        return self.grasp.holds and self.uncovered_share >= SUCCESS_SHARE and self.touches(simulation)

    def touches(self, simulation: Simulation) -> bool:
        """True if the right ball is above the disc and presses on it with TOUCH_FORCE."""
        x, y, height = self._from_target(simulation)
        above = math.hypot(x, y) <= self.table.target_radius and float(height) <= TOUCH_GAP
        return above and TOUCH_FORCE[0] <= self.touch_force <= TOUCH_FORCE[1]

    def nearness(self, simulation: Simulation) -> float:
        """Nearness of the right tip to the target: 1 on it, 0 from NEAR on."""
        away = norm(self._from_target(simulation))
        return max(1.0 - float(away) / NEAR, 0.0)

    def _from_target(self, simulation: Simulation) -> FloatArray:
        """Vector from the target's centre to the right tip's lowest point [m], (3,)."""
        target = self.target
        assert target is not None
        lowest = _right(simulation).tip_position - target.normal * self.anatomy.scene.instrument.tip_radius
        return lowest - target.moved(simulation.ground_shift(target.centre)).centre

    def info(self, step: ControlStep | None, end: str) -> dict[str, InfoValue]:
        """Entries of `RetractTask.info` and of the right arm; no touch and no collision after a reset or a fault."""
        simulation = step.simulation if step is not None and not step.fault else None
        return {
            **super().info(step, end),
            "collided": end == "collided",
            "uncovered": self.uncovered_share,
            "touch_force": self.touch_force,
            "touches": simulation is not None and self.touches(simulation),
            "collision_force": 0.0 if simulation is None else _pair(simulation).collision_force,
        }


def _check_tips(pair: "Pair") -> None:
    """Refuse a left arm without flat pads and a right arm without a ball."""
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


def _pair(simulation: Simulation) -> "Pair":
    from surgsim_env.instruments.arm.pair import Pair

    instrument = simulation.instrument
    assert isinstance(instrument, Pair)
    return instrument
