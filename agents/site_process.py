"""A Gaussian process on the sites of a chart, by scikit-learn: what the agents gp_*.py expect and how unsure they are.

Kernel and numbers are those of the benchmark's own estimator, log contrast = background + excess + noise, but that a
press tells of fewer neighbours (LENGTH_SHARE).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from agents.site_agent import SiteFacts
from surgsim_env.palpation.lesion_estimator import (
    BACKGROUND_SPREAD,
    EXCESS_LENGTH,
    EXCESS_SPREAD,
    MODEL_SPREAD,
    REFERENCE_TIP_RADIUS,
)

# Sites nearer to the chart's border than this share of its side are not pressed: half of what a press there would tell
# lies where no lesion can be.
BORDER = 0.07
# Share of the estimator's correlation length: with the whole of it, weak lesions between two presses are overlooked.
LENGTH_SHARE = 0.8
# On a chart of so few correlation lengths the first four presses are a raster of 2 x 2, at these shares of its sides:
# together they say what is background and leave no quarter unfelt, where a process that knows nothing takes any place.
FIRST_SHARES = ((0.25, 0.25), (0.75, 0.75), (0.75, 0.25), (0.25, 0.75))
FIRST_LENGTHS = 6.0


@dataclass(frozen=True, eq=False)
class Belief:
    """At the candidate sites: what lesions are expected to add to the log contrast, and its standard deviation (n,)."""

    excess: NDArray[np.float64]
    spread: NDArray[np.float64]


class SiteProcess:
    """The process of one chart and the sites that an agent chooses among."""

    def __init__(self, facts: SiteFacts) -> None:
        self.facts = facts
        self.candidates = np.flatnonzero(_off_border(facts))
        self.places = facts.sites[self.candidates]
        self.length = LENGTH_SHARE * EXCESS_LENGTH * facts.tip_radius / REFERENCE_TIP_RADIUS
        self._excess = ConstantKernel(EXCESS_SPREAD**2) * RBF(self.length)
        self._kernel = ConstantKernel(BACKGROUND_SPREAD**2) + self._excess

    def belief(self, observation: NDArray[np.floating]) -> Belief:
        """The excess given all presses that an observation remembers.

        The process predicts the sum of background and excess. Of the excess alone mean and variance follow from the
        fitted process by its own covariance with the presses: Rasmussen & Williams 2006, eq. 2.25 and 2.26. How unsure
        the background is should draw no press: it is the same everywhere.
        """
        pressed, values = self.facts.remembered(observation)
        if not pressed.size:
            return Belief(np.zeros(len(self.places)), np.full(len(self.places), EXCESS_SPREAD))
        noise = self.facts.noise**2 + MODEL_SPREAD**2
        process = GaussianProcessRegressor(self._kernel, alpha=noise, optimizer=None)
        process.fit(self.facts.sites[pressed], values)
        covariance = self._excess(self.places, process.X_train_)
        explained = solve_triangular(process.L_, covariance.T, lower=True)
        variance = EXCESS_SPREAD**2 - (explained**2).sum(axis=0)
        return Belief(covariance @ process.alpha_, np.sqrt(np.maximum(variance, 0.0)))

    def best(
        self, worth: NDArray[np.float64], observation: NDArray[np.floating], rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """The action for the candidate of most worth that was not pressed yet; equals are drawn among."""
        pressed, _ = self.facts.remembered(observation)
        worth = np.where(np.isin(self.candidates, pressed), -np.inf, worth)
        return self.facts.action(self.places[rng.choice(np.flatnonzero(worth >= worth.max() - 1e-9))])

    def first(self, number: int) -> NDArray[np.float32] | None:
        """The action of the press of this number (from 0) where it is one of the first, on the site nearest to it."""
        if number >= len(FIRST_SHARES) or max(self.facts.extent) > FIRST_LENGTHS * self.length:
            return None
        wanted = np.array(FIRST_SHARES[number]) * self.facts.extent
        return self.facts.action(self.places[np.argmin(((self.places - wanted) ** 2).sum(axis=1))])


@lru_cache(maxsize=8)
def _off_border(facts: SiteFacts) -> NDArray[np.bool_]:
    extent = np.array(facts.extent)
    from_border = np.minimum(facts.sites, extent - facts.sites) / extent
    return from_border.min(axis=1) >= BORDER
