"""Sobol presses for SurgSim/PalpateSites-v0: a scrambled low-discrepancy sequence (Sobol 1967, Owen 1998).

It covers the chart more evenly than chance does and, unlike a raster, after any number of presses.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from agents.scoring.site_agent import SiteFacts


class SobolSites:
    """Presses the places of a sequence with a new scrambling in each episode."""

    def reset(self, rng: np.random.Generator, facts: SiteFacts) -> None:
        """Begin an episode."""
        powers = int(np.ceil(np.log2(facts.budget)))
        self.places = iter(qmc.Sobol(2, scramble=True, rng=rng).random_base2(powers))

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """Where to press next."""
        return (2.0 * next(self.places) - 1.0).astype(np.float32)
