"""The methods that `agents.evaluate` knows by name."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym

from agents.expert_palpate import PalpateExpert
from agents.expert_retract import RetractExpert
from agents.gp_level_set import GpLevelSet
from agents.gp_ucb import GpUcb
from agents.gp_variance import GpVariance
from agents.random_sites import RandomSites
from agents.raster_sites import RasterSites
from agents.site_agent import SiteAgent
from agents.sobol_sites import SobolSites
from agents.task_episodes import Actor
from agents.words import Middle, Truth

# Rasters of so many places a side are tried on each scene; the leaderboard shows the best of them.
RASTER_SIDES = (2, 3, 4, 5, 6, 7)

AGENTS: dict[str, Callable[[], SiteAgent]] = {
    "random": RandomSites,
    **{f"raster_{side}": lambda side=side: RasterSites(side) for side in RASTER_SIDES},
    "sobol": SobolSites,
    "gp_variance": GpVariance,
    "gp_ucb": GpUcb,
    "gp_level_set": GpLevelSet,
    # What the scores are at best, and by guessing.
    "truth": Truth,
    "middle": Middle,
}

# Those that say where lesions are without feeling for them.
WORDS = ("truth", "middle")


@dataclass(frozen=True)
class TaskAgent:
    """A script for another environment than SurgSim/PalpateSites-v0.

    Args:
        env_id: the environment's.
        make: the script, for the environment's arguments.
        kwargs: arguments of its own that the environment needs.
        has_places: whether the environment takes `scene` and `level`.
    """

    env_id: str
    make: Callable[[dict[str, Any]], Actor]
    kwargs: dict[str, Any] = field(default_factory=dict)
    has_places: bool = False


def _palpate_expert(kwargs: dict[str, Any]) -> Actor:
    expert = PalpateExpert(gym.make("SurgSim/Palpate-v0", **kwargs))
    return lambda observations, begins: expert.act(observations)


TASK_AGENTS = {
    "expert_retract": TaskAgent("SurgSim/Retract-v0", lambda kwargs: RetractExpert().act_all),
    "expert_palpate": TaskAgent("SurgSim/Palpate-v0", _palpate_expert, {"memory": True}, has_places=True),
}

POLICIES = Path(__file__).resolve().parent / "policies"


def find_agent(name: str) -> Callable[[], SiteAgent]:
    """How to make the agent of a name.

    Raises:
        ValueError: an unknown name; lists the known.
    """
    if name not in AGENTS:
        raise ValueError(f"agent {name!r} is unknown; the agents are {', '.join([*AGENTS, *TASK_AGENTS])}")
    return AGENTS[name]
