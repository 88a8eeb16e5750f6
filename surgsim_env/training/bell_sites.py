"""A fast surrogate of SurgSim/PalpateSites-v0 on faces of any size: contrast from bell curves instead of an organ.

Each episode draws a face, between a phantom's and a whole liver's in size, round or rectangular, and up to three
lesions in it. The log contrast of a press at x is

    b + sum_i A_i exp(-|x - x_i|^2 / (2 s_i^2)) + m(x) + noise

with b what all presses share, m a smooth deviation of healthy tissue that the map of the healthy organ does not have,
and the sensor's noise. On a curved organ the maximum of a bell lies beside the lesion's place, and m is larger. Lengths
are in tip radii. Touch map, estimator, score and rewards of finding are the environment's; there are no forces. Ranges
are those of presses of the full physics (`DRAWS`).
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from surgsim_env.palpation.chart import MAP_CELL, MAP_SIDE, TouchMap
from surgsim_env.palpation.lesion_estimator import ORGAN_MAP_SPREAD, LesionEstimator
from surgsim_env.palpation.scores import FOUND_SHARE, ospa, ospa_cutoff
from surgsim_env.tasks.palpate_sites import BUDGET, BUDGET_WIDE, SUCCESS_ERROR, WIDE, PalpateSitesTask
from surgsim_env.training.site_agent import OBSERVATION_SIZE, SLICES

# Tip radius of the estimator's own lengths: an error in tip radii over it is one in metres of the benchmark.
TIP = 0.008


@dataclass(frozen=True)
class BellDraws:
    """Ranges of an episode's draw, lengths in tip radii.

    Args:
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


