"""Steps of a script: motions of the tip, presses, the jaw, controllers, wrappers of steps; their view of a run."""

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

# Largest commanded share of the remaining distance in a control step: the tip lags behind its command.
APPROACH_GAIN = 0.6
# Distance from the largest depth within which a press counts as at it [m].
DEPTH_SLACK = 2e-5
# Smallest motion for an estimate of stiffness [m]: over shorter ones the sensor's noise dominates.
TRAVEL_READ = 1e-4
# Tip speed over the error of the force on a support [m/s per N]: 60 % of it in a control step of 50 ms at 2000 N/m.
GAIN = 0.006
# Rate of a press's return to its line on a support [1/s].
HOMING = 2.0


@dataclass(frozen=True, eq=False)
class View:
    """Current state of a run, for the steps of its script and their predicates.

    Fields:
        time: since the episode's reset [s]
        step_time: since the beginning of the current step of the script [s]
        control_step: duration of a control step [s]
        observation: of the environment with its wrappers
        tip_position, tip_velocity: centre of the tip ball [m], [m/s]                       (3,)
        true_force: of the tissue on the tools, mean of the last haptic step [N]            (3,)
        sensed_force: the same through the sensor model, as observed [N]                    (3,)
        contact_position: the tip at the first contact in the step [m]; None before it  (3,)
        approach: unit vector of the instrument's approach                                  (3,)
        grasp: state of the jaw's grasp; None without a jaw
        layout: of the task's actions
        support_force: of the tool on the organ's supports [N]; for the arms of a pair
        arm: the viewing arm of a pair; "" for both or the only one
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
        """Action for a tip velocity [m/s] (3,) and further commands of the task (`declare=True`).

        A jaw keeps its last command (`jaw=-1.0` closes it); of several arms the others stand still.
        """
        if self.arm == "right":
            own = {"right": velocity, **{f"right_{name}": value for name, value in commands.items()}}
            return self.layout.action(np.zeros(3), **own)
        return self.layout.action(velocity, **commands)

    def still(self, **commands: Any) -> Action:
        """Action for a resting tip."""
        return self.action(np.zeros(3), **commands)

    def carried(self, action: Action, velocity: FloatArray) -> Action:
        """Action with a velocity [m/s] (3,) added to that of each tip, within the limits of actions."""
        moved = np.array(action, dtype=np.float64)
        for name in {"velocity", "right"} & set(self.layout.action_slices):
            part = self.layout.action_slices[name]
            moved[part] = np.clip(moved[part] + self.layout.action(**{name: velocity})[part], -1.0, 1.0)
        return moved

    def from_surface(self, shift: FloatArray, contact_shift: FloatArray) -> "View":
        """View relative to a surface shifted from rest by `shift` [m] (3,), and by `contact_shift` at first contact."""
        contact = self.contact_position
        return replace(
            self,
            tip_position=self.tip_position - shift,
            contact_position=None if contact is None else contact - contact_shift,
            arms={name: view.from_surface(shift, contact_shift) for name, view in self.arms.items()},
        )

    def grasped(self, step: object) -> Grasp:
        """Grasp of the jaw, for steps of a jaw.

        Raises:
            TypeError: the instrument has no jaw.
        """
        if self.grasp is None:
            raise TypeError(
                f"{type(step).__name__} needs an instrument with a jaw; this one has none: choose a grasper"
            )
        return self.grasp

    def pressing_force(self, direction: FloatArray, *, sensed: bool = False) -> float:
        """Force of the tissue against a unit direction [N], true or sensed."""
        return -float(matmul(self.sensed_force if sensed else self.true_force, direction))

    def depth(self, direction: FloatArray) -> float:
        """Travel of the tip along a unit direction since the step's first contact [m]; 0 before it."""
        if self.contact_position is None:
            return 0.0
        return float(matmul(self.tip_position - self.contact_position, direction))

    def reached(self) -> str:
        """Position and force of the tip in words."""
        place = ", ".join(f"{value * 1e3:.2f}" for value in self.tip_position)
        force = float(norm(self.true_force))
        return f"tip at ({place}) mm, contact force {force:.3f} N, {self.step_time:.2f} s after the step began"


Plan = Generator[Action, View, None]
Predicate = Callable[[View], bool]


class StepFailed(Exception):
    """A step cannot reach its goal; the message states the point reached."""


class Step(Protocol):
    """Protocol of a script's steps."""

    @property
    def name(self) -> str:
        """Name in the trace; "" for the name of its class."""
        ...

    @property
    def timeout(self) -> float:
        """Largest duration [s]."""
        ...

    @property
    def speed(self) -> float:
        """Largest speed of the tip [m/s]."""
        ...

    @property
    def ends_episode(self) -> bool:
        """True if the episode may end in the step."""
        ...

    def actions(self, view: View) -> Plan:
        """Yield actions, receive the view after each, return when done; raise StepFailed if that is impossible."""
        ...


