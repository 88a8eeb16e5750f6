"""Tasks: they draw an episode, read the simulation and judge it; they never advance it."""

from surgsim_env.tasks.channels import LENGTH_SCALE
from surgsim_env.tasks.declaration import SPEED_FULL_SCALE, ControlStep, reward_weights
from surgsim_env.tasks.layout import channel_slices
from surgsim_env.tasks.palpate import DECLARE_STEPS, DECLARE_VALUE, EPISODE_STEPS, START_GAP, PalpateTask, touch_memory
from surgsim_env.tasks.palpate_sites import BUDGET, BUDGET_WIDE, SUCCESS_ERROR, WIDE, PalpateSitesTask
from surgsim_env.tasks.retract import RetractTask
from surgsim_env.tasks.slide import SlideTask
from surgsim_env.tasks.task import Task
from surgsim_env.tasks.visibility import Disc, uncovered

__all__ = [
    "BUDGET",
    "BUDGET_WIDE",
    "DECLARE_STEPS",
    "DECLARE_VALUE",
    "EPISODE_STEPS",
    "LENGTH_SCALE",
    "SPEED_FULL_SCALE",
    "START_GAP",
    "SUCCESS_ERROR",
    "WIDE",
    "ControlStep",
    "Disc",
    "PalpateSitesTask",
    "PalpateTask",
    "RetractTask",
    "SlideTask",
    "Task",
    "channel_slices",
    "reward_weights",
    "touch_memory",
    "uncovered",
]
