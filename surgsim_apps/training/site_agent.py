"""Agents for SurgSim/PalpateSites-v0: their interface, the facts of an episode, and their belief after presses."""

import copy
import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import matmul
from surgsim_env.palpation import BACKGROUND_SPREAD, EXCESS_SPREAD, MAP_SIDE, TouchMap, contrast_process
from surgsim_env.tasks import PalpateSitesTask, channel_slices

# Least distance of a press from the chart's border, over its side: nearer ones inform about much area without lesions.
BORDER = 0.07
# Share of the estimator's correlation length: with the whole of it, weak lesions between two presses are overlooked.
LENGTH_SHARE = 0.8
# On a chart of at most FIRST_LENGTHS correlation lengths the first four presses are a raster of 2 x 2, at these shares
# of its sides: they estimate the background and leave no quarter unpressed; a process without data takes any place.
FIRST_SHARES = ((0.25, 0.25), (0.75, 0.75), (0.75, 0.25), (0.25, 0.75))
FIRST_LENGTHS = 6.0


SITE_COUNT = MAP_SIDE * MAP_SIDE
# Entries of the observation with memory, by channel.
SLICES = channel_slices(
    PalpateSitesTask,
    **dict.fromkeys(("contrast_map", "pressed_map", "face_map"), SITE_COUNT),
    map_cell=1,
    chart_share=2,
    contrast_noise=1,
    excess_least=1,
    lesion_radius=1,
    gradient_map=2 * SITE_COUNT,
    gradient_noise=1,
)
FACTS = ("map_cell", "chart_share", "contrast_noise", "excess_least", "lesion_radius")
# Without taxels.
OBSERVATION_SIZE = SLICES["presses_left"].stop


@dataclass(frozen=True, eq=False)
class SiteFacts:
    """Constants of an episode, all in the observation: the palpable face, the tip and the sensor.

    Fields:
        map: the sites of the touch map; lengths in metres, or in tip radii with a tip_radius of 1
        tip_radius: of the pressing ball [m]
        lesion_radius: mean radius of the lesions [m]
        noise: standard deviation of one log contrast by the force sensor
        excess_least: the estimator's least excess of the log contrast of a lesion
        budget: presses of an episode
        gradient_noise: standard deviation of one gradient of the log contrast by taxels and map [1/m]; 0 without
    """

    map: TouchMap
    tip_radius: float
    lesion_radius: float
    noise: float
    excess_least: float
    budget: int = 25
    gradient_noise: float = 0.0

    @property
    def extent(self) -> NDArray[np.float64]:
        """Lengths of the chart's sides [m] (2,)."""
        return self.map.extent

    @property
    def sites(self) -> NDArray[np.float64]:
        """The map's sites, lengths along the chart's sides [m], row by row along the first axis, shape (n n, 2)."""
        return self.map.sites

    def action(self, place: NDArray[np.float64]) -> NDArray[np.float32]:
        """The action for a press at a place of the chart [m], shape (2,)."""
        return np.clip(2.0 * np.asarray(place) / self.extent - 1.0, -1.0, 1.0).astype(np.float32)


