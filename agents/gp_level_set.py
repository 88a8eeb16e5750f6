"""Level-set search for SurgSim/PalpateSites-v0: press where it is most uncertain whether there is a lesion.

Implicit level sets by upper confidence bounds, ILS-UCB (Garg et al. 2016, "Tumor localization using automated palpation
with Gaussian process adaptive sampling"; Gotovos et al. 2013): the level h is a share of the largest expected excess,
and the site of the largest ambiguity min(upper bound - h, h - lower bound) is pressed: the outlines of lesions and
unexplored regions.
"""

import numpy as np
from numpy.typing import NDArray

from agents.scoring.site_agent import SiteFacts, SiteProcess
from surgsim_env.palpation.lesion_estimator import EXCESS_LEAST, EXCESS_LEAST_NOISE

BETA = 2.0
LEVEL_SHARE = 0.55


class GpLevelSet:
    """Presses the site of the largest ambiguity."""

    def reset(self, rng: np.random.Generator, facts: SiteFacts) -> None:
        """Begin an episode."""
        self.rng, self.process, self.count = rng, SiteProcess(facts), 0
        # The least excess that the estimator reports as a lesion.
        self.least = EXCESS_LEAST + EXCESS_LEAST_NOISE * facts.noise

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """Where to press next."""
        first = self.process.first(self.count)
        self.count += 1
        if first is not None:
            return first
        belief = self.process.belief(observation)
        excess, margin = belief.excess, BETA * belief.spread
        level = max(self.least, LEVEL_SHARE * float(excess[self.process.candidates].max()))
        ambiguity = np.minimum(excess + margin - level, level - excess + margin)
        return self.process.best(ambiguity, observation, self.rng)
