"""Tasks: they draw an episode, read the simulation and judge it; they never advance it."""

from surgsim_env.tasks.declaration import ControlStep, reward_weights
from surgsim_env.tasks.layout import channel_slices
from surgsim_env.tasks.palpate import PalpateTask
from surgsim_env.tasks.palpate_sites import BUDGET, BUDGET_WIDE, SUCCESS_ERROR, WIDE, PalpateSitesTask
from surgsim_env.tasks.retract import RetractTask
from surgsim_env.tasks.slide import SlideTask
from surgsim_env.tasks.task import Task
from surgsim_env.tasks.visibility import Disc, uncovered

__all__ = [
    "BUDGET",
    "BUDGET_WIDE",
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
    "uncovered",
]
