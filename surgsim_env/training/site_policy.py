"""A policy for SurgSim/PalpateSites-v0 on any organ: a learned acquisition function that scores each site of its map.

Bayesian optimisation presses where an acquisition function of mean and standard deviation is largest; here that
function, the same at every site of every organ, is learned (after Volpp et al. 2020, "Meta-learning acquisition
functions for transfer learning in Bayesian optimization"): `Acquisition`, a formula with 13 numbers that an evolution
strategy finds (`agents/learn_sites.py`), and beside it a small convolutional network, initially 0, for reinforcement
learning.
"""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from surgsim_env.palpation.chart import MAP_SIDE
from surgsim_env.palpation.lesion_estimator import EXCESS_SPREAD
from surgsim_env.training.site_agent import SITE_COUNT, SLICES, SiteProcess, observed_facts

# Bound of a feature; expected excess is some 3 spreads at most.
FEATURE_BOUND = 10.0
# Logit of a site over its score.
SHARPNESS = 6.0
WIDTH = 16
# Score of an excluded site: probability 0, but finite, as the entropy requires.
CLOSED_SCORE = -1e4


# Spaces of a policy that reads belief maps and chooses a site; MAPS maps and NUMBERS numbers.
MAPS, NUMBERS = 4, 5
FEATURE_SPACE = gym.spaces.Box(-FEATURE_BOUND, FEATURE_BOUND, (MAPS * SITE_COUNT + NUMBERS,), dtype=np.float32)
CHOICE_SPACE = gym.spaces.Discrete(SITE_COUNT)
PLACE_SPACE = gym.spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)
# Area of a face that is read as 1 [tip radii squared].
AREA_SCALE = 100.0
# Features of the value: of each channel the mean and the largest value over the face, and the numbers.
VALUE_SIZE = 2 * WIDTH + NUMBERS


def belief_features(observations: NDArray[np.floating]) -> NDArray[np.float32]:
    """What a policy reads of observations of SurgSim/PalpateSites-v0 with memory, (m, n_observation).

    Maps of the expected excess and its deviation over the prior's, as the searches gp_* of
    surgsim_env/scoring/site_search.py have them, of the sites that were pressed and of those that may be chosen; then
    the share of presses left, the area of the sites that may be chosen over AREA_SCALE, the map's cell and the lesions'
    radius over the tip's, and the least excess of a lesion over the prior's deviation: (m, 4 n n + 5). They follow from
    the observation alone, on any organ.
    """
    return np.stack([_features(observation) for observation in np.asarray(observations, dtype=np.float64)])


def _features(observation: NDArray[np.float64]) -> NDArray[np.float32]:
    process = SiteProcess(observed_facts(observation))
    belief = process.belief(observation)
    return stacked_features(
        process, belief.excess, belief.spread, observation[SLICES["pressed_map"]], observation[SLICES["presses_left"]]
    )


def stacked_features(
    process: SiteProcess,
    excess: NDArray[np.float64],
    spread: NDArray[np.float64],
    pressed: NDArray[Any],
    presses_left: Any,
) -> NDArray[np.float32]:
    """The features of a belief: excess, its deviation and pressed sites (n n,), and the share of presses left."""
    facts = process.facts
    area = process.candidates.sum() * facts.map.cell**2 / AREA_SCALE
    numbers = [area, facts.map.cell, facts.lesion_radius, facts.excess_least / EXCESS_SPREAD]
    maps = np.concatenate([excess, spread]) / EXCESS_SPREAD
    values = np.concatenate([maps, pressed, process.candidates, np.ravel(presses_left), numbers])
    return np.clip(values, -FEATURE_BOUND, FEATURE_BOUND).astype(np.float32)


def site_actions(observations: NDArray[np.floating], sites: NDArray[np.integer]) -> NDArray[np.float32]:
    """The environments' actions (m, 2) that press sites (m,) of the maps of their observations (m, n_observation)."""
    facts = [observed_facts(observation) for observation in observations]
    return np.stack([one.action(one.sites[site]) for one, site in zip(facts, sites, strict=True)])


