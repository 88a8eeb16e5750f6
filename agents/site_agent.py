"""What an agent for SurgSim/PalpateSites-v0 is, and what it may know: observations and the size of the chart."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class SiteFacts:
    """What does not change from episode to episode.

    Fields:
        extent: of the chart [m]
        site_count: sites of its grid along each axis
        tip_radius: of the ball that presses [m]
        noise: standard deviation of one log contrast by the force sensor
        budget: presses of an episode
    """

    extent: tuple[float, float]
    site_count: int
    tip_radius: float
    noise: float
    budget: int

    @property
    def sites(self) -> NDArray[np.float64]:
        """Places of the grid's sites on the chart [m], row by row along the first axis, shape (n n, 2)."""
        axes = [np.linspace(0.0, extent, self.site_count) for extent in self.extent]
        return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)

    def action(self, place: NDArray[np.float64]) -> NDArray[np.float32]:
        """The action that presses at a place of the chart [m], shape (2,)."""
        return (2.0 * np.asarray(place) / self.extent - 1.0).astype(np.float32)

    def remembered(self, observation: NDArray[np.floating]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Numbers of the sites that were pressed, and the log contrast felt at each."""
        count = self.site_count**2
        pressed = np.flatnonzero(observation[count : 2 * count] > 0.5)
        return pressed, np.asarray(observation, dtype=np.float64)[pressed]


class SiteAgent(Protocol):
    """Chooses where to press next; one agent plays one environment."""

    def reset(self, rng: np.random.Generator, facts: SiteFacts) -> None:
        """Begin an episode."""
        ...

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """Where to press next: an action, shape (2,)."""
        ...


def site_facts(env: Any) -> SiteFacts:
    """The facts of an environment (its wrappers do not matter)."""
    task = env.unwrapped.task
    return SiteFacts(
        extent=tuple(task.estimator.extent.tolist()),
        site_count=task.site_count,
        tip_radius=task.estimator.tip_radius,
        noise=task.estimator.noise,
        budget=task.budget,
    )
