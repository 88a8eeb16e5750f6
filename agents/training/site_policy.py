"""A learned acquisition function: a small convolutional network that scores every site of the touch map.

Bayesian optimisation presses where an acquisition function of mean and standard deviation is largest; here a network of
some thousand parameters, the same at every site of every organ, is that function, trained by reinforcement learning
(after Volpp et al. 2020, "Meta-learning acquisition functions for transfer learning in Bayesian optimization").
Initially it is an upper confidence bound.
"""

from collections.abc import Callable

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from agents.scoring.site_agent import SITE_COUNT, SLICES, SiteProcess, observed_facts
from surgsim_env.palpation.chart import MAP_SIDE
from surgsim_env.palpation.lesion_estimator import EXCESS_SPREAD

# Bound of a feature; expected excess is some 3 spreads at most.
FEATURE_BOUND = 10.0
# Initial score = SHARPNESS x (expected excess + CURIOSITY x deviation), both in units of the prior's deviation.
SHARPNESS = 6.0
CURIOSITY = 3.0
WIDTH = 16
# Features of the value: of each channel the mean and the largest value over the face, and the numbers.
VALUE_SIZE = 2 * WIDTH + 2
# Score of an excluded site: probability 0, but finite, as the entropy requires.
CLOSED_SCORE = -1e4


# Spaces of a policy that reads belief maps and chooses a site; MAPS maps and NUMBERS numbers.
MAPS, NUMBERS = 4, 2
FEATURE_SPACE = gym.spaces.Box(-FEATURE_BOUND, FEATURE_BOUND, (MAPS * SITE_COUNT + NUMBERS,), dtype=np.float32)
CHOICE_SPACE = gym.spaces.Discrete(SITE_COUNT)
PLACE_SPACE = gym.spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)
# Area of a face that is read as 1 [tip radii squared].
AREA_SCALE = 100.0


def belief_features(observations: NDArray[np.floating]) -> NDArray[np.float32]:
    """What a policy reads of observations of SurgSim/PalpateSites-v0 with memory, (m, n_observation).

    Maps of the expected excess and its deviation over the prior's, as the searches gp_* of agents/site_search.py have
    them, of the sites that were pressed and of those that may be chosen; the share of presses left and the area of the
    sites that may be chosen over AREA_SCALE: (m, 4 n n + 2). They follow from the observation alone, on any organ.
    """
    return np.stack([_features(observation) for observation in np.asarray(observations, dtype=np.float64)])


def _features(observation: NDArray[np.float64]) -> NDArray[np.float32]:
    process = SiteProcess(observed_facts(observation))
    belief = process.belief(observation)
    maps = np.clip(np.concatenate([belief.excess, belief.spread]) / EXCESS_SPREAD, -FEATURE_BOUND, FEATURE_BOUND)
    area = process.candidates.sum() * process.facts.map.cell**2 / AREA_SCALE
    numbers = [observation[SLICES["presses_left"]], [min(area, FEATURE_BOUND)]]
    return np.concatenate([maps, observation[SLICES["pressed_map"]], process.candidates, *numbers]).astype(np.float32)


def site_actions(observations: NDArray[np.floating], sites: NDArray[np.integer]) -> NDArray[np.float32]:
    """The environments' actions (m, 2) that press sites (m,) of the maps of their observations (m, n_observation)."""
    facts = [observed_facts(observation) for observation in observations]
    return np.stack([one.action(one.sites[site]) for one, site in zip(facts, sites, strict=True)])


class SiteScores(nn.Module):
    """Scores of all sites, and features for the value.

    Channels are the maps and numbers of `belief_features`. Only candidates that were not pressed are chosen, as by the
    searches gp_* of agents/site_search.py.
    """

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(MAPS + NUMBERS, WIDTH, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(WIDTH, WIDTH, 3, padding=2, dilation=2),
            nn.ReLU(),
            nn.Conv2d(WIDTH, WIDTH, 3, padding=4, dilation=4),
            nn.ReLU(),
            nn.Conv2d(WIDTH, WIDTH, 1),
            nn.ReLU(),
        )
        self.score = nn.Conv2d(WIDTH, 1, 1)
        nn.init.zeros_(self.score.weight)
        assert self.score.bias is not None
        nn.init.zeros_(self.score.bias)
        self.latent_dim_pi = SITE_COUNT
        self.latent_dim_vf = VALUE_SIZE

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Scores (m, n n) and features for the value (m, latent_dim_vf) of features (m, 4 n n + 2)."""
        count, n = len(features), MAP_SIDE
        maps, numbers = features[:, :-NUMBERS].reshape(count, MAPS, n, n), features[:, -NUMBERS:]
        seen = self.body(torch.cat([maps, numbers[:, :, None, None].expand(count, NUMBERS, n, n)], dim=1))
        bound = SHARPNESS * (maps[:, 0] + CURIOSITY * maps[:, 1])
        face = maps[:, 3] > 0.5
        # Where all candidates were pressed, one of them again.
        fresh = face & (maps[:, 2] < 0.5)
        is_open = torch.where(fresh.any(dim=2, keepdim=True).any(dim=1, keepdim=True), fresh, face)
        scores = (self.score(seen)[:, 0] + bound).masked_fill(~is_open, CLOSED_SCORE).flatten(1)
        inside = seen * face[:, None]
        mean = inside.sum(dim=(2, 3)) / face.sum(dim=(1, 2))[:, None].clamp(min=1)
        return scores, torch.cat([mean, inside.amax(dim=(2, 3)), numbers], dim=1)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """The scores only."""
        return self.forward(features)[0]

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """The features for the value only."""
        return self.forward(features)[1]


class SitePolicy(ActorCriticPolicy):
    """A policy of stable-baselines3 on `SiteBelief` features: the scores are the logits of the sites."""

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = SiteScores()  # type: ignore[assignment]

    def _build(self, lr_schedule: Callable[[float], float]) -> None:
        self._build_mlp_extractor()
        self.action_net = nn.Identity()
        self.value_net = nn.Sequential(nn.Linear(VALUE_SIZE, 64), nn.Tanh(), nn.Linear(64, 1))  # type: ignore[assignment]
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)
