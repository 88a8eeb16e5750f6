"""Variance reduction for SurgSim/PalpateSites-v0: press where the variance of the Gaussian process is largest.

The variance does not depend on the measured contrast, so the presses fill the chart evenly: a raster of any length.
"""

import numpy as np
from numpy.typing import NDArray

from agents.scoring.site_agent import SiteFacts, SiteProcess


class GpVariance:
    """Presses the site of the largest standard deviation."""

    def reset(self, rng: np.random.Generator, facts: SiteFacts) -> None:
        """Begin an episode."""
        self.rng, self.process = rng, SiteProcess(facts)

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """Where to press next."""
        return self.process.best(self.process.belief(observation).spread, observation, self.rng)
