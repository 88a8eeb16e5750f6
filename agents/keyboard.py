"""A person at the keyboard: the keys held down in the window give the action.

    python -m agents.record_demonstrations SurgSim/Retract-v0 --env-arguments '{"render_mode": "human"}' \
        --by keyboard --episodes 5 --dataset surgsim/retract/human-v0

    A D left, right    S W near, far    F R down, up    Q E turn the wrist
    space: close the jaw, or "the lesion is here"

One control step is 50 ms of simulated time; on a machine that takes longer, the episode runs in slow motion.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

# Axis and direction of each key; the fourth is the wrist's first hinge.
DIRECTIONS: Mapping[str, tuple[int, float]] = {
    **{"A": (0, -1.0), "D": (0, 1.0), "S": (1, -1.0), "W": (1, 1.0), "F": (2, -1.0), "R": (2, 1.0)},
    **{"Q": (3, -1.0), "E": (3, 1.0)},
}
# Share of full speed, which is 20 mm/s.
SHARE = 0.5


class Keyboard:
    """Plays an environment of one arm with the keys of its window (an `EpisodeActor`)."""

    def __init__(self, env: gym.Env) -> None:
        """Take an environment with render_mode="human".

        Raises:
            ValueError: an environment without a window, or whose actions are not those of one tip.
        """
        if env.render_mode != "human":
            raise ValueError(f'render_mode is {env.render_mode!r}; a person needs the window of render_mode="human"')
        size = env.action_space.shape[0] if isinstance(env.action_space, gym.spaces.Box) else 0
        if not 4 <= size <= 8:
            raise ValueError(f"actions are {env.action_space}: the keys move one tip, turn it and close one jaw")
        self._env, self._size = env.unwrapped, size
        self._jaw = hasattr(self._env.task, "jaw_place")  # type: ignore[attr-defined]

    def begin(self, index: int, env: Any, rng: np.random.Generator) -> None:
        """Begin an episode; there is no state."""

    def end(self, index: int) -> None:
        """The episode is over; there is no state."""

    def __call__(self, observations: Any, begins: NDArray[np.bool_]) -> NDArray[np.float32]:
        """The action of the keys held down, shape (1, n_action).

        Raises:
            KeyboardInterrupt: the window was closed.
        """
        window = self._env.window  # type: ignore[attr-defined]
        if window is None or window.closed:
            raise KeyboardInterrupt("the window was closed")
        return self.action(window.held_keys())[None]

    def action(self, held: str) -> NDArray[np.float32]:
        """The action of some keys, shape (n_action,)."""
        action = np.zeros(self._size, dtype=np.float32)
        for key, (axis, direction) in DIRECTIONS.items():
            if key in held and axis < self._size - 1:
                action[axis] += SHARE * direction
        action[-1] = (-1.0 if " " in held else 1.0) if self._jaw else float(" " in held)
        return action
