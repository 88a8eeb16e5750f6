"""Two methods that say where lesions are without feeling for them: what the scores are at best, and by guessing.

Both press the middle of the chart, as the environment asks for presses; what they say is scored in place of the
estimator's word.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.site_agent import SiteFacts
from surgsim_env.evaluation.palpation import MapScore


class Truth:
    """Sees the truth and says it: every place, map and outline must score 100 %."""

    def reset(self, rng: np.random.Generator, facts: SiteFacts) -> None:
        """Begin an episode."""

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """The middle of the chart."""
        return np.zeros(2, dtype=np.float32)

    def say(self, task: Any) -> NDArray[np.float64]:
        """Places of the lesions on the surface [m], shape (k, 3)."""
        return task.truth

    def draw(self, made: MapScore) -> MapScore:
        """Its map: 1 over lesions, else 0, and the true outline."""
        return replace(made, excess=made.lesion.astype(np.float64), outline=made.outline_true)


class Middle(Truth):
    """Says that there is one lesion, in the middle of the chart, whatever was felt."""

    def say(self, task: Any) -> NDArray[np.float64]:
        """The middle of the chart on the surface [m], shape (1, 3)."""
        return task.charted.surface(np.zeros((1, 2)))

    def draw(self, made: MapScore) -> MapScore:
        """A map on which all places are alike, without an outline."""
        return replace(made, excess=np.zeros_like(made.excess), outline=np.zeros_like(made.outline))
