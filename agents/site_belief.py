"""What presses make one believe: the observation of SurgSim/PalpateSites-v0 as maps of expected excess and doubt.

The maps are those of the agents gp_*.py (`agents/site_process.py`), at the sites of the observation's grid, found from
the observation alone: contrast and visits that it remembers. A policy reads them as a picture and names a site.
"""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from agents.site_process import LENGTH_SHARE
from surgsim_env.palpation.lesion_estimator import BACKGROUND_SPREAD, EXCESS_SPREAD, LesionEstimator

# Bound of a feature; expected excess is some 3 spreads at most.
FEATURE_BOUND = 10.0


@dataclass(frozen=True)
class BeliefSettings:
    """What belief is built on: the chart's extent [m], its grid's sites along an axis, the tip, the sensor's noise."""

    extent: tuple[float, float]
    site_count: int
    tip_radius: float
    noise: float


class SiteBelief:
    """Belief maps at the n x n sites of a chart's grid, row by row along its second axis."""

    action_space = gym.spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)

    def __init__(self, settings: BeliefSettings) -> None:
        self.settings, self.site_count = settings, settings.site_count
        estimator = LesionEstimator(settings.extent, tip_radius=settings.tip_radius, noise=settings.noise)
        self.noise_variance = estimator.noise_variance
        length = LENGTH_SHARE * estimator.length
        columns, rows = (np.linspace(0.0, extent, self.site_count) for extent in settings.extent)
        along = [np.exp(-0.5 * ((axis[:, None] - axis) / length) ** 2) for axis in (rows, columns)]
        # Prior covariance of the excess between the sites, (n n, n n).
        self._excess = EXCESS_SPREAD**2 * np.kron(*along)

    @property
    def space(self) -> gym.spaces.Box:
        """Of the features."""
        return gym.spaces.Box(-FEATURE_BOUND, FEATURE_BOUND, (3 * self.site_count**2 + 1,), dtype=np.float32)

    def features(self, observations: NDArray[np.floating]) -> NDArray[np.float32]:
        """Expected excess and its doubt in units of the prior's, what was touched, the presses left, (m, 3 n n + 1).

        Args:
            observations: of SurgSim/PalpateSites-v0 with memory, shape (m, n_observation).
        """
        return np.stack([self._features(observation) for observation in np.asarray(observations, dtype=np.float64)])

    def _features(self, observation: NDArray[np.float64]) -> NDArray[np.float32]:
        sites = self.site_count**2
        visited = np.flatnonzero(observation[sites : 2 * sites] > 0.5)
        mean, variance = np.zeros(sites), np.full(sites, EXCESS_SPREAD**2)
        if visited.size:
            between = self._excess[:, visited]
            covariance = between[visited] + BACKGROUND_SPREAD**2 + self.noise_variance * np.eye(visited.size)
            gain = np.linalg.solve(covariance, between.T)
            mean = observation[visited] @ gain
            variance = variance - (gain * between.T).sum(axis=0)
        doubt = np.sqrt(np.maximum(variance, 0.0))
        maps = np.concatenate([mean, doubt]) / EXCESS_SPREAD
        bounded = np.clip(maps, -FEATURE_BOUND, FEATURE_BOUND)
        return np.concatenate([bounded, observation[sites : 2 * sites], observation[-1:]]).astype(np.float32)

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
