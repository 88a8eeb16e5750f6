"""Batches of observations: an array, or a dictionary of arrays for dictionary observations.

The parts of `obs_mode="rgb_force"` have different shapes and types, so no single array holds them. Traces and
recordings combine and select them by these functions.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import concatenate, create_empty_array


def stacked_observations(space: gym.Space, observations: Sequence[Any]) -> Any:
    """Batch of n observations of a space, an array (n, ...) or a dictionary of such arrays; n may be 0."""
    out = create_empty_array(space, len(observations), fn=np.zeros)
    # NumPy stacks no empty sequence.
    return concatenate(space, observations, out) if observations else out


def selected_observations(observations: Any, index: Any) -> Any:
    """Selection by a NumPy `index` from an array (n, ...), or from each array of a dictionary."""
    if isinstance(observations, dict):
        return {name: part[index] for name, part in observations.items()}
    return observations[index]