Script = Sequence[Step]


@dataclass(frozen=True)
class _Checked:
    """Step with checked numbers; a resting tip and no end of the episode by default.

    Numbers have to be finite and above 0; a direction is normalised.

    Raises:
        ValueError: names the step, the field and the value.
    """

    ends_episode = False
    speed = 0.0

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.type is float and not 0.0 < value < math.inf:
                raise ValueError(
                    f"{type(self).__name__}: {entry.name} is {value!r}; it must be finite and above 0, in SI units "
                    "(metres, newtons, seconds)"
                )
            if entry.name == "direction" and value is not None:
                object.__setattr__(self, "direction", tuple((np.array(value) / norm(value)).tolist()))


@dataclass(frozen=True)
class MoveTo(_Checked):
    """Move the tip straight to within `tolerance` [m] of a point [m], at most at `speed` [m/s].

    `turn` is the even rotation of the wrist on the way, in the instrument's own terms: an angle [rad] about its hinge,
    or a rotation vector (3,) of an arm's tip.
    """

    point: tuple[float, float, float]
    speed: float = 0.02
    tolerance: float = 0.0005
    turn: float | tuple[float, ...] = 0.0
    timeout: float = 10.0
    name: str = ""

    def actions(self, view: View) -> Plan:
        """Yield velocities towards the point, slower on the last millimetre."""
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
    """Move the tip along a recorded path in its time: of a tip in `surgsim view`, or a file of time, x, y, z [s, m].

    It goes to the path's beginning first. It fails if the tip is farther than `tolerance` [m] from the path's point at
    that time, as on a path faster than `speed` [m/s]. In a pause the tip goes on as recorded; buttons are ignored.
    """

    path: Path
    arm: int = 1  # of a recording of two: 1 or 2
    speed: float = 0.02
    tolerance: float = 0.005
    timeout: float = 600.0
    name: str = ""

    def actions(self, view: View) -> Plan:
        """Yield actions to the first point, then in each control step to the path's point at its end.

        Raises:
            ValueError: a file without a recording or trajectory; names the line.
        """
        time, places = _recorded_path(Path(self.path), "" if self.arm == 1 else f"_{self.arm}")
        view = yield from _played(MoveTo(tuple(places[0].tolist()), self.speed), view)
        start = view.time
        while (now := view.time - start) < time[-1]:
            point = np.array([np.interp(now, time, column) for column in places.T])
            if (error := float(norm(point - view.tip_position))) > self.tolerance:
                raise StepFailed(f"was {error * 1e3:.1f} mm from the path of {self.path.name} at {now:.2f} s of it")
            ahead = np.array([np.interp(now + view.control_step, time, column) for column in places.T])
            gap = ahead - view.tip_position
            distance = float(norm(gap))
            pace = min(self.speed, distance / view.control_step)
            view = yield view.action(gap * (pace / distance) if distance > 0.0 else np.zeros(3))


def _recorded_path(path: Path, mark: str) -> tuple[FloatArray, FloatArray]:
    """Times from 0 [s] (n,) and positions [m] (n, 3) of a recorded tip, else of a hand without pauses."""
    with path.open(encoding="utf-8", errors="replace") as file:
        of_tip = f"{TIP_PREFIX}x{mark}" in file.readline().strip().split(",")
    motion = read_motion(path, mark, of_tip=of_tip)
    known = np.isfinite(motion.position).all(axis=1)
    time, places = motion.time[known], motion.position[known]
    return time - time[0], places


def _played(step: Step, view: View, arm: str = "") -> Generator[Action, View, View]:
    """Actions of a step within another one, for an arm of several; returns the last view."""
    plan = step.actions(view.arms[arm] if arm else view)
    try:
        action = next(plan)
        while True:
            view = yield action
            action = plan.send(view.arms[arm] if arm else view)
    except StopIteration:
        return view


