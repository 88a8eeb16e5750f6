"""A learned acquisition function: a small convolutional network that scores every site of the chart.

Bayesian optimisation presses where an acquisition function of mean and standard deviation is largest; here a network of
3 600 parameters, the same at every site, is that function, trained by reinforcement learning (after Volpp et al. 2020,
"Meta-learning acquisition functions for transfer learning in Bayesian optimization"). Initially it is an upper
confidence bound.
"""

from collections.abc import Callable

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from agents.scoring.site_agent import SiteFacts, SiteProcess
from surgsim_env.palpation.lesion_estimator import EXCESS_SPREAD

# Bound of a feature; expected excess is some 3 spreads at most.
FEATURE_BOUND = 10.0
# Initial score = SHARPNESS x (expected excess + CURIOSITY x deviation), both in units of the prior's deviation.
SHARPNESS = 6.0
CURIOSITY = 3.0
WIDTH = 16
# Score of an excluded site: probability 0, but finite, as the entropy requires.
CLOSED_SCORE = -1e4


class SiteBelief:
    """Belief maps at the n x n sites of a chart's grid, row by row along its second axis: the observation of a policy.

    They are the expected excess and its uncertainty, as the searches gp_* of agents/site_search.py have them.
    """

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


class SiteScores(nn.Module):
    """Scores of all sites, and features for the value; convolutional, so for a grid of any size.

    Channels: expected excess, its deviation, pressed sites, the share of presses left, and the place of a site on the
    chart (x^2, y^2, and the distance from its middle). Pressed sites are not chosen again, and the outermost row is
    excluded, as in the searches gp_* of agents/site_search.py.
    """

    def __init__(self, site_count: int) -> None:
        super().__init__()
        self.site_count = site_count
        axis = torch.linspace(-1.0, 1.0, site_count)
        y, x = torch.meshgrid(axis, axis, indexing="ij")
        self.register_buffer("place", torch.stack([x * x, y * y, x.abs().maximum(y.abs())]), persistent=False)
        self.register_buffer("closed", x.abs().maximum(y.abs()) > 1.0 - 1e-6, persistent=False)
        self.body = nn.Sequential(
            nn.Conv2d(7, WIDTH, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(WIDTH, WIDTH, 3, padding=2, dilation=2),
            nn.ReLU(),
            nn.Conv2d(WIDTH, WIDTH, 1),
            nn.ReLU(),
        )
        self.score = nn.Conv2d(WIDTH, 1, 1)
        nn.init.zeros_(self.score.weight)
        assert self.score.bias is not None
        nn.init.zeros_(self.score.bias)
        self.latent_dim_pi = site_count**2
        self.latent_dim_vf = 2 * WIDTH + 1

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Scores (m, n n) and features for the value (m, latent_dim_vf) of features (m, 3 n n + 1)."""
        count, n = len(features), self.site_count
        maps, left = features[:, :-1].reshape(count, 3, n, n), features[:, -1:]
        place = self.place.expand(count, 3, n, n)
        seen = self.body(torch.cat([maps, left[:, :, None, None].expand(count, 1, n, n), place], dim=1))
        bound = SHARPNESS * (maps[:, 0] + CURIOSITY * maps[:, 1])
        closed = (maps[:, 2] > 0.5) | self.closed
        scores = (self.score(seen)[:, 0] + bound).masked_fill(closed, CLOSED_SCORE).flatten(1)
        return scores, torch.cat([seen.mean(dim=(2, 3)), seen.amax(dim=(2, 3)), left], dim=1)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """The scores only."""
        return self.forward(features)[0]

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """The features for the value only."""
        return self.forward(features)[1]


class SitePolicy(ActorCriticPolicy):
    """A policy of stable-baselines3 on `SiteBelief` features: the scores are the logits of the sites."""

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = SiteScores(round(self.action_space.n**0.5))  # type: ignore[attr-defined, assignment]

    def _build(self, lr_schedule: Callable[[float], float]) -> None:
        self._build_mlp_extractor()
        self.action_net = nn.Identity()
        self.value_net = nn.Sequential(nn.Linear(2 * WIDTH + 1, 64), nn.Tanh(), nn.Linear(64, 1))  # type: ignore[assignment]
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)
