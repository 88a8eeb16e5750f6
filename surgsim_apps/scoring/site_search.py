"""Methods for SurgSim/PalpateSites-v0 by name: site searches, and the reference scores, oracle and blind guess.

Searches use observations and the size of the chart only (`SiteFacts`). Methods with a view of the truth declare it in
`sees_truth`. The belief of the searches `gp_*` is a Gaussian process on log contrast.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, qmc

from msdm_core.arithmetic import cos, matmul, sin
from surgsim_apps.scoring.figures import MapScore
from surgsim_apps.training.site_agent import SiteAgent, SiteFacts, SiteProcess
from surgsim_env.palpation import BACKGROUND_SPREAD, EXCESS_SPREAD
from surgsim_env.tasks import PalpateSitesTask

# Parameters of GP-UCB and of the level-set search, chosen on organs outside all evaluations (docs/palpation.md).
UCB_BETA = 3.0
LEVEL_BETA, LEVEL_SHARE = 2.0, 0.55
# Above so many candidates `GpEvr` takes every second one: its time grows with their square.
EVR_SITES_MOST = 400
# Waves in a sample of the prior by `GpThompson`.
WAVE_COUNT = 256
# The points of the face [m] (k, 3) at places of the chart (k, 2), each in [-1, 1].
Surface = Callable[[NDArray[np.float64]], NDArray[np.float64]]


class RandomSites:
    """Presses at uniformly distributed places of the chart."""

    def reset(self, rng: np.random.Generator, facts: SiteFacts) -> None:
        """Begin an episode."""
        self.rng = rng

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """The next press."""
        return self.rng.uniform(-1.0, 1.0, 2).astype(np.float32)


class RasterSites:
    """Presses the centres of `side` x `side` equal fields in boustrophedon order.

    Further presses go to the corners of the fields, `side` + 1 per side, and then through both again.
    """

    def __init__(self, side: int) -> None:
        middles, corners = (np.arange(side) + 0.5) / side, np.arange(side + 1) / side
        self.actions = 2.0 * np.concatenate([_there_and_back(middles), _there_and_back(corners)]) - 1.0

    def reset(self, rng: np.random.Generator, facts: SiteFacts) -> None:
        """Begin an episode."""
        self.count = 0

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """The next press."""
        self.count += 1
        return self.actions[(self.count - 1) % len(self.actions)].astype(np.float32)


def _there_and_back(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """All pairs of an axis' values, each second row in reverse, shape (n n, 2)."""
    rows = [np.column_stack([axis[:: 1 if row % 2 == 0 else -1], np.full(len(axis), y)]) for row, y in enumerate(axis)]
    return np.concatenate(rows)


class SobolSites:
    """Presses a low-discrepancy sequence (Sobol 1967), scrambled anew in each episode (Owen 1998).

    It covers the chart more evenly than chance does and, unlike a raster, after any number of presses.
    """

    def reset(self, rng: np.random.Generator, facts: SiteFacts) -> None:
        """Begin an episode."""
        powers = (facts.budget - 1).bit_length()
        self.places = iter(qmc.Sobol(2, scramble=True, rng=rng).random_base2(powers))

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """The next press."""
        return (2.0 * next(self.places) - 1.0).astype(np.float32)


class GpVariance:
    """Variance reduction: presses at the largest standard deviation of the Gaussian process.

    The deviation does not depend on the measured contrast: the presses fill the chart evenly, a raster of any length.
    """

    # True if the first presses are a raster (`SiteProcess.first`).
    begins_with_raster: ClassVar[bool] = False

    def reset(self, rng: np.random.Generator, facts: SiteFacts) -> None:
        """Begin an episode."""
        self.rng, self.process, self.count = rng, SiteProcess(facts), 0

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """The next press."""
        first = self.process.first(self.count) if self.begins_with_raster else None
        self.count += 1
        if first is not None:
            return first
        return self.process.best(self.worth(observation), observation, self.rng)

    def worth(self, observation: NDArray[np.floating]) -> NDArray[np.float64]:
        """The acquisition function at each site (n n,)."""
        return self.process.belief(observation).spread