class Acquisition(nn.Module):
    """The acquisition function: what a press at each site is worth.

    With the expected excess m and its deviation s over the prior's, and the least excess of a lesion m_0,

        a(x) = m + w_s s + w_g (G_r * (p u))(x) + h (w_h + w_hs s + w_hm m)
        u = max(0, (s - t) / (1 - t))^q                     what presses have not yet told, at each site
        p = sigmoid(((G_R * c)(x) - f) / d)                 whether the face around a site is wide enough for a lesion
        h = sigmoid((m / m_0 - k) / v)                      whether a lesion was felt there

    * is convolution, G_r a Gaussian of standard deviation r (in radii of the lesions) and integral 1, c 1 at sites that
    may be chosen and 0 elsewhere. The second term makes it an upper confidence bound, the third prefers sites from
    which much unexplored tissue is felt, the last says what to do around a lesion that was found.

    Parameters, in the order of `values` (13,): w_s, w_g, w_h, w_hs, w_hm, t, q, r, R, f, d, k, v.
    """

    # An upper confidence bound with the weight of `gp_ucb`.
    INITIAL = (3.0, 0.0, 0.0, 0.0, 0.0, 0.3, 1.0, 1.0, 1.1, 0.4, 0.1, 1.2, 0.6)
    # Least values of t to v, which are no weights.
    LEAST = (-1.0, 0.2, 0.15, 0.15, -1.0, 0.02, -5.0, 0.02)

    def __init__(self) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.tensor(self.INITIAL))

    def forward(self, maps: torch.Tensor, numbers: torch.Tensor) -> torch.Tensor:
        """The worth of all sites (m, n, n), from maps (m, 4, n, n) and numbers (m, 5)."""
        bound, gain, hot, hot_spread, hot_excess = self.values[:5]
        least = torch.tensor(self.LEAST)
        told, power, reach, room, share, softness, onset, width = torch.maximum(self.values[5:], least)
        excess, spread, candidates = maps[:, 0], maps[:, 1], maps[:, 3]
        cell, radius, excess_least = (numbers[:, index, None, None] for index in (2, 3, 4))
        fits = candidates * torch.sigmoid((_blurred(candidates, cell, room * radius) - share) / softness)
        unknown = ((spread - told) / (1.0 - told)).clamp(min=1e-6) ** power
        found = torch.sigmoid((excess / excess_least - onset) / width)
        return (
            excess
            + bound * spread
            + gain * _blurred(fits * unknown, cell, reach * radius)
            + found * (hot + hot_spread * spread + hot_excess * excess)
        )


def _blurred(values: torch.Tensor, cell: torch.Tensor, spread: torch.Tensor) -> torch.Tensor:
    """Maps (m, n, n) convolved with Gaussians of a standard deviation and a cell (m, 1, 1), 0 beyond the map."""
    steps = torch.arange(MAP_SIDE, dtype=values.dtype)
    kernel = torch.exp(-0.5 * ((steps[:, None] - steps) * (cell / spread)) ** 2) * (
        cell / spread / (2.0 * torch.pi) ** 0.5
    )
    return kernel @ values @ kernel


class SiteScores(nn.Module):
    """Scores of all sites, and features for the value.

    Channels are the maps and numbers of `belief_features`. Only candidates that were not pressed are chosen, as by the
    searches gp_* of surgsim_env/scoring/site_search.py.
    """

    def __init__(self) -> None:
        super().__init__()
        self.acquisition = Acquisition()
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
        """Scores (m, n n) and features for the value (m, latent_dim_vf) of features (m, 4 n n + 5)."""
        count, n = len(features), MAP_SIDE
        maps, numbers = features[:, :-NUMBERS].reshape(count, MAPS, n, n), features[:, -NUMBERS:]
        seen = self.body(torch.cat([maps, numbers[:, :, None, None].expand(count, NUMBERS, n, n)], dim=1))
        worth = SHARPNESS * self.acquisition(maps, numbers)
        scores = (self.score(seen)[:, 0] + worth).masked_fill(~open_sites(maps), CLOSED_SCORE).flatten(1)
        face = maps[:, 3] > 0.5
        inside = seen * face[:, None]
        mean = inside.sum(dim=(2, 3)) / face.sum(dim=(1, 2))[:, None].clamp(min=1)
        return scores, torch.cat([mean, inside.amax(dim=(2, 3)), numbers], dim=1)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """The scores only."""
        return self.forward(features)[0]

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """The features for the value only."""
        return self.forward(features)[1]


def open_sites(maps: torch.Tensor) -> torch.Tensor:
    """Which sites may be pressed next (m, n, n), from maps (m, 4, n, n).

    Candidates that were not pressed; where all were pressed, one of them again.
    """
    face = maps[:, 3] > 0.5
    fresh = face & (maps[:, 2] < 0.5)
    return torch.where(fresh.any(dim=2, keepdim=True).any(dim=1, keepdim=True), fresh, face)


class SitePolicy(ActorCriticPolicy):
    """A policy of stable-baselines3 on the maps of `belief_features`: the scores are the logits of the sites."""

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = SiteScores()  # type: ignore[assignment]

    def _build(self, lr_schedule: Callable[[float], float]) -> None:
        self._build_mlp_extractor()
        self.action_net = nn.Identity()
        self.value_net = nn.Sequential(nn.Linear(VALUE_SIZE, 64), nn.Tanh(), nn.Linear(64, 1))  # type: ignore[assignment]
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)
