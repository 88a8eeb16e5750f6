"""GP-UCB for SurgSim/PalpateSites-v0 (Srinivas et al. 2010): press where tissue may be stiffest.

The argmax over the grid's sites of mean + BETA x standard deviation of the excess, by a Gaussian process on log
contrast.
"""

import numpy as np
from numpy.typing import NDArray

from agents.scoring.site_agent import SiteFacts, SiteProcess

# Chosen on organs that no evaluation uses, as all parameters of these agents (docs/palpation.md).
BETA = 3.0


class GpUcb:
    """Presses the site with the highest upper confidence bound."""

    def reset(self, rng: np.random.Generator, facts: SiteFacts) -> None:
        """Begin an episode."""
        self.rng, self.process, self.count = rng, SiteProcess(facts), 0

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """Where to press next."""
        first = self.process.first(self.count)
        self.count += 1
        if first is not None:
            return first
        belief = self.process.belief(observation)
        return self.process.best(belief.excess + BETA * belief.spread, observation, self.rng)