class GpEvr(GpVariance):
    """Expected variance reduction (Cohn 1996; Seo et al. 2000): the press that leaves the least variance on the chart.

    Like the deviation it does not depend on the measured contrast.
    """

    def worth(self, observation: NDArray[np.floating]) -> NDArray[np.float64]:
        """The decrease of the variance, summed over the candidates; 0 elsewhere."""
        sites = np.flatnonzero(self.process.candidates)
        if len(sites) > EVR_SITES_MOST:
            # A checkerboard: rows have an odd number of sites.
            sites = sites[sites % 2 == 0]
        pressed, points = self.process.touches(observation)[0], self.process.facts.sites
        worth = np.zeros(len(points))
        worth[sites] = self.process.process.variance_reduction(points[pressed], points[sites])
        return worth


class GpUcb(GpVariance):
    """GP-UCB (Srinivas et al. 2010): presses at the largest mean + UCB_BETA x deviation of the excess."""

    begins_with_raster = True

    def worth(self, observation: NDArray[np.floating]) -> NDArray[np.float64]:
        """The upper confidence bound."""
        belief = self.process.belief(observation)
        return belief.excess + UCB_BETA * belief.spread


class GpEi(GpVariance):
    """Expected improvement (Jones et al. 1998) over the largest expected excess."""

    begins_with_raster = True

    def worth(self, observation: NDArray[np.floating]) -> NDArray[np.float64]:
        """The improvement's expectation d P(z) + s p(z), z = d / s, by the normal distribution P and its density p."""
        belief = self.process.belief(observation)
        gain = belief.excess - belief.excess[self.process.candidates].max()
        ratio = gain / np.maximum(belief.spread, 1e-9)
        return gain * norm.cdf(ratio) + belief.spread * norm.pdf(ratio)


class GpThompson(GpVariance):
    """Posterior sampling (Thompson 1933; Kandasamy et al. 2018): the maximum of one sample of the excess.

    The sample is a sum of random waves of the prior (Rahimi & Recht 2007), corrected by the process of the difference
    between what was felt and the same presses on the sample (Wilson et al. 2020, "Efficiently sampling functions from
    Gaussian process posteriors").
    """

    begins_with_raster = True

    def worth(self, observation: NDArray[np.floating]) -> NDArray[np.float64]:
        """The sample."""
        process, facts, rng = self.process.process, self.process.facts, self.rng
        pressed, values, gradients = self.process.touches(observation)
        waves, phases = rng.normal(size=(2, WAVE_COUNT)) / process.length, rng.uniform(0.0, 2.0 * math.pi, WAVE_COUNT)
        scale, pressable = EXCESS_SPREAD * math.sqrt(2.0 / WAVE_COUNT), facts.map.pressable
        sample = np.zeros(len(facts.sites))
        sample[pressable] = scale * cos(matmul(facts.sites[pressable], waves) + phases).sum(axis=1)
        noise = rng.normal(scale=math.sqrt(process.noise_variance), size=len(pressed))
        felt = sample[pressed] + rng.normal(scale=BACKGROUND_SPREAD) + noise
        if gradients is not None:
            slopes = -scale * matmul(sin(matmul(facts.sites[pressed], waves) + phases), waves.T)
            gradients = gradients - rng.normal(slopes, math.sqrt(process.gradient_variance))
        return sample + process.mean(facts.sites[pressed], values - felt, gradients)[1].ravel()


class GpLevelSet(GpVariance):
    """Level-set search: presses at the most ambiguous site between lesion and healthy tissue.

    Implicit level sets by upper confidence bounds, ILS-UCB (Garg et al. 2016, "Tumor localization using automated
    palpation with Gaussian process adaptive sampling"; Gotovos et al. 2013): the level h is a share of the largest
    expected excess, and the next press has the largest ambiguity min(upper bound - h, h - lower bound): outlines of
    lesions and unexplored regions.
    """

    begins_with_raster = True

    def worth(self, observation: NDArray[np.floating]) -> NDArray[np.float64]:
        """The ambiguity; the level is at least the estimator's least excess of a lesion."""
        belief = self.process.belief(observation)
        excess, margin = belief.excess, LEVEL_BETA * belief.spread
        level = max(self.process.facts.excess_least, LEVEL_SHARE * float(excess[self.process.candidates].max()))
        return np.minimum(excess + margin - level, level - excess + margin)


