"""Raster presses for SurgSim/PalpateSites-v0: the centres of n x n equal fields in boustrophedon order.

Further presses go to the corners of the fields, n + 1 per side, and then through both again.
"""

import numpy as np
from numpy.typing import NDArray

from agents.scoring.site_agent import SiteFacts


class RasterSites:
    """Presses a raster of `side` x `side` places."""

    def __init__(self, side: int) -> None:
        if side < 1:
            raise ValueError(f"side is {side}; a raster has at least 1 place a side")
        middles, corners = (np.arange(side) + 0.5) / side, np.arange(side + 1) / side
        self.actions = 2.0 * np.concatenate([_there_and_back(middles), _there_and_back(corners)]) - 1.0

    def reset(self, rng: np.random.Generator, facts: SiteFacts) -> None:
        """Begin an episode."""
        self.count = 0

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """Where to press next."""
        self.count += 1
        return self.actions[(self.count - 1) % len(self.actions)].astype(np.float32)


def _there_and_back(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """All pairs of an axis' values, each second row in reverse, shape (n n, 2)."""
    rows = [np.column_stack([axis[:: 1 if row % 2 == 0 else -1], np.full(len(axis), y)]) for row, y in enumerate(axis)]
    return np.concatenate(rows)
