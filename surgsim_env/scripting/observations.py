"""Several observations in one: an array, or a dictionary of arrays where each observation is a dictionary.

The parts of `obs_mode="rgb_force"` have different shapes and types, so that no single array holds them. Environments
side by side, traces and recordings take them apart and put them together by these functions.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import concatenate, create_empty_array


def stacked_observations(space: gym.Space, observations: Sequence[Any]) -> Any:
    """N observations of a space as an array (n, ...), or as a dictionary of such arrays; n may be 0."""
    out = create_empty_array(space, len(observations), fn=np.zeros)
    # NumPy stacks no empty sequence.
    return concatenate(space, observations, out) if observations else out


def selected_observations(observations: Any, index: Any) -> Any:
    """What NumPy selects by `index` from an array (n, ...), or from each array of a dictionary."""
    if isinstance(observations, dict):
        return {name: part[index] for name, part in observations.items()}
    return observations[index]