@dataclass(frozen=True)
class PressUntil(_Checked):
    """Press until the tissue's force is `force` [N], less `tolerance`, at most `max_depth` [m] past contact.

    It slows down near the force, by the estimated stiffness. Depth counts from the first contact in this step; a press
    at its largest depth without the force fails. The force is the true or the sensed one.
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
        """Yield velocities into the tissue, chosen not to exceed the force."""
        along = view.approach if self.direction is None else np.array(self.direction)
        stiffness = 0.0
        while (force := view.pressing_force(along, sensed=self.sensed)) < self.force - self.tolerance:
            left = self.max_depth - view.depth(along)
            if left <= DEPTH_SLACK:
                raise StepFailed(f"pressed {self.max_depth * 1e3:.2f} mm past contact and felt {force:.3f} N")
            speed = min(self.speed, left / view.control_step)
            if stiffness > 0.0:
                speed = min(speed, (self.force - force) / (stiffness * view.control_step))
            place = view.tip_position
            view = yield view.action(along * speed)
            travel = float(matmul(view.tip_position - place, along))
            if travel > TRAVEL_READ:
                stiffness = max(stiffness, (view.pressing_force(along, sensed=self.sensed) - force) / travel)


@dataclass(frozen=True)
class Hold(_Checked):
    """Keep the tip still for `duration` [s], rounded up to control steps."""

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
        """Yield velocities away from the tissue."""
        along = -view.approach if self.direction is None else np.array(self.direction)
        goal = view.tip_position + along * self.height
        while (left := float(matmul(goal - view.tip_position, along))) > 0.0:
            # A little beyond the goal: the tip lags behind its command, and the step has to end.
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
    """Declare the lesion at the resting tip until the episode ends; it counts only in contact with tissue."""

    timeout: float = 0.5
    name: str = ""
    ends_episode = True

    def actions(self, view: View) -> Plan:
        """Declare in each control step until the end of the episode."""
        while True:
            view = yield view.still(declare=True)


@dataclass(frozen=True)
class AwaitEnd(_Checked):
    """Keep the tip still until the episode ends, such as by success; fails after `timeout` [s]."""

    timeout: float
    name: str = ""
    ends_episode = True

    def actions(self, view: View) -> Plan:
        """No motion until the end of the episode."""
        while True:
            view = yield view.still()


@dataclass(frozen=True)
class Control(_Checked):
    """Act by a controller of your own until `until(view)` is true or the episode ends; fails after `timeout` [s].

    The controller is called with each observation and returns the action, or a dictionary of commands in SI units by
    name; its `reset`, if any, is called first. Without `until` it acts for `timeout`, without failure.
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
    """True after a duration [s] of the step, to rounding."""
    return view.step_time >= duration - 1e-9


def _towards(gap: FloatArray, speed: float, control_step: float) -> FloatArray:
    """Velocity along a gap [m] without overshoot [m/s], shape (3,)."""
    distance = float(norm(gap))
    return gap / distance * min(speed, APPROACH_GAIN * distance / control_step)


@dataclass(frozen=True)
class CloseJaw(_Checked):
    """Close the jaw, the tip still, until it grips tissue with `force` [N]; its command stays closed."""

    force: float
    timeout: float = 3.0
    name: str = ""

    def actions(self, view: View) -> Plan:
        """Close."""
        while view.grasped(self).grip_force < self.force:
            view = yield view.still(jaw=-1.0)


@dataclass(frozen=True)
class OpenJaw(_Checked):
    """Open the jaw, the tip still, until its pads are `gap` [m] apart and without tissue."""

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
        """Yield velocities towards the support, or away from it if the force is too large."""
        along = np.array(self.direction)
        while True:
            error = self.force - view.support_force
            speed = float(np.clip(GAIN * error, -self.speed, self.speed))
            aside = np.array(self.point) - view.tip_position
            aside -= matmul(aside, along) * along
            view = yield view.action(speed * along + HOMING * aside)


@dataclass(frozen=True)
class _Wrapped:
    """Wrapper of a step, with its name, timeout and speed."""

    step: Step

    @property
    def name(self) -> str:
        """Name of the step or its class."""
        return self.step.name or type(self.step).__name__

    @property
    def timeout(self) -> float:
        """Timeout of the step [s]."""
        return self.step.timeout

    @property
    def speed(self) -> float:
        """Speed of the step [m/s]."""
        return self.step.speed

    @property
    def ends_episode(self) -> bool:
        """Property of the step."""
        return self.step.ends_episode

    def actions(self, view: View) -> Plan:
        """Actions of the step."""
        yield from self.step.actions(view)


@dataclass(frozen=True)
class MayEnd(_Wrapped):
    """Wrapper for a step with a possible end of the episode in success; the remaining script is then skipped."""

    @property
    def ends_episode(self) -> bool:
        """True."""
        return True


@dataclass(frozen=True)
class OfArm(_Wrapped):
    """Wrapper for a step of one of several arms; the others stand still."""

    arm: str

    def actions(self, view: View) -> Plan:
        """Actions of the step from the arm's view."""
        yield from _played(self.step, view, self.arm)


@dataclass(frozen=True)
class Until(_Wrapped):
    """Wrapper for a step that ends as soon as `predicate(view)` is true, or by itself."""

    predicate: Predicate = field(repr=False)

    def actions(self, view: View) -> Plan:
        """Actions of the step until the predicate is true."""
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
    """Wrapper for a step on a moving surface: its points are on the surface at rest, and all tips move with it."""

    tracker: SurfaceTracker = field(repr=False)

    def actions(self, view: View) -> Plan:
        """Actions of the step relative to the surface, plus the surface's velocity in the next control step."""
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
