"""The methods that `agents.evaluate` knows by name, with the reference scores: oracle and blind guess."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from agents.expert_palpate import PalpateExpert
from agents.expert_retract import RetractExpert
from agents.gp_level_set import GpLevelSet
from agents.gp_ucb import GpUcb
from agents.gp_variance import GpVariance
from agents.random_sites import RandomSites
from agents.raster_sites import RasterSites
from agents.scoring.site_agent import SiteAgent, SiteFacts
from agents.scoring.task_episodes import Actor
from agents.sobol_sites import SobolSites
from surgsim_env.palpation.scores import MapScore


class Truth:
    """The oracle: estimates the true lesions, so that every place, map and outline scores 100 %.

    It presses the middle of the chart, as the environment asks for presses; `estimate` and `estimate_map` are scored
    in place of the estimator's output.
    """

    def reset(self, rng: np.random.Generator, facts: SiteFacts) -> None:
        """Begin an episode."""

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """The middle of the chart."""
        return np.zeros(2, dtype=np.float32)

    def estimate(self, task: Any) -> NDArray[np.float64]:
        """Places of the lesions on the surface [m], shape (k, 3)."""
        return task.truth

    def estimate_map(self, made: MapScore) -> MapScore:
        """The true map: 1 over lesions, else 0, and the true outline."""
        return replace(made, excess=made.lesion.astype(np.float64), outline=made.outline_true)


class Middle(Truth):
    """The blind guess: one lesion in the middle of the chart, regardless of the presses."""

    def estimate(self, task: Any) -> NDArray[np.float64]:
        """The middle of the chart on the surface [m], shape (1, 3)."""
        return task.charted.surface(np.zeros((1, 2)))

    def estimate_map(self, made: MapScore) -> MapScore:
        """A uniform map without an outline."""
        return replace(made, excess=np.zeros_like(made.excess), outline=np.zeros_like(made.outline))


# Sides of the rasters tried on each scene; the leaderboard shows the best raster.
RASTER_SIDES = (2, 3, 4, 5, 6, 7)

AGENTS: dict[str, Callable[[], SiteAgent]] = {
    "random": RandomSites,
    **{f"raster_{side}": lambda side=side: RasterSites(side) for side in RASTER_SIDES},
    "sobol": SobolSites,
    "gp_variance": GpVariance,
    "gp_ucb": GpUcb,
    "gp_level_set": GpLevelSet,
    # Bounds of the scores: the truth, and a blind guess.
    "truth": Truth,
    "middle": Middle,
}

# Methods whose estimates do not depend on what their presses feel.
REFERENCES = ("truth", "middle")


@dataclass(frozen=True)
class TaskAgent:
    """A script for another environment than SurgSim/PalpateSites-v0.

    Args:
        env_id: the environment's.
        make: the script, for the environment's arguments.
        kwargs: further arguments of the environment.
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
    """The factory of the agent with a name.

    Raises:
        ValueError: an unknown name (lists the known).
    """
    if name not in AGENTS:
        raise ValueError(f"agent {name!r} is unknown; the agents are {', '.join([*AGENTS, *TASK_AGENTS])}")
    return AGENTS[name]
