"""Variance reduction for SurgSim/PalpateSites-v0: press where the Gaussian process knows least.

What was felt plays no part, so that its presses fill the chart evenly: a raster that can be stopped at any time.
"""

import numpy as np
from numpy.typing import NDArray

from agents.site_agent import SiteFacts
from agents.site_process import SiteProcess


class GpVariance:
    """Presses the site of the largest standard deviation."""

    def reset(self, rng: np.random.Generator, facts: SiteFacts) -> None:
        """Begin an episode."""
        self.rng, self.process = rng, SiteProcess(facts)

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """Where to press next."""
        return self.process.best(self.process.belief(observation).spread, observation, self.rng)
