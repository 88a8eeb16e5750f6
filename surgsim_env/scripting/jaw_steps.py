"""Steps of a script that open and close a jaw."""

from dataclasses import dataclass, field

from surgsim_env.scripting.checks import above_zero
from surgsim_env.scripting.steps import Plan
from surgsim_env.scripting.view import View


@dataclass(frozen=True)
class CloseJaw:
    """Close the jaw, the tip still, until it grips tissue with `force` [N]; it stays told to close afterwards."""

    force: float
    timeout: float = 3.0
    name: str = ""
    ends_episode: bool = field(default=False, init=False, repr=False)
    speed: float = field(default=0.0, init=False, repr=False)

    def __post_init__(self) -> None:
        above_zero(self, "force", "timeout")

    def actions(self, view: View) -> Plan:
        """Close."""
        while view.grasped(self).grip_force < self.force:
            view = yield view.still(jaw=-1.0)


@dataclass(frozen=True)
class OpenJaw:
    """Open the jaw, the tip still, until its pads are `gap` [m] apart and hold nothing."""

    gap: float
    timeout: float = 3.0
    name: str = ""
    ends_episode: bool = field(default=False, init=False, repr=False)
    speed: float = field(default=0.0, init=False, repr=False)

    def __post_init__(self) -> None:
        above_zero(self, "gap", "timeout")

    def actions(self, view: View) -> Plan:
        """Open."""
        while view.grasped(self).opening < self.gap or view.grasped(self).holds:
            view = yield view.still(jaw=1.0)
