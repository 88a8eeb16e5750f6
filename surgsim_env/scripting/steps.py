"""The steps of a script: motions of the tip, presses, the jaw, controllers, steps that wrap others; what they see."""

import copy
import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import matmul, norm
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.tracking import SurfaceTracker
from surgsim_env.envs.surgical_env import Observation
from surgsim_env.instruments.instrument import Grasp
from surgsim_env.scripting.motion_file import TIP_PREFIX, read_motion
from surgsim_env.tasks.layout import TaskLayout

Action = NDArray[np.floating]

# Share of the remaining distance that a step commands for one control step: the tip lags behind its command.
APPROACH_GAIN = 0.6
# A press has used up its depth within this distance of it [m].
DEPTH_SLACK = 2e-5
# Stiffness is estimated over motions longer than this [m]: over shorter ones the sensor's noise dominates.
TRAVEL_READ = 1e-4
# Tip speed over the error of the force on a support [m/s per N]: 60 % of it in a control step of 50 ms at 2000 N/m.
GAIN = 0.006
# Rate at which a press on a support returns to its place across the press [1/s].
HOMING = 2.0


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
        layout: of the task's actions
        support_force: of the tool on the organ's supports [N]; for the arms of a pair
        arm: the arm of a pair whose view this is; "" for both or the only one
        arms: views of each of several arms, by name
    """

    time: float
    step_time: float
    control_step: float
    observation: Observation
    tip_position: FloatArray
    tip_velocity: FloatArray
    true_force: FloatArray
    sensed_force: FloatArray
    contact_position: FloatArray | None
    approach: FloatArray
    grasp: Grasp | None
    layout: TaskLayout
    support_force: float = 0.0
    arm: str = ""
    arms: Mapping[str, "View"] = field(default_factory=dict)

    def action(self, velocity: FloatArray, **commands: Any) -> Action:
        """The action that asks for a tip velocity [m/s] (3,), and for what else the task takes (`declare=True`).

        A jaw stays as it was last told (`jaw=-1.0` closes it); of several arms the others stay where they are.
        """
        if self.arm == "right":
            own = {"right": velocity, **{f"right_{name}": value for name, value in commands.items()}}
            return self.layout.action(np.zeros(3), **own)
        return self.layout.action(velocity, **commands)

    def still(self, **commands: Any) -> Action:
        """The action that keeps the tip where it is."""
        return self.action(np.zeros(3), **commands)

    def carried(self, action: Action, velocity: FloatArray) -> Action:
        """An action with a velocity [m/s] (3,) added to that of each tip, within what an action can ask for."""
        moved = np.array(action, dtype=np.float64)
        for name in {"velocity", "right"} & set(self.layout.action_slices):
            part = self.layout.action_slices[name]
            moved[part] = np.clip(moved[part] + self.layout.action(**{name: velocity})[part], -1.0, 1.0)
        return moved

    def from_surface(self, shift: FloatArray, contact_shift: FloatArray) -> "View":
        """The view as seen from a surface that moved by a shift [m] (3,) from rest, and by another at first contact."""
        contact = self.contact_position
        return replace(
            self,
            tip_position=self.tip_position - shift,
            contact_position=None if contact is None else contact - contact_shift,
            arms={name: view.from_surface(shift, contact_shift) for name, view in self.arms.items()},
        )

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

    def pressing_force(self, direction: FloatArray, *, sensed: bool = False) -> float:
        """The force with which the tissue pushes back against a unit direction [N], true or sensed."""
        return -float(matmul(self.sensed_force if sensed else self.true_force, direction))

    def depth(self, direction: FloatArray) -> float:
        """How far the tip went along a unit direction since the step's first contact [m]; 0 before it."""
        if self.contact_position is None:
            return 0.0
        return float(matmul(self.tip_position - self.contact_position, direction))

    def reached(self) -> str:
        """Where the tip is and what it feels, in words."""
        place = ", ".join(f"{value * 1e3:.2f}" for value in self.tip_position)
        force = float(norm(self.true_force))
        return f"tip at ({place}) mm, contact force {force:.3f} N, {self.step_time:.2f} s after the step began"


Plan = Generator[Action, View, None]
Predicate = Callable[[View], bool]


class StepFailed(Exception):
    """A step cannot reach its goal; the message says how far it came."""


class Step(Protocol):
    """One step of a script; any object like this is one."""

    @property
    def name(self) -> str:
        """How the trace calls it; "" for the name of its class."""
        ...

    @property
    def timeout(self) -> float:
        """The longest that it may take [s]."""
        ...

    @property
    def speed(self) -> float:
        """The fastest that it moves the tip [m/s]."""
        ...

    @property
    def ends_episode(self) -> bool:
        """Whether the episode may end in it."""
        ...

    def actions(self, view: View) -> Plan:
        """Yield actions, receive the view after each, return when done; StepFailed where that cannot be."""
        ...


