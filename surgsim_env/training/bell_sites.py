"""Faces of any size for the surrogate of SurgSim/PalpateSites-v0: contrast from bell curves instead of an organ.

Each episode draws a face, between a phantom's and a whole liver's in size, round or rectangular, and up to three
lesions in it. The log contrast of a press at x is

    b + sum_i A_i exp(-|x - x_i|^2 / (2 s_i^2)) + m(x) + noise

with b what all presses share, m a smooth deviation of healthy tissue that the map of the healthy organ does not have,
and the sensor's noise. On a curved organ the maximum of a bell lies beside the lesion's place, and m is larger. Lengths
are in tip radii. Ranges are those of presses of the full physics (`DRAWS`).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgsim_env.palpation.chart import MAP_CELL, MAP_SIDE, TouchMap
from surgsim_env.palpation.lesion_estimator import ORGAN_MAP_SPREAD, LesionEstimator
from surgsim_env.training.site_surrogate import SurrogateFace


@dataclass(frozen=True)
class BellDraws:
    """Ranges of an episode's draw, lengths in tip radii but for the first.

    Args:
        tip_radius: of the scene [m]; scores count errors in metres, not in tip radii.
        side: of the face's bounding rectangle, each.
        aspect: shorter over longer side.
        organ_share: share of faces that are superellipses of curved organs; the others are rectangles of blocks.
        count_weights: probabilities of 0, 1, 2, ... lesions.
        lesion_radius: mean radius of the lesions that the episode's scene hides.
        amplitude: A of a lesion's bell curve.
        spread: s of a lesion's bell curve over lesion_radius.
        apart: least distance of two lesions over lesion_radius.
        background: deviation of b.
        model: deviation of m on a block and on an organ; its correlation length is one tip radius.
        offset: deviation, along each side, of a lesion's place from the maximum of its bell on an organ, over
            lesion_radius.
        noise: deviation of the sensor's noise.
    """

    tip_radius: tuple[float, float] = (0.005, 0.012)
    side: tuple[float, float] = (3.5, 17.0)
    aspect: tuple[float, float] = (0.5, 1.0)
    organ_share: float = 0.5
    count_weights: tuple[float, ...] = (0.1, 0.5, 0.25, 0.15)
    lesion_radius: tuple[float, float] = (0.9, 1.8)
    amplitude: tuple[float, float] = (0.2, 0.65)
    spread: tuple[float, float] = (0.7, 1.15)
    apart: float = 2.4
    background: float = 0.2
    model: tuple[float, float] = (0.015, 0.02)
    offset: float = 0.12
    noise: tuple[float, float] = (0.012, 0.07)


# By presses on `phantom` at level "standard" (lesion_radius 1): amplitudes 0.22 to 0.62, spreads 0.78 to 0.93 of
# single lesions and residuals of 0.007 to 0.016 without noise; the noise of the sensor is 0.047 there. On 16 members of
# the training split of `liver_family` (lesion_radius 1.38): amplitudes 0.36 to 0.57, spreads from 1.1 on, residuals of
# 0.009 to 0.032, lesions 0.24 beside the maximum of their bells (median); the noise of the sensor is 0.012.
DRAWS = BellDraws()
# Waves that m is a sum of.
WAVES = 12


@dataclass(frozen=True)
class BellFaces:
    """Draws faces with lesions from ranges."""

    draws: BellDraws = DRAWS

    def __call__(self, rng: np.random.Generator) -> SurrogateFace:
        """Draw a face."""
        draws = self.draws
        tip_radius = float(np.exp(rng.uniform(*np.log(draws.tip_radius))))
        is_organ = bool(rng.random() < draws.organ_share)
        touch_map = self._draw_map(rng, is_organ)
        noise = float(np.exp(rng.uniform(*np.log(draws.noise))))
        lesion_radius = float(np.exp(rng.uniform(*np.log(draws.lesion_radius))))
        middles = self._draw_lesions(rng, touch_map, lesion_radius)
        count = len(middles)
        truth = middles + rng.normal(0.0, draws.offset * lesion_radius if is_organ else 0.0, (count, 2))
        amplitude = rng.uniform(*draws.amplitude, count)
        spread = rng.uniform(*draws.spread, count) * lesion_radius
        squared = ((touch_map.sites[:, None] - middles) ** 2).sum(axis=2)
        contrast = rng.normal(0.0, draws.background) + (amplitude * np.exp(-0.5 * squared / spread**2)).sum(axis=1)
        waves, phases = rng.normal(0.0, 1.0, (WAVES, 2)), rng.uniform(0.0, 2.0 * np.pi, WAVES)
        rough = draws.model[is_organ] * np.sqrt(2.0 / WAVES)
        contrast += rough * np.cos(touch_map.sites @ waves.T + phases).sum(axis=1)
        estimator = LesionEstimator(
            touch_map.extent * tip_radius,
            lesion_radius=lesion_radius * tip_radius,
            noise=noise,
            map_spread=ORGAN_MAP_SPREAD if is_organ else 0.0,
        )
        return SurrogateFace(
            touch_map, tip_radius, estimator, contrast, truth * tip_radius, surface=lambda points: points
        )

    def _draw_map(self, rng: np.random.Generator, is_organ: bool) -> TouchMap:
        """A face as a touch map, lengths in tip radii."""
        draws = self.draws
        longest = float(np.exp(rng.uniform(*np.log(draws.side))))
        extent = longest * np.array([1.0, rng.uniform(*draws.aspect)])[:: int(rng.choice([-1, 1]))]
        cell = max(MAP_CELL, longest / (MAP_SIDE - 1))
        plain = TouchMap(extent, cell, np.ones(MAP_SIDE**2, dtype=np.bool_))
        away = np.abs(plain.places)
        inside = (away <= 1.0 + 1e-9).all(axis=1)
        if is_organ:
            inside &= (away ** rng.uniform(2.0, 6.0)).sum(axis=1) <= 1.0
        return TouchMap(extent, cell, inside)

    def _draw_lesions(self, rng: np.random.Generator, touch_map: TouchMap, lesion_radius: float) -> NDArray[np.float64]:
        """Middles of bells apart from each other (n, 2); fewer where the face has no room."""
        sites, apart = touch_map.sites[touch_map.pressable], self.draws.apart * lesion_radius
        places: list[NDArray[np.float64]] = []
        for _ in range(int(rng.choice(len(self.draws.count_weights), p=self.draws.count_weights))):
            free = [one for one in sites if all(np.linalg.norm(one - other) >= apart for other in places)]
            if free:
                shift = rng.uniform(-0.5, 0.5, 2) * touch_map.cell
                places.append(np.clip(free[int(rng.integers(len(free)))] + shift, 0.0, touch_map.extent))
        return np.array(places).reshape(-1, 2)
