"""Belief maps of SurgSim/PalpateSites-v0 as observations: expected excess and its uncertainty at the grid's sites.

The maps are those of the searches gp_* of agents/site_search.py. A policy reads them as a picture
and names a site.
"""

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from agents.scoring.site_agent import SiteFacts, SiteProcess
from surgsim_env.palpation.lesion_estimator import EXCESS_SPREAD

# Bound of a feature; expected excess is some 3 spreads at most.
FEATURE_BOUND = 10.0


class SiteBelief:
    """Belief maps at the n x n sites of a chart's grid, row by row along its second axis."""

    action_space = gym.spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)

    def __init__(self, facts: SiteFacts) -> None:
        self.facts, self.site_count = facts, facts.site_count
        self.process = SiteProcess(facts)

    @property
    def space(self) -> gym.spaces.Box:
        """Of the features."""
        return gym.spaces.Box(-FEATURE_BOUND, FEATURE_BOUND, (3 * self.site_count**2 + 1,), dtype=np.float32)

    def features(self, observations: NDArray[np.floating]) -> NDArray[np.float32]:
        """Expected excess and its deviation over the prior's, visited sites, share of presses left, (m, 3 n n + 1).

        Args:
            observations: of SurgSim/PalpateSites-v0 with memory, shape (m, n_observation).
        """
        return np.stack([self._features(observation) for observation in np.asarray(observations, dtype=np.float64)])

    def _features(self, observation: NDArray[np.float64]) -> NDArray[np.float32]:
        belief, slices = self.process.belief(observation), self.facts.slices
        maps = np.concatenate([belief.excess, belief.spread]) / EXCESS_SPREAD
        bounded = np.clip(maps, -FEATURE_BOUND, FEATURE_BOUND)
        rest = [observation[slices[name]] for name in ("pressed_map", "presses_left")]
        return np.concatenate([bounded, *rest]).astype(np.float32)

    def action(self, site: int | NDArray[np.integer]) -> NDArray[np.float32]:
        """The environment's action that presses a site, shape (..., 2)."""
        row, column = np.divmod(np.asarray(site), self.site_count)
        return np.stack([column, row], axis=-1).astype(np.float32) * (2.0 / (self.site_count - 1)) - 1.0


class BelievingEnvs(VecEnvWrapper):
    """Environments of SurgSim/PalpateSites-v0 whose observation is the belief and whose action is a site's number."""

    def __init__(self, envs: VecEnv, belief: SiteBelief) -> None:
        choice = gym.spaces.Discrete(belief.site_count**2)
        super().__init__(envs, observation_space=belief.space, action_space=choice)
        self.belief = belief

    def reset(self) -> VecEnvObs:
        """Start an episode everywhere."""
        return self.belief.features(np.asarray(self.venv.reset()))

    def step_async(self, actions: np.ndarray) -> None:
        """Press the sites (n_env,)."""
        self.venv.step_async(self.belief.action(actions))

    def step_wait(self) -> VecEnvStepReturn:
        """One press of all."""
        observation, reward, done, infos = self.venv.step_wait()
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = self.belief.features(info["terminal_observation"][None])[0]
        return self.belief.features(np.asarray(observation)), reward, done, infos