Script = Sequence[Step]


@dataclass(frozen=True)
class _Checked:
    """A step that does not move the tip and does not end the episode, unless a subclass says otherwise.

    Its numbers are finite and above 0; its direction is brought to length 1.

    Raises:
        ValueError: names the step, the field and the value.
    """

    ends_episode = False
    speed = 0.0

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if one.type is float and not 0.0 < value < math.inf:
                raise ValueError(
                    f"{type(self).__name__}: {one.name} is {value!r}; it must be a finite number above 0, in SI units "
                    "(metres, newtons, seconds)"
                )
            if one.name == "direction" and value is not None:
                object.__setattr__(self, "direction", tuple((np.array(value) / norm(value)).tolist()))


@dataclass(frozen=True)
class MoveTo(_Checked):
    """Move the tip straight to a point [m], until it is within `tolerance` [m] of it, at `speed` [m/s] or slower.

    `turn` is how far the wrist turns on the way, evenly, in the instrument's own terms: an angle [rad] about its hinge,
    or a rotation vector (3,) of an arm's tip.
    """

    point: tuple[float, float, float]
    speed: float = 0.02
    tolerance: float = 0.0005
    turn: float | tuple[float, ...] = 0.0
    timeout: float = 10.0
    name: str = ""

    def actions(self, view: View) -> Plan:
        """Towards the point, slower on the last millimetre."""
        left = np.atleast_1d(np.asarray(self.turn, dtype=np.float64))
        while norm(gap := np.array(self.point) - view.tip_position) > self.tolerance:
            velocity = _towards(gap, self.speed, view.control_step)
            if not left.any():
                view = yield view.action(velocity)
                continue
            share = float(norm(velocity) / norm(gap))
            view = yield view.action(velocity, turning=left * share)
            left = left * (1.0 - share * view.control_step)


@dataclass(frozen=True)
class Follow(_Checked):
    """Move the tip along a recording's path at its pace: of the tip that `surgsim view` recorded, or time, x, y, z [m].

    It goes to the path's beginning first. It fails where the tip is farther than `tolerance` [m] from where it was at
    that time, such as on a path faster than `speed` [m/s]. In a pause the tip goes on as recorded; buttons do nothing.
    """

    path: Path
    arm: int = 1  # of a recording of two: 1 or 2
    speed: float = 0.02
    tolerance: float = 0.005
    timeout: float = 600.0
    name: str = ""

    def actions(self, view: View) -> Plan:
        """To the first place, then each control step to where the tip was at its end.

        Raises:
            ValueError: a file that is no recording and no trajectory; names the line.
        """
        time, places = _recorded_path(Path(self.path), "" if self.arm == 1 else f"_{self.arm}")
        view = yield from _all_of(MoveTo(tuple(places[0].tolist()), self.speed), view)
        begun = view.time
        while (now := view.time - begun) < time[-1]:
            there = np.array([np.interp(now, time, column) for column in places.T])
            if (missed := float(norm(there - view.tip_position))) > self.tolerance:
                raise StepFailed(f"was {missed * 1e3:.1f} mm from the path of {self.path.name} at {now:.2f} s of it")
            ahead = np.array([np.interp(now + view.control_step, time, column) for column in places.T])
            way = ahead - view.tip_position
            distance = float(norm(way))
            pace = min(self.speed, distance / view.control_step)
            view = yield view.action(way * (pace / distance) if distance > 0.0 else np.zeros(3))


def _recorded_path(path: Path, mark: str) -> tuple[FloatArray, FloatArray]:
    """Times from 0 [s] (n,) and places [m] (n, 3) of a tip that was recorded, else of a hand without pauses."""
    with path.open(encoding="utf-8", errors="replace") as file:
        of_tip = f"{TIP_PREFIX}x{mark}" in file.readline().strip().split(",")
    motion = read_motion(path, mark, of_tip=of_tip)
    known = np.isfinite(motion.position).all(axis=1)
    time, places = motion.time[known], motion.position[known]
    return time - time[0], places


def _all_of(step: "Step", view: View) -> Generator[Action, View, View]:
    """The actions of a step within another one; returns the last view."""
    plan = step.actions(view)
    try:
        action = next(plan)
        while True:
            view = yield action
            action = plan.send(view)
    except StopIteration:
        return view


