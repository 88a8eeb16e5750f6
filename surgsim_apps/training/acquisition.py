"""A learned acquisition function for SurgSim/PalpateSites-v0: the worth of a press at each site of the touch map.

Bayesian optimisation presses at the largest value of an acquisition function of mean and standard deviation; here that
function, the same at every site of every organ, is learned (after Volpp et al. 2020, "Meta-learning acquisition
functions for transfer learning in Bayesian optimization"): a formula with 13 numbers from an evolution strategy
(`agents/learn_sites.py`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from surgsim_apps.training.site_agent import SLICES, Belief, SiteProcess, observed_facts
from surgsim_env.palpation import EXCESS_SPREAD, MAP_SIDE

# Logit of a site over its worth.
SHARPNESS = 6.0
# Least values of t to v (no weights).
LEAST = (-1.0, 0.2, 0.15, 0.15, -1.0, 0.02, -5.0, 0.02)


@dataclass(frozen=True)
class Acquisition:
    """The acquisition function.

    With the expected excess m and its deviation s over the prior's, and the least excess of a lesion m_0,

        a(x) = m + w_s s + w_g (G_r * (p u))(x) + h (w_h + w_hs s + w_hm m)
        u = max(0, (s - t) / (1 - t))^q                     remaining uncertainty of each site
        p = sigmoid(((G_R * c)(x) - f) / d)                 about 1 for a face wide enough around a site, else 0
        h = sigmoid((m / m_0 - k) / v)                      about 1 for a felt lesion, else 0

    * is convolution, G_r a Gaussian of standard deviation r (in radii of the lesions) and integral 1, c 1 at candidate
    sites and 0 elsewhere. The second term makes it an upper confidence bound, the third prefers sites amid much
    unexplored tissue, the last changes the worth around a felt lesion.

    Args:
        values: (13,), w_s, w_g, w_h, w_hs, w_hm, t, q, r, R, f, d, k, v; by default an upper confidence bound with the
            weight of `gp_ucb`.

    Raises:
        ValueError: not 13 finite numbers.
    """

    values: tuple[float, ...] = (3.0, 0.0, 0.0, 0.0, 0.0, 0.3, 1.0, 1.0, 1.1, 0.4, 0.1, 1.2, 0.6)

    def __post_init__(self) -> None:
        if len(self.values) != 13 or not np.isfinite(self.values).all():
            raise ValueError(f"acquisition is {list(self.values)}; the rule is 13 finite numbers")

    def worth(self, process: SiteProcess, belief: Belief) -> torch.Tensor:
        """The worth of a press at each site (n n,), given a belief."""
        facts = process.facts
        values = torch.tensor(self.values)
        bound, gain, hot, hot_spread, hot_excess = values[:5]
        limit, power, reach, room, share, softness, onset, width = torch.maximum(values[5:], torch.tensor(LEAST))
        excess, spread, candidates, cell, radius, least = (
            torch.as_tensor(value, dtype=torch.float32)
            for value in (
                *(belief.excess / EXCESS_SPREAD, belief.spread / EXCESS_SPREAD, process.candidates),
                *(facts.map.cell, facts.lesion_radius, facts.excess_least / EXCESS_SPREAD),
            )
        )
        fits = candidates * torch.sigmoid((_blurred(candidates, cell, room * radius) - share) / softness)
        unknown = ((spread - limit) / (1.0 - limit)).clamp(min=1e-6) ** power
        felt = torch.sigmoid((excess / least - onset) / width)
        around = felt * (hot + hot_spread * spread + hot_excess * excess)
        return excess + bound * spread + gain * _blurred(fits * unknown, cell, reach * radius) + around

    def best(self, process: SiteProcess, belief: Belief, pressed: NDArray[np.bool_]) -> int:
        """The candidate of most worth not pressed (n n,) yet; if all were, one of them again."""
        fresh = process.candidates & ~pressed
        allowed = fresh if fresh.any() else process.candidates
        worth = self.worth(process, belief).masked_fill(~torch.as_tensor(allowed), -torch.inf)
        # Mirror images on a symmetric face differ by rounding: as shares most are equal, and the first of them wins.
        logits = SHARPNESS * worth
        return int(torch.softmax(logits - logits.logsumexp(0), dim=0).argmax())

    def actions(self, observations: NDArray[np.floating], generators: Sequence[Any] = ()) -> NDArray[np.float32]:
        """Actions (m, 2) for observations with memory (m, n_observation); nothing is drawn."""
        return np.stack([self._action(observation) for observation in observations])

    def _action(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        process = SiteProcess(observed_facts(observation))
        site = self.best(process, process.belief(observation), observation[SLICES["pressed_map"]] > 0.5)
        return process.facts.action(process.facts.sites[site])


def _blurred(values: torch.Tensor, cell: torch.Tensor, spread: torch.Tensor) -> torch.Tensor:
    """A map (n n,) of a pitch `cell`, convolved with a Gaussian of a standard deviation; 0 beyond the map."""
    steps = torch.arange(MAP_SIDE, dtype=values.dtype)
    kernel = torch.exp(-0.5 * ((steps[:, None] - steps) * (cell / spread)) ** 2)
    kernel = kernel * (cell / spread / (2.0 * torch.pi) ** 0.5)
    return (kernel @ values.reshape(MAP_SIDE, MAP_SIDE) @ kernel).flatten()
