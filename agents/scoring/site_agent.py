"""Agents for SurgSim/PalpateSites-v0: their interface, what they may know, and the belief that presses give them."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from surgsim_env.palpation.lesion_estimator import contrast_process
from surgsim_env.tasks.palpate_sites import PalpateSitesTask

# Sites nearer to the chart's border than this share of its side are not pressed: half of the area that a press there
# informs about can hold no lesion.
BORDER = 0.07
# Share of the estimator's correlation length: with the whole of it, weak lesions between two presses are overlooked.
LENGTH_SHARE = 0.8
# On a chart of at most FIRST_LENGTHS correlation lengths the first four presses are a raster of 2 x 2, at these shares
# of its sides: they estimate the background and leave no quarter unpressed, where a process without data takes any
# place.
FIRST_SHARES = ((0.25, 0.25), (0.75, 0.75), (0.75, 0.25), (0.25, 0.75))
FIRST_LENGTHS = 6.0


@dataclass(frozen=True)
class SiteFacts:
    """Constants of an environment.

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
    budget: int = 25

    @cached_property
    def axes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Coordinates of the grid's columns and rows on the chart [m], (n,) each."""
        first, second = (np.linspace(0.0, extent, self.site_count) for extent in self.extent)
        return first, second

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Entries of the observation with memory, by channel."""
        count = self.site_count**2
        return PalpateSitesTask.channel_slices(contrast_map=count, pressed_map=count)

    @cached_property
    def sites(self) -> NDArray[np.float64]:
        """Places of the grid's sites on the chart [m], row by row along the first axis, shape (n n, 2)."""
        return np.stack(np.meshgrid(*self.axes), axis=-1).reshape(-1, 2)

    def action(self, place: NDArray[np.float64]) -> NDArray[np.float32]:
        """The action that presses at a place of the chart [m], shape (2,)."""
        return (2.0 * np.asarray(place) / self.extent - 1.0).astype(np.float32)

    def remembered(self, observation: NDArray[np.floating]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Numbers of the pressed sites, and the log contrast at each."""
        pressed = np.flatnonzero(observation[self.slices["pressed_map"]] > 0.5)
        return pressed, np.asarray(observation[self.slices["contrast_map"]], dtype=np.float64)[pressed]


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


@dataclass(frozen=True, eq=False)
class Belief:
    """Expected excess of the log contrast at the sites of a chart's grid, and its standard deviation, (n n,) each."""

    excess: NDArray[np.float64]
    spread: NDArray[np.float64]


class SiteProcess:
    """The estimator's Gaussian process on the sites of a chart's grid, with LENGTH_SHARE of its correlation length.

    `candidates` says which sites an agent chooses among: those off the border, shape (n n,).
    """

    def __init__(self, facts: SiteFacts) -> None:
        self.facts = facts
        self.process = contrast_process(
            facts.axes, tip_radius=facts.tip_radius, noise=facts.noise, length_share=LENGTH_SHARE
        )
        from_border = np.minimum(facts.sites, facts.extent - facts.sites) / facts.extent
        self.candidates = from_border.min(axis=1) >= BORDER

    def belief(self, observation: NDArray[np.floating]) -> Belief:
        """The belief given all presses that an observation remembers.

        It is about the excess alone: uncertainty of the background, the same at all sites, should attract no press.
        """
        pressed, values = self.facts.remembered(observation)
        places = self.facts.sites[pressed]
        return Belief(self.process.mean(places, values)[1].ravel(), self.process.spread(places).ravel())

    def best(
        self, worth: NDArray[np.float64], observation: NDArray[np.floating], rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """The action for the candidate of most worth (n n,) that was not pressed yet; ties are broken at random."""
        pressed, _ = self.facts.remembered(observation)
        worth = np.where(self.candidates, worth, -np.inf)
        worth[pressed] = -np.inf
        return self.facts.action(self.facts.sites[rng.choice(np.flatnonzero(worth >= worth.max() - 1e-9))])

    def first(self, number: int) -> NDArray[np.float32] | None:
        """The action of press `number` (from 0) if the first raster has it, on the candidate nearest to its place."""
        if number >= len(FIRST_SHARES) or max(self.facts.extent) > FIRST_LENGTHS * self.process.length:
            return None
        squared = ((self.facts.sites - np.array(FIRST_SHARES[number]) * self.facts.extent) ** 2).sum(axis=1)
        return self.facts.action(self.facts.sites[np.argmin(np.where(self.candidates, squared, np.inf))])
