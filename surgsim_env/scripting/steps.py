"""Steps of a script: each a small policy, written down as plain values; a script is a sequence of them.

A step's `actions` is a generator: it yields an action, is sent the view after it, and returns when it is done. What it
must remember lives in its local variables, so that the step itself never changes and can be run again.
"""

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.scripting.checks import above_zero, callable_for, point_of, unit_vector
from surgsim_env.scripting.view import Action, View

Plan = Generator[Action, View, None]
Predicate = Callable[[View], bool]

# Share of the way left that a step asks for in one control step: the tip lags behind what is asked.
APPROACH_GAIN = 0.6
# A press counts as having used up its depth this close to it [m].
DEPTH_SLACK = 2e-5
# Stiffness is read off motions longer than this [m]: over shorter ones the sensor's noise would pass for it.
TRAVEL_READ = 1e-4


class StepFailed(Exception):
    """A step cannot reach what it is for; the message says how far it came."""


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
class MoveTo:
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
    ends_episode: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "point", point_of(self, "point", self.point))
        above_zero(self, "speed", "tolerance", "timeout")

    def actions(self, view: View) -> Plan:
        """Towards the point, slower on the last millimetre."""
        left = np.atleast_1d(np.asarray(self.turn, dtype=np.float64))
        while np.linalg.norm(gap := np.array(self.point) - view.tip_position) > self.tolerance:
            velocity = _towards(gap, self.speed, view.control_step)
            if not left.any():
                view = yield view.action(velocity)
                continue
            share = float(np.linalg.norm(velocity) / np.linalg.norm(gap))
            view = yield view.action(velocity, turning=left * share)
            left = left * (1.0 - share * view.control_step)


@dataclass(frozen=True)
class PressUntil:
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
    ends_episode: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        above_zero(self, "force", "max_depth", "speed", "tolerance", "timeout")
        if self.direction is not None:
            object.__setattr__(self, "direction", unit_vector(self, "direction", self.direction))
        if self.tolerance >= self.force:
            raise ValueError(
                f"PressUntil: tolerance is {self.tolerance:g} N with a force of {self.force:g} N; "
                "it must be smaller than the force: give a smaller one"
            )

    def actions(self, view: View) -> Plan:
        """Into the tissue, in steps that shall not pass the force."""
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
            travel = float((view.tip_position - place) @ along)
            if travel > TRAVEL_READ:
                stiffness = max(stiffness, (view.pressing_force(along, sensed=self.sensed) - before) / travel)


@dataclass(frozen=True)
class Hold:
    """Keep the tip still for `duration` [s]; it ends with the first control step that is not shorter."""

    duration: float
    name: str = ""
    timeout: float = field(default=np.inf, init=False, repr=False)  # it ends by itself
    ends_episode: bool = field(default=False, init=False, repr=False)
    speed: float = field(default=0.0, init=False, repr=False)

    def __post_init__(self) -> None:
        above_zero(self, "duration")

    def actions(self, view: View) -> Plan:
        """No motion."""
        while not _over(view, self.duration):
            view = yield view.still()


@dataclass(frozen=True)
class Lift:
    """Lift the tip by `height` [m], against the scene's approach or along a direction of your own."""

    height: float
    speed: float = 0.02
    direction: tuple[float, float, float] | None = None
    timeout: float = 10.0
    name: str = ""
    ends_episode: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        above_zero(self, "height", "speed", "timeout")
        if self.direction is not None:
            object.__setattr__(self, "direction", unit_vector(self, "direction", self.direction))

    def actions(self, view: View) -> Plan:
        """Away from the tissue."""
        along = -view.approach if self.direction is None else np.array(self.direction)
        goal = view.tip_position + along * self.height
        while (left := float((goal - view.tip_position) @ along)) > 0.0:
            # A little further than asked: the tip lags behind, and the step shall end.
            view = yield view.action(along * min(self.speed, (left + 0.0002) / view.control_step))


@dataclass(frozen=True)
class WaitUntil:
    """Keep the tip still until `predicate(view)` is true; fails after `timeout` [s]."""

    predicate: Predicate = field(repr=False)
    timeout: float
    name: str = ""
    ends_episode: bool = field(default=False, init=False, repr=False)
    speed: float = field(default=0.0, init=False, repr=False)

    def __post_init__(self) -> None:
        callable_for(self, "predicate", "a function of the view")
        above_zero(self, "timeout")

    def actions(self, view: View) -> Plan:
        """No motion."""
        while not self.predicate(view):
            view = yield view.still()


@dataclass(frozen=True)
class Declare:
    """Say "the lesion is here", the tip still, until the episode ends; it counts only while the tip touches tissue."""

    timeout: float = 0.5
    name: str = ""
    ends_episode: bool = field(default=True, init=False, repr=False)
    speed: float = field(default=0.0, init=False, repr=False)

    def __post_init__(self) -> None:
        above_zero(self, "timeout")

    def actions(self, view: View) -> Plan:
        """Declare on and on: the episode's end ends it."""
        while True:
            view = yield view.still(declare=True)


@dataclass(frozen=True)
class AwaitEnd:
    """Keep the tip still until the episode ends by itself, such as by success; fails after `timeout` [s]."""

    timeout: float
    name: str = ""
    ends_episode: bool = field(default=True, init=False, repr=False)
    speed: float = field(default=0.0, init=False, repr=False)

    def __post_init__(self) -> None:
        above_zero(self, "timeout")

    def actions(self, view: View) -> Plan:
        """No motion: the episode's end ends it."""
        while True:
            view = yield view.still()


@dataclass(frozen=True)
class Control:
    """Let a controller of your own act, until `until(view)` is true or the episode ends; fails after `timeout` [s].

    The controller is called with each observation and returns the action; if it has a `reset`, that is called first.
    Without `until` it acts for `timeout`, which is then no failure.
    """

    controller: Callable[[np.ndarray], Action] = field(repr=False)
    timeout: float
    until: Predicate | None = field(default=None, repr=False)
    name: str = ""
    ends_episode: bool = field(default=True, init=False, repr=False)
    speed: float = field(default=0.0, init=False, repr=False)

    def __post_init__(self) -> None:
        callable_for(self, "controller", "called with an observation, gives an action")
        if self.until is not None:
            callable_for(self, "until", "a function of the view")
        above_zero(self, "timeout")

    def actions(self, view: View) -> Plan:
        """What the controller says."""
        reset = getattr(self.controller, "reset", None)
        if reset is not None:
            reset()
        while not (_over(view, self.timeout) if self.until is None else self.until(view)):
            view = yield np.asarray(self.controller(view.observation.copy()))


def _over(view: View, duration: float) -> bool:
    """Whether a time since the step began is over, to rounding."""
    return view.step_time >= duration - 1e-9


def _towards(gap: FloatArray, speed: float, control_step: float) -> FloatArray:
    """Velocity along a gap [m] that does not overshoot it [m/s], shape (3,)."""
    distance = float(np.linalg.norm(gap))
    return gap / distance * min(speed, APPROACH_GAIN * distance / control_step)