class BellSites(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """SurgSim/PalpateSites-v0 with memory, without an organ; `info`: `error_mm` (under a tip of 8 mm) and `success`."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(self, draws: BellDraws = DRAWS) -> None:
        """Draw episodes from these ranges."""
        self.draws = draws
        self.observation_space = gym.spaces.Box(-100.0, 100.0, (OBSERVATION_SIZE,), dtype=np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)
        self.cutoff = ospa_cutoff(TIP)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Draw a face and its lesions; no options are known."""
        super().reset(seed=seed)
        rng, draws = self.np_random, self.draws
        self.is_organ = bool(rng.random() < draws.organ_share)
        self.map = self._draw_face(rng)
        self.budget = BUDGET_WIDE if self.map.extent.max() > WIDE else BUDGET
        self.noise = float(np.exp(rng.uniform(*np.log(draws.noise))))
        self.lesion_radius = float(np.exp(rng.uniform(*np.log(draws.lesion_radius))))
        self.estimator = LesionEstimator(
            self.map.extent * TIP,
            lesion_radius=self.lesion_radius * TIP,
            noise=self.noise,
            map_spread=ORGAN_MAP_SPREAD if self.is_organ else 0.0,
        )
        self.middles = self._draw_lesions(rng) * TIP
        count = len(self.middles)
        offset = draws.offset * self.lesion_radius * TIP if self.is_organ else 0.0
        self.truth = self.middles + rng.normal(0.0, offset, (count, 2))
        self.amplitude = rng.uniform(*draws.amplitude, count)
        self.spread = rng.uniform(*draws.spread, count) * self.lesion_radius * TIP
        self.background = rng.normal(0.0, draws.background)
        self.waves = rng.normal(0.0, 1.0 / TIP, (WAVES, 2)), rng.uniform(0.0, 2.0 * np.pi, WAVES)
        self.places: list[NDArray[np.float64]] = []
        self.values: list[float] = []
        self.memory = np.zeros(OBSERVATION_SIZE, dtype=np.float32)
        self.memory[SLICES["face_map"]] = self.map.pressable
        self.memory[SLICES["map_cell"]] = self.map.cell
        self.memory[SLICES["chart_share"]] = self.map.extent / (self.map.cell * (MAP_SIDE - 1))
        self.memory[SLICES["contrast_noise"]] = self.noise
        self.memory[SLICES["excess_least"]] = self.estimator.excess_least
        self.memory[SLICES["lesion_radius"]] = self.lesion_radius
        self.memory[SLICES["presses_left"]] = 1.0
        self.error, self.found = self._judged()
        return self.memory.copy(), {"error_mm": 1000.0 * self.error}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Press at the site of the map that is nearest to a place of the chart and may be pressed."""
        asked = 0.5 * (np.asarray(action, dtype=np.float64) + 1.0) * self.map.extent
        squared = ((self.map.sites - asked) ** 2).sum(axis=1)
        site = int(np.argmin(np.where(self.map.pressable, squared, np.inf)))
        place = self.map.sites[site] * TIP
        value = float(self.contrast(place[None])[0] + self.np_random.normal(0.0, self.noise))
        self.places.append(place)
        self.values.append(value)
        self.memory[SLICES["contrast_map"]][site], self.memory[SLICES["pressed_map"]][site] = value, 1.0
        self.memory[SLICES["presses_left"]] = 1.0 - len(self.places) / self.budget
        found_before = self.found
        self.error, self.found = self._judged()
        weights = PalpateSitesTask.weights
        reward = weights["error"] * self.error / self.cutoff / self.budget
        reward += weights["found"] * (self.found - found_before)
        over = len(self.places) >= self.budget
        info = {"error_mm": 1000.0 * self.error, "success": over and self.error <= SUCCESS_ERROR}
        return self.memory.copy(), reward, over, False, info

    def contrast(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log contrast without the sensor's noise at places (n, 2) [m]."""
        squared = ((places[:, None] - self.middles) ** 2).sum(axis=2)
        bells = (self.amplitude * np.exp(-0.5 * squared / self.spread**2)).sum(axis=1)
        direction, phase = self.waves
        rough = (
            self.draws.model[self.is_organ] * np.sqrt(2.0 / WAVES) * np.cos(places @ direction.T + phase).sum(axis=1)
        )
        return self.background + bells + rough

    # ---- the draw --------------------------------------------------------------------------------------------------

    def _draw_face(self, rng: np.random.Generator) -> TouchMap:
        """A face as a touch map, lengths in tip radii."""
        draws = self.draws
        longest = float(np.exp(rng.uniform(*np.log(draws.side))))
        extent = longest * np.array([1.0, rng.uniform(*draws.aspect)])[:: int(rng.choice([-1, 1]))]
        cell = max(MAP_CELL, longest / (MAP_SIDE - 1))
        plain = TouchMap(extent, cell, np.ones(MAP_SIDE**2, dtype=np.bool_))
        away = np.abs(plain.places)
        inside = (away <= 1.0 + 1e-9).all(axis=1)
        if self.is_organ:
            inside &= (away ** rng.uniform(2.0, 6.0)).sum(axis=1) <= 1.0
        return TouchMap(extent, cell, inside)

    def _draw_lesions(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Middles of bells apart from each other (n, 2); fewer where the face has no room."""
        sites, apart = self.map.sites[self.map.pressable], self.draws.apart * self.lesion_radius
        places: list[NDArray[np.float64]] = []
        for _ in range(int(rng.choice(len(self.draws.count_weights), p=self.draws.count_weights))):
            free = [one for one in sites if all(np.linalg.norm(one - other) >= apart for other in places)]
            if free:
                shift = rng.uniform(-0.5, 0.5, 2) * self.map.cell
                places.append(np.clip(free[int(rng.integers(len(free)))] + shift, 0.0, self.map.extent))
        return np.array(places).reshape(-1, 2)

    def _judged(self) -> tuple[float, float]:
        """Error of the estimate (OSPA) [m], and the share of lesions with an estimate near them."""
        points = self.estimator.estimate(np.array(self.places).reshape(-1, 2), np.array(self.values)).points
        error = ospa(self.truth, points, self.cutoff)
        if len(self.truth) == 0:
            return error, float(len(points) == 0)
        distance = np.linalg.norm(self.truth[:, None] - points, axis=2)
        return error, float((distance <= FOUND_SHARE * self.cutoff).any(axis=1).mean())
