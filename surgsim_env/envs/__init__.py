"""Gymnasium environments, their ids, vector environments, and an interface for stable-baselines3."""

from surgsim_env.envs.ids import TASKS
from surgsim_env.envs.palpate_sites_env import PalpateSitesEnv
from surgsim_env.envs.surgical_env import SurgicalEnv

__all__ = [
    "TASKS",
    "PalpateSitesEnv",
    "SurgicalEnv",
]
