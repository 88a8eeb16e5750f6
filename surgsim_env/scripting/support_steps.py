"""A step of a script that presses a tool on what the organ rests on."""

from dataclasses import dataclass, field

import numpy as np

from surgsim_env.scripting.checks import above_zero, unit_vector
from surgsim_env.scripting.steps import Plan
from surgsim_env.scripting.view import View

# How fast the tip follows a force that is missing [m/s per N]: 60 % of it in a control step of 50 ms at 2000 N/m.
GAIN = 0.006
# It drifts back over its place with this share of the way in a second.
HOMING = 2.0


@dataclass(frozen=True)
class PressSupport:
    """Press on a support at a place with `force` [N] until the episode ends; fails after `timeout` [s].

    The tip's speed is in proportion to the force that is missing.
    """

    force: float
    point: tuple[float, float, float]
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    speed: float = 0.005
    timeout: float = 5.0
    name: str = ""
    ends_episode: bool = field(default=True, init=False, repr=False)

    def __post_init__(self) -> None:
        above_zero(self, "force", "speed", "timeout")
        object.__setattr__(self, "direction", unit_vector(self, "direction", self.direction))

    def actions(self, view: View) -> Plan:
        """Towards the support, or away from it where the force is too large."""
        along = np.array(self.direction)
        while True:
            missing = self.force - view.support_force
            speed = float(np.clip(GAIN * missing, -self.speed, self.speed))
            aside = np.array(self.point) - view.tip_position
            aside -= (aside @ along) * along
            view = yield view.action(speed * along + HOMING * aside)
