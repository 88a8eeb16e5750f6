"""The state that a step of a script sees between two control steps; read-only."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.arm.pair import SIDES, Pair
from surgsim_env.instruments.jaw import Grasp
from surgsim_env.tasks.task import Task

Action = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class View:
    """A moment of a run, as the steps of its script and their predicates see it.

    Fields:
        time: since the episode's reset [s]
        step_time: since the present step of the script began [s]
        control_step: duration of a control step [s]
        observation: as the environment, with its wrappers, gave it
        tip_position, tip_velocity: centre of the tip ball [m], [m/s]                       (3,)
        true_force: of the tissue on the tools, mean of the last haptic step [N]            (3,)
        sensed_force: the same through the sensor model, as observed [N]                    (3,)
        contact_position: the tip at the first contact since the step began [m]; None before it  (3,)
        approach: unit vector along which the instrument comes                              (3,)
        grasp: what the jaw holds and how; None without a jaw
        task: how actions are laid out
        support_force: of the tool on the organ's supports [N]; for the arms of a pair
        arm: the arm of a pair whose view this is; "" for both or the only one
        arms: views of each of several arms, by name
    """

    time: float
    step_time: float
    control_step: float
    observation: NDArray[np.floating]
    tip_position: FloatArray
    tip_velocity: FloatArray
    true_force: FloatArray
    sensed_force: FloatArray
    contact_position: FloatArray | None
    approach: FloatArray
    grasp: Grasp | None
    task: Task
    support_force: float = 0.0
    arm: str = ""
    arms: Mapping[str, "View"] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for value in vars(self).values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    def action(self, velocity: FloatArray, **commands: Any) -> Action:
        """The action that asks for a tip velocity [m/s] (3,), and for what else the task takes (`declare=True`).

        A jaw stays as it was last told (`jaw=-1.0` closes it); of several arms the others stay where they are.
        """
        if self.arm == "right":
            own = {"right": velocity, **{f"right_{name}": value for name, value in commands.items()}}
            return self.task.action(np.zeros(3), **own)
        return self.task.action(velocity, **commands)

    def still(self, **commands: Any) -> Action:
        """The action that keeps the tip where it is."""
        return self.action(np.zeros(3), **commands)

    def grasped(self, step: object) -> Grasp:
        """What the jaw holds, for a step that needs one.

        Raises:
            TypeError: the instrument has no jaw.
        """
        if self.grasp is None:
            raise TypeError(
                f"{type(step).__name__} needs an instrument with a jaw; this one has none: choose a grasper"
            )
        return self.grasp

    def of(self, arm: str) -> "View":
        """The view of one of several arms.

        Raises:
            ValueError: there is no such arm (says which there are).
        """
        if arm not in self.arms:
            known = ", ".join(self.arms) or "none: the instrument is one alone"
            raise ValueError(f"arm {arm!r} is not there; the arms are {known}")
        return self.arms[arm]

    def pressing_force(self, direction: FloatArray, *, sensed: bool = False) -> float:
        """The force with which the tissue pushes back against a unit direction [N], true or sensed."""
        return -float((self.sensed_force if sensed else self.true_force) @ direction)

    def depth(self, direction: FloatArray) -> float:
        """How far the tip went along a unit direction since the step's first contact [m]; 0 before it."""
        if self.contact_position is None:
            return 0.0
        return float((self.tip_position - self.contact_position) @ direction)

    def reached(self) -> str:
        """Where the tip is and what it feels, in words."""
        place = ", ".join(f"{value * 1e3:.2f}" for value in self.tip_position)
        force = float(np.linalg.norm(self.true_force))
        return f"tip at ({place}) mm, contact force {force:.3f} N, {self.step_time:.2f} s after the step began"


def look(
    simulation: Simulation,
    task: Task,
    observation: NDArray[np.floating],
    task_observation: NDArray[np.floating],
    began: float,
    contact_position: FloatArray | None,
) -> View:
    """The view of a simulation now.

    Args:
        simulation: between two control steps.
        task: how its actions and observations are laid out.
        observation: as wrappers gave it.
        task_observation: the task's own numbers, as no wrapper or picture has changed them.
        began: when the step of the script began [s].
        contact_position: the tip at the first contact since then [m] (3,), or None.
    """
    view = View(
        time=simulation.time,
        step_time=simulation.time - began,
        control_step=simulation.anatomy.scene.timing.control_step,
        observation=np.array(observation),
        tip_position=simulation.instrument.tip_position,
        tip_velocity=simulation.instrument.tip_velocity,
        true_force=simulation.contact_force,
        sensed_force=task.sensed_force(task_observation),
        contact_position=contact_position,
        approach=simulation.anatomy.face.approach.copy(),
        grasp=simulation.grasp,
        task=task,
    )
    if not isinstance(simulation.instrument, Pair):
        return view
    return replace(view, arms={side: _of_arm(view, simulation, simulation.instrument, side) for side in SIDES})


def _of_arm(view: View, simulation: Simulation, pair: Pair, side: str) -> View:
    """The view as one arm of a pair has it; its force is not sensed apart."""
    arm, force = pair.arms[side], pair.contact_force(side, simulation.contact_wrench)
    supports = simulation.anatomy.scene.supports
    return replace(
        view,
        tip_position=arm.tip_position,
        tip_velocity=arm.tip_velocity,
        true_force=force,
        sensed_force=force.copy(),
        grasp=view.grasp if arm.jaw is not None else None,
        support_force=max((pair.touch_force(side, support.name) for support in supports), default=0.0),
        arm=side,
    )