def remembered(observation: NDArray[np.floating]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Numbers of the pressed sites of an observation with memory, and the log contrast at each."""
    pressed = np.flatnonzero(observation[SLICES["pressed_map"]] > 0.5)
    return pressed, np.asarray(observation[SLICES["contrast_map"]], dtype=np.float64)[pressed]


def observed_facts(observation: NDArray[np.floating]) -> SiteFacts:
    """Facts in an observation with memory, lengths in tip radii."""
    cell, share, noise, least, radius = (np.asarray(observation[SLICES[name]], dtype=np.float64) for name in FACTS)
    face = np.asarray(observation[SLICES["face_map"]]) > 0.5
    observed_map = TouchMap(share * cell * (MAP_SIDE - 1), float(cell[0]), face)
    blur = float(observation[SLICES["gradient_noise"]][0]) if len(observation) > OBSERVATION_SIZE else 0.0
    return SiteFacts(observed_map, 1.0, float(radius[0]), float(noise[0]), float(least[0]), gradient_noise=blur)


class SiteAgent(Protocol):
    """An agent for the choice of presses in one environment."""

    def reset(self, rng: np.random.Generator, facts: SiteFacts) -> None:
        """Begin an episode."""
        ...

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """The next press: an action, shape (2,)."""
        ...


def site_facts(env: Any) -> SiteFacts:
    """Facts of an environment, without its wrappers; the map is a copy, as all environments share theirs."""
    task = env.unwrapped.task
    charted, estimator = task.charted, task.estimator
    return SiteFacts(
        copy.deepcopy(charted.touch_map),
        charted.tip_radius,
        estimator.lesion_radius,
        estimator.noise,
        estimator.excess_least,
        task.budget,
        estimator.gradient_noise,
    )


@dataclass(frozen=True, eq=False)
class Belief:
    """Expected excess of the log contrast at the sites of a map, and its standard deviation, (n n,) each."""

    excess: NDArray[np.float64]
    spread: NDArray[np.float64]


class SiteProcess:
    """The estimator's Gaussian process on the sites of a map, with LENGTH_SHARE of its correlation length.

    `candidates` is the mask of an agent's choices: pressable sites off the border, shape (n n,).
    """

    def __init__(self, facts: SiteFacts) -> None:
        self.facts = facts
        self.process = contrast_process(
            facts.map.axes,
            lesion_radius=facts.lesion_radius,
            noise=facts.noise,
            length_share=LENGTH_SHARE,
            gradient_noise=facts.gradient_noise,
        )
        from_border = np.minimum(facts.sites, facts.extent - facts.sites) / facts.extent
        self.candidates = facts.map.pressable & (from_border.min(axis=1) >= BORDER)

    def touches(
        self, observation: NDArray[np.floating]
    ) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64] | None]:
        """Numbers of the pressed sites (n,), the log contrast (n,) and, with taxels, its gradient [1/m] (n, 2)."""
        pressed, values = remembered(observation)
        if not self.facts.gradient_noise:
            return pressed, values, None
        parts = np.asarray(observation[SLICES["gradient_map"]], dtype=np.float64).reshape(2, -1)
        return pressed, values, parts[:, pressed].T / self.facts.tip_radius

    def belief(self, observation: NDArray[np.floating]) -> Belief:
        """The belief given all presses in an observation.

        It is about the excess alone: uncertainty of the background, the same at all sites, should attract no press.
        """
        pressed, values, gradients = self.touches(observation)
        places = self.facts.sites[pressed]
        excess = self.process.mean(places, values, gradients)[1]
        return Belief(excess.ravel(), self.process.spread(places).ravel())

    def best(
        self, worth: NDArray[np.float64], observation: NDArray[np.floating], rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """The action for the fresh candidate of most worth (n n,); ties are broken at random.

        If all were pressed, one of them again.
        """
        pressed, _ = remembered(observation)
        fresh = self.candidates.copy()
        fresh[pressed] = False
        worth = np.where(fresh if fresh.any() else self.candidates, worth, -np.inf)
        return self.facts.action(self.facts.sites[rng.choice(np.flatnonzero(worth >= worth.max() - 1e-9))])

    def first(self, number: int) -> NDArray[np.float32] | None:
        """The action of press `number` (from 0) of the first raster, on the candidate nearest to its place, or None."""
        if number >= len(FIRST_SHARES) or max(self.facts.extent) > FIRST_LENGTHS * self.process.length:
            return None
        squared = np.square(self.facts.sites - np.array(FIRST_SHARES[number]) * self.facts.extent).sum(axis=1)
        return self.facts.action(self.facts.sites[np.argmin(np.where(self.candidates, squared, np.inf))])


class GrowingBelief:
    """`SiteProcess.belief` after presses at sites of the map, one after the other, much faster.

    Each press adds a row of the covariance's Cholesky factor (Rasmussen & Williams 2006, section 2.2), in presses times
    sites operations.
    """

    def __init__(self, process: SiteProcess, press_count: int) -> None:
        """Begin without a press; at most `press_count` follow."""
        sites = process.facts.sites
        self.process, self.count = process.process, 0
        self._sites = sites
        self._excess_rows = np.zeros((press_count, len(sites)))
        self._value_rows = np.zeros((press_count, len(sites)))
        self._whitened = np.zeros(press_count)
        self.belief = Belief(np.zeros(len(sites)), np.full(len(sites), EXCESS_SPREAD))

    def add(self, site: int, value: float) -> None:
        """Add the log contrast of a press at a site of the map."""
        n = self.count
        covariance = self.process.excess_covariance(self._sites, self._sites[[site]])[:, 0]
        row = self._value_rows[:n, site].copy()
        variance = EXCESS_SPREAD * EXCESS_SPREAD + BACKGROUND_SPREAD * BACKGROUND_SPREAD + self.process.noise_variance
        scale = 1.0 / math.sqrt(variance - matmul(row, row))
        self._excess_rows[n] = (covariance - matmul(row, self._excess_rows[:n])) * scale
        self._value_rows[n] = (
            covariance + BACKGROUND_SPREAD * BACKGROUND_SPREAD - matmul(row, self._value_rows[:n])
        ) * scale
        self._whitened[n] = (value - matmul(row, self._whitened[:n])) * scale
        before, added = self.belief, self._excess_rows[n]
        squared = np.maximum(np.square(before.spread) - added * added, 0.0)
        self.belief = Belief(before.excess + added * self._whitened[n], np.sqrt(squared))
        self.count += 1
