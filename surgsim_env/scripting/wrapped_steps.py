"""Steps of a script that are other steps with something changed: when they end, and what their end means."""

from dataclasses import dataclass, field

from surgsim_env.scripting.checks import callable_for
from surgsim_env.scripting.steps import Plan, Predicate, Step
from surgsim_env.scripting.view import View


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
        """What the step does."""
        yield from self.step.actions(view)


@dataclass(frozen=True)
class MayEnd(_Wrapped):
    """Another step, in which the episode may come to its success: the script is then done, whatever is left of it."""

    @property
    def ends_episode(self) -> bool:
        """It may."""
        return True


@dataclass(frozen=True)
class OfArm(_Wrapped):
    """Another step, made by one of several arms; the others stay where they are."""

    arm: str

    def actions(self, view: View) -> Plan:
        """What the step does, seen from that arm."""
        plan = self.step.actions(view.of(self.arm))
        try:
            action = next(plan)
            while True:
                view = yield action
                action = plan.send(view.of(self.arm))
        except StopIteration:
            return


@dataclass(frozen=True)
class Until(_Wrapped):
    """Another step, which is over as soon as `predicate(view)` is true, or by itself."""

    predicate: Predicate = field(repr=False)

    def __post_init__(self) -> None:
        callable_for(self, "predicate", "a function of the view")

    def actions(self, view: View) -> Plan:
        """What the step does, as long as it shall."""
        if self.predicate(view):
            return
        plan = self.step.actions(view)
        try:
            action = next(plan)
            while not self.predicate(view := (yield action)):
                action = plan.send(view)
        except StopIteration:
            return