class OracleNear(GpVariance):
    """Presses the true lesions first, then a place far from all, then around each, then the least certain sites.

    A bound for the presses that locate lesions by the common estimator: a search has to find them first.
    """

    sees_truth: ClassVar[bool] = True
    # Directions around a lesion, and the distance over the lesions' mean radius.
    around: ClassVar[NDArray[np.float64]] = np.array([[1.0, 0.0], [-0.5, 0.87], [-0.5, -0.87]])
    distance: ClassVar[float] = 0.9

    def see(self, task: PalpateSitesTask) -> None:
        """Take the truth of the episode, after `reset`."""
        facts = self.process.facts
        places = [task.charted.chart.place(point) for point in task.truth]
        lesions = 0.5 * (np.clip(np.reshape(places, (-1, 2)), -1.0, 1.0) + 1.0) * facts.extent
        squared = np.square(facts.sites[:, None] - lesions).sum(axis=2).min(axis=1, initial=np.inf)
        far = facts.sites[np.argmax(np.where(self.process.candidates, squared, -np.inf))]
        rings = [lesions + self.distance * facts.lesion_radius * way for way in self.around]
        self.first_places = np.concatenate([lesions, far[None], *rings])

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """The next press."""
        if self.count < len(self.first_places):
            self.count += 1
            return self.process.facts.action(self.first_places[self.count - 1])
        return super().act(observation)


class Middle:
    """The blind guess: one lesion in the middle of the chart, regardless of the presses.

    It presses the middle too, since the environment asks for presses; `estimate` and `estimate_map` are scored instead
    of the estimator's output.
    """

    def reset(self, rng: np.random.Generator, facts: SiteFacts) -> None:
        """Begin an episode."""

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """The middle of the chart."""
        return np.zeros(2, dtype=np.float32)

    def estimate(self, surface: Surface) -> NDArray[np.float64]:
        """The middle of the chart on the surface [m], shape (1, 3)."""
        return surface(np.zeros((1, 2)))

    def estimate_map(self, score: MapScore) -> MapScore:
        """A uniform map without an outline."""
        return replace(score, excess=np.zeros_like(score.excess), outline=np.zeros_like(score.outline))


class TruthAgent(Middle):
    """The oracle: estimates the true lesions; every place, map and outline scores 100 %."""

    sees_truth: ClassVar[bool] = True

    def see(self, task: PalpateSitesTask) -> None:
        """Take the truth of the episode, after `reset`."""
        self.truth = task.truth

    def estimate(self, surface: Surface) -> NDArray[np.float64]:
        """Places of the lesions on the surface [m], shape (k, 3)."""
        return self.truth

    def estimate_map(self, score: MapScore) -> MapScore:
        """The true map: 1 over lesions, else 0, and the true outline."""
        return replace(score, excess=score.lesion.astype(np.float64), outline=score.outline_true)


# Sides of the rasters on each scene; the leaderboard shows the best raster.
RASTER_SIDES = (2, 3, 4, 5, 6, 7)

AGENTS: dict[str, Callable[[], SiteAgent]] = {
    "random": RandomSites,
    **{f"raster_{side}": lambda side=side: RasterSites(side) for side in RASTER_SIDES},
    "sobol": SobolSites,
    "gp_evr": GpEvr,
    "gp_ucb": GpUcb,
    "gp_ei": GpEi,
    "gp_thompson": GpThompson,
    "gp_level_set": GpLevelSet,
    "oracle_near": OracleNear,
    "truth": TruthAgent,
    "middle": Middle,
}

# Methods with estimates regardless of their presses.
REFERENCES = ("truth", "middle")
# Methods with the truth, or without a search.
BOUNDS = (*REFERENCES, "oracle_near")