@dataclass(frozen=True)
class PressUntil(_Checked):
    """Press until the tissue pushes back with `force` [N], less `tolerance`, at most `max_depth` [m] past contact.

    It slows down as the force comes near, by the stiffness that it feels. Depth counts from where the tip first touched
    in this step; a press that used it up without the force fails. The force is the true one, or what the sensor reads.
    """

    force: float
    max_depth: float
    speed: float = 0.01
    direction: tuple[float, float, float] | None = None  # of the press; the scene's approach by default
    sensed: bool = False
    tolerance: float = 0.01
    timeout: float = 10.0
    name: str = ""

    def actions(self, view: View) -> Plan:
        """Into the tissue, in steps that are not meant to exceed the force."""
        along = view.approach if self.direction is None else np.array(self.direction)
        stiffness = 0.0
        while (felt := view.pressing_force(along, sensed=self.sensed)) < self.force - self.tolerance:
            left = self.max_depth - view.depth(along)
            if left <= DEPTH_SLACK:
                raise StepFailed(f"pressed {self.max_depth * 1e3:.2f} mm past contact and felt {felt:.3f} N")
            speed = min(self.speed, left / view.control_step)
            if stiffness > 0.0:
                speed = min(speed, (self.force - felt) / (stiffness * view.control_step))
            before, place = felt, view.tip_position
            view = yield view.action(along * speed)
            travel = float(matmul(view.tip_position - place, along))
            if travel > TRAVEL_READ:
                stiffness = max(stiffness, (view.pressing_force(along, sensed=self.sensed) - before) / travel)


@dataclass(frozen=True)
class Hold(_Checked):
    """Keep the tip still for `duration` [s]; it ends with the first control step that is not shorter."""

    duration: float
    name: str = ""
    timeout = math.inf  # it ends by itself

    def actions(self, view: View) -> Plan:
        """No motion."""
        while not _over(view, self.duration):
            view = yield view.still()


@dataclass(frozen=True)
class Lift(_Checked):
    """Lift the tip by `height` [m], against the scene's approach or along a direction of your own."""

    height: float
    speed: float = 0.02
    direction: tuple[float, float, float] | None = None
    timeout: float = 10.0
    name: str = ""

    def actions(self, view: View) -> Plan:
        """Away from the tissue."""
        along = -view.approach if self.direction is None else np.array(self.direction)
        goal = view.tip_position + along * self.height
        while (left := float(matmul(goal - view.tip_position, along))) > 0.0:
            # A little further than the goal: the tip lags behind its command, and the step has to end.
            view = yield view.action(along * min(self.speed, (left + 0.0002) / view.control_step))


@dataclass(frozen=True)
class WaitUntil(_Checked):
    """Keep the tip still until `predicate(view)` is true; fails after `timeout` [s]."""

    predicate: Predicate = field(repr=False)
    timeout: float
    name: str = ""

    def actions(self, view: View) -> Plan:
        """No motion."""
        while not self.predicate(view):
            view = yield view.still()


@dataclass(frozen=True)
class Declare(_Checked):
    """Say "the lesion is here", the tip still, until the episode ends; it counts only while the tip touches tissue."""

    timeout: float = 0.5
    name: str = ""
    ends_episode = True

    def actions(self, view: View) -> Plan:
        """Declare in every control step: the episode's end ends it."""
        while True:
            view = yield view.still(declare=True)


@dataclass(frozen=True)
class AwaitEnd(_Checked):
    """Keep the tip still until the episode ends by itself, such as by success; fails after `timeout` [s]."""

    timeout: float
    name: str = ""
    ends_episode = True

    def actions(self, view: View) -> Plan:
        """No motion: the episode's end ends it."""
        while True:
            view = yield view.still()


@dataclass(frozen=True)
class Control(_Checked):
    """Let a controller of your own act, until `until(view)` is true or the episode ends; fails after `timeout` [s].

    The controller is called with each observation and returns the action, or a dictionary of commands in SI units, by
    name; if it has a `reset`, that is called first.
    Without `until` it acts for `timeout`, which is then no failure.
    """

    controller: Callable[[np.ndarray], Action | dict[str, Any]] = field(repr=False)
    timeout: float
    until: Predicate | None = field(default=None, repr=False)
    name: str = ""
    ends_episode = True

    def actions(self, view: View) -> Plan:
        """The controller's actions."""
        reset = getattr(self.controller, "reset", None)
        if reset is not None:
            reset()
        while not (_over(view, self.timeout) if self.until is None else self.until(view)):
            acted = self.controller(copy.deepcopy(view.observation))
            view = yield view.layout.action(**acted) if isinstance(acted, dict) else np.asarray(acted)


def _over(view: View, duration: float) -> bool:
    """Whether a time since the step began is over, to rounding."""
    return view.step_time >= duration - 1e-9


