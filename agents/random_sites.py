"""Random presses for SurgSim/PalpateSites-v0: uniformly distributed over the chart."""

import numpy as np
from numpy.typing import NDArray

from agents.scoring.site_agent import SiteFacts


class RandomSites:
    """Presses uniformly distributed places."""

    def reset(self, rng: np.random.Generator, facts: SiteFacts) -> None:
        """Begin an episode."""
        self.rng = rng

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """Where to press next."""
        return self.rng.uniform(-1.0, 1.0, 2).astype(np.float32)