def _towards(gap: FloatArray, speed: float, control_step: float) -> FloatArray:
    """Velocity along a gap [m] that does not overshoot it [m/s], shape (3,)."""
    distance = float(norm(gap))
    return gap / distance * min(speed, APPROACH_GAIN * distance / control_step)


@dataclass(frozen=True)
class CloseJaw(_Checked):
    """Close the jaw, the tip still, until it grips tissue with `force` [N]; its target stays closed afterwards."""

    force: float
    timeout: float = 3.0
    name: str = ""

    def actions(self, view: View) -> Plan:
        """Close."""
        while view.grasped(self).grip_force < self.force:
            view = yield view.still(jaw=-1.0)


@dataclass(frozen=True)
class OpenJaw(_Checked):
    """Open the jaw, the tip still, until its pads are `gap` [m] apart and hold nothing."""

    gap: float
    timeout: float = 3.0
    name: str = ""

    def actions(self, view: View) -> Plan:
        """Open."""
        while view.grasped(self).opening < self.gap or view.grasped(self).holds:
            view = yield view.still(jaw=1.0)


@dataclass(frozen=True)
class PressSupport(_Checked):
    """Press on a support at a point [m] with `force` [N] until the episode ends; fails after `timeout` [s].

    The tip's speed is proportional to the error of the force.
    """

    force: float
    point: tuple[float, float, float]
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    speed: float = 0.005
    timeout: float = 5.0
    name: str = ""
    ends_episode = True

    def actions(self, view: View) -> Plan:
        """Towards the support, or away from it where the force is too large."""
        along = np.array(self.direction)
        while True:
            missing = self.force - view.support_force
            speed = float(np.clip(GAIN * missing, -self.speed, self.speed))
            aside = np.array(self.point) - view.tip_position
            aside -= matmul(aside, along) * along
            view = yield view.action(speed * along + HOMING * aside)


@dataclass(frozen=True)
class _Wrapped:
    """Another step; its name, its timeout and its speed are that step's."""

    step: Step

    @property
    def name(self) -> str:
        """The step's own, or its class's."""
        return self.step.name or type(self.step).__name__

    @property
    def timeout(self) -> float:
        """The step's own [s]."""
        return self.step.timeout

    @property
    def speed(self) -> float:
        """The step's own [m/s]."""
        return self.step.speed

    @property
    def ends_episode(self) -> bool:
        """As the step says."""
        return self.step.ends_episode

    def actions(self, view: View) -> Plan:
        """The step's actions."""
        yield from self.step.actions(view)


@dataclass(frozen=True)
class MayEnd(_Wrapped):
    """Another step, in which the episode may end in success; the rest of the script is then skipped."""

    @property
    def ends_episode(self) -> bool:
        """True: the episode may end in this step."""
        return True


@dataclass(frozen=True)
class OfArm(_Wrapped):
    """Another step, made by one of several arms; the others stay where they are."""

    arm: str

    def actions(self, view: View) -> Plan:
        """The step's actions, from that arm's view."""
        plan = self.step.actions(view.arms[self.arm])
        try:
            action = next(plan)
            while True:
                view = yield action
                action = plan.send(view.arms[self.arm])
        except StopIteration:
            return


@dataclass(frozen=True)
class Until(_Wrapped):
    """Another step, which is over as soon as `predicate(view)` is true, or by itself."""

    predicate: Predicate = field(repr=False)

    def actions(self, view: View) -> Plan:
        """The step's actions until the predicate is true."""
        if self.predicate(view):
            return
        plan = self.step.actions(view)
        try:
            action = next(plan)
            while not self.predicate(view := (yield action)):
                action = plan.send(view)
        except StopIteration:
            return


@dataclass(frozen=True)
class Tracked(_Wrapped):
    """Another step on a surface that moves: its points are those of the surface at rest, and all tips go with it."""

    tracker: SurfaceTracker = field(repr=False)

    def actions(self, view: View) -> Plan:
        """The step's actions as seen from the surface, and the surface's velocity in the next control step."""
        shift, contact_shift = self.tracker.displacement(), None
        plan = self.step.actions(view.from_surface(shift, shift))
        try:
            action = next(plan)
            while True:
                velocity = (self.tracker.displacement(view.control_step) - shift) / view.control_step
                view = yield view.carried(action, velocity)
                self.tracker.look()
                shift = self.tracker.displacement()
                if contact_shift is None and view.contact_position is not None:
                    contact_shift = shift
                action = plan.send(view.from_surface(shift, shift if contact_shift is None else contact_shift))
        except StopIteration:
            return
