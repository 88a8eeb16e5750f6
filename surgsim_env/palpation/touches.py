"""Records of touches on a chart: of single presses, and of a moving tip in a fixed size for observations."""

import copy
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.arithmetic import exp, log, matmul
from msdm_core.material.regions import Material
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.palpation.bell_fit import BellFit, framed, ratio
from surgsim_env.palpation.chart import ChartedFace, HealthyMap, Site
from surgsim_env.palpation.site_press import PressResult
from surgsim_env.scene.model import PalpationSettings, Scene
from surgsim_env.scene.palpable_surface import hertz_force

# Speed of the tip between sites [m/s]; its travel is counted, not simulated.
TRAVEL_SPEED = 0.02
# Largest absolute log contrast; `Touch.cut` reports clipping.
LOG_CONTRAST_BOUND = 2.0
# Gain of the centre of pressure's shift over the gradient of the log contrast, as a share of the squared contact radius
# tip radius x depth: 1/5 for Hertz's pressure with a stiffness linear across it, more as the ball also reaches below.
GRADIENT_GAIN = 0.32
# Largest absolute part of the gradient, in a tip radius.
GRADIENT_BOUND = 4.0
# Largest excess of the stiffest spot in a summary, and least mean contrast under it: a mean near 0 is noise.
EXCESS_BOUND, MEAN_LEAST = 3.0, 0.1


@dataclass(frozen=True)
class Touch:
    """Observable outcome of a press.

    Args:
        place: on the chart, each -1 to 1.
        moved: distance from the requested place [m].
        force: along the inward normal, through the sensor model [N].
        depth: of the tip [m].
        log_contrast: log of stiffness over healthy stiffness.
        cut: True if the log contrast, or a part of the gradient, was clipped to its bound.
        stopped: True if force ended the motion inward before depth did.
    """

    place: tuple[float, float]
    moved: float = 0.0
    force: float = 0.0
    depth: float = 0.0
    log_contrast: float = 0.0
    cut: bool = False
    stopped: bool = False

    @property
    def stiffness(self) -> float:
        """Force over depth [N/m]; 0 for a tip above the surface."""
        return self.force / self.depth if self.depth > 0.0 else 0.0


class SiteTouches:
    """Touches of an episode.

    Fields:
        touches: of the presses, in their order
        gradients: of the log contrast at the presses along the chart's sides, from the shift of the centre of pressure
            [1/m], 0 without taxels (n, 2)
        taxels: of the last press [N], (n_patch, rows, columns, 3); none before the first or without taxels
        seconds, path_length: of the tip so far [s], [m], with the counted travel between sites
        map_shift: offset of the healthy map from the organ along the chart's sides [m] (2,)
    """

    def __init__(self, charted: ChartedFace, healthy: HealthyMap, palpation: PalpationSettings) -> None:
        self.charted, self.healthy, self.palpation = charted, healthy, palpation
        self.map_shift = np.zeros(2)
        self.clear()

    def clear(self) -> None:
        """Begin an episode."""
        self.touches: list[Touch] = []
        self.gradients = np.zeros((0, 2))
        self.seconds = self.path_length = 0.0
        self._last_start: FloatArray | None = None
        self.taxels = np.zeros(0)
        self._maps = np.zeros((4, len(self.charted.touch_map.pressable)))

    @property
    def last(self) -> Touch:
        """Last touch; zeros before the first."""
        return self.touches[-1] if self.touches else Touch((0.0, 0.0))

    def add(self, site: Site, result: PressResult, force: float, taxels: FloatArray | None = None) -> None:
        """Record a press at a site.

        Args:
            site: of the press.
            result: of the press.
            force: along the normal, through the sensor model [N].
            taxels: forces on the taxels, through theirs [N], (n_patch, rows, columns, 3); None without.
        """
        on_map = site.place + 2.0 * self.map_shift / self.charted.chart.extent
        healthy = float(self.healthy.stiffness(on_map))
        # The least contrast for a small force reversed by bias and noise, and for an arm stopped above the surface.
        contrast = force / (result.depth * healthy) if result.depth > 0.0 else 0.0
        log_contrast = float(log(contrast)) if contrast > 0.0 else -math.inf
        bounded = min(max(log_contrast, -LOG_CONTRAST_BOUND), LOG_CONTRAST_BOUND)
        u, v = site.place.tolist()
        gradient, bound = np.zeros(2), GRADIENT_BOUND / self.charted.tip_radius
        if taxels is not None:
            assert result.taxel_places is not None
            self.taxels, push = taxels, taxels[..., 2]
            centre = (push[..., None] * self.charted.chart.along_axes(result.taxel_places)).sum(axis=(0, 1, 2))
            total = float(push.sum())
            # Noise alone has no centre.
            if total > 0.0:
                gradient = (centre / total - self.healthy.centre(on_map)) / self.gradient_gain
        held = np.clip(gradient, -bound, bound)
        cut = bounded != log_contrast or bool((held != gradient).any())
        self.gradients = np.vstack([self.gradients, held])
        self.touches.append(Touch((u, v), site.moved, force, result.depth, bounded, cut, result.stopped))
        self._mark(self.touches[-1], held)
        start = site.point + site.normal * self.palpation.clearance
        travel = 0.0 if self._last_start is None else math.dist(start, self._last_start)
        stroke = self.palpation.clearance + result.depth
        self.path_length += travel + 2.0 * stroke
        self.seconds += result.duration + (travel + stroke) / TRAVEL_SPEED
        self._last_start = start

    @property
    def places(self) -> FloatArray:
        """Places of the presses as lengths along the chart's sides [m], shape (n, 2)."""
        places = np.array([touch.place for touch in self.touches]).reshape(-1, 2)
        return 0.5 * (places + 1.0) * self.charted.chart.extent

    @property
    def log_contrasts(self) -> FloatArray:
        """Log contrast of the presses, shape (n,)."""
        return np.array([touch.log_contrast for touch in self.touches])

    @property
    def gradient_gain(self) -> float:
        """Shift of the centre of pressure over the gradient of the log contrast [m^2]."""
        return GRADIENT_GAIN * self.charted.tip_radius * self.palpation.press_depth

    def maps(self) -> FloatArray:
        """Log contrast, 1 for pressed sites, and both parts of the gradient [1/m], of the touch map, (4, n_site).

        A site pressed again has its latest contrast.
        """
        return self._maps

    def _mark(self, touch: Touch, gradient: FloatArray) -> None:
        site = self.charted.touch_map.nearest(touch.place)
        self._maps[:, site] = touch.log_contrast, 1.0, *gradient

    def get_state(self) -> dict[str, Any]:
        """Record as a table for JSON."""
        return {
            "touches": [asdict(touch) for touch in self.touches],
            "way": [self.seconds, self.path_length],
            "last_start": None if self._last_start is None else self._last_start.tolist(),
            "map_shift": self.map_shift.tolist(),
            **({"gradients": self.gradients.tolist(), "taxels": self.taxels.tolist()} if self.taxels.size else {}),
        }

    def set_state(self, table: Mapping[str, Any]) -> None:
        """Restore a record from `get_state`."""
        self.clear()
        self.gradients = np.array(table.get("gradients", np.zeros((len(table["touches"]), 2))))
        for touch, gradient in zip(table["touches"], self.gradients, strict=True):
            self.touches.append(Touch(**{**touch, "place": tuple(touch["place"])}))
            self._mark(self.touches[-1], gradient)
        self.seconds, self.path_length = table["way"]
        start = table["last_start"]
        self._last_start = None if start is None else np.array(start)
        self.map_shift = np.array(table["map_shift"])
        self.taxels = np.array(table.get("taxels", []))


def felt_lesion_radius(scene: Scene) -> float:
    """Mean felt radius of a scene's hidden lesions [m]; lesions smaller than the tip are felt as wide as the tip."""
    assert scene.lesion is not None
    return max(scene.instrument.tip_radius, 0.5 * (scene.lesion.radius[0] + scene.lesion.radius[1]))


@dataclass(frozen=True)
class Indenter:
    """Ball on a soft half space, the model of a press on healthy tissue.

    Args:
        radius: of the ball [m].
        material: of the tissue.
    """

    radius: float
    material: Material

    def force(self, depth: float) -> float:
        """`hertz_force` [N] at a depth [m]; 0 above the surface."""
        return hertz_force(self.material, self.radius, max(depth, 0.0))


class TouchMemory:
    """Contrast at each site of a touch map: force over Hertz's for nominal tissue, fitted to the site's readings.

    Readings f_i at depths with Hertz's forces h_i give the least-squares contrast sum(f_i h_i) / sum(h_i^2); deep
    presses, with the least relative noise, weigh most. Readings off the pressable sites and at less than half the
    scene's press depth are left out: |contrast| is at most the sensor's range over Hertz's force at that depth
    (`bound`).
    """

    def __init__(
        self,
        charted: ChartedFace,
        indenter: Indenter,
        *,
        press_depth: float,
        lesion_radius: float,
        force_range: float,
        force_noise: float,
    ) -> None:
        """Start with an empty record.

        Args:
            charted: the face with the touch map.
            indenter: model of the healthy press.
            press_depth: of the scene [m].
            lesion_radius: mean felt radius of the lesions [m].
            force_range: of the sensor, each axis [N].
            force_noise: of the sensor, standard deviation of a reading [N].
        """
        self.chart, self.map, self.indenter = charted.chart, charted.touch_map, indenter
        self.least_depth = 0.5 * press_depth
        self.bound = math.sqrt(3.0) * force_range / indenter.force(self.least_depth)
        self.bell_fit = BellFit(self.map, lesion_radius, force_noise)
        self.forget()

    def forget(self) -> None:
        """Begin an episode."""
        self.product, self.square = np.zeros((2, len(self.map.pressable)))
        # Fitted on demand after a reading.
        self._stiffest: FloatArray | None = None

    def restored(self, product: ArrayLike, square: ArrayLike) -> Self:
        """Copy with other sums of the readings, (n_site,) each."""
        other = copy.copy(self)
        other.product, other.square = np.array(product, dtype=np.float64), np.array(square, dtype=np.float64)
        other._stiffest = None
        return other

    def feel(self, place: FloatArray, depth: float, force: float) -> None:
        """Add a reading of the force along the normal [N] at a place of the chart (2,) and a depth [m]."""
        site = self.map.nearest(place)
        if site < 0 or not self.map.pressable[site] or depth < self.least_depth:
            return
        healthy = self.indenter.force(depth)
        self.product[site] += force * healthy
        self.square[site] += healthy * healthy
        self._stiffest = None

    @property
    def visited(self) -> FloatArray:
        """1 for sites with a reading, else 0, shape (n_site,)."""
        return (self.square > 0.0).astype(np.float64)

    @property
    def contrast(self) -> FloatArray:
        """Contrast of each site, 0 without a reading, shape (n_site,)."""
        return ratio(self.product, self.square)

    def stiffest(self) -> FloatArray:
        """Place (2,) and contrast of the stiffest spot; zeros without a reading."""
        spot = self._stiffest
        if spot is None:
            spot = self._stiffest = stiffest_spots(self.bell_fit, self.product[None], self.square[None])[0]
        return spot.copy()

    def summary(self, place: FloatArray) -> FloatArray:
        """Seven numbers for a search from a place of the chart (2,), zeros without a reading but the last two.

        Felt share of the pressable sites, mean contrast c of the felt ones, excess c_max / c - 1 of the stiffest spot;
        ways [m] along the chart's sides to that spot (2), and to the centroid of the sites that are not felt, weighted
        by exp(-(d / r)^2 / 2) with their distance d and the tip's radius r (2).
        """
        here, reach = 0.5 * (place + 1.0) * self.chart.extent, self.indenter.radius
        felt, ways = self.square[self.map.pressable] > 0.0, self.map.sites[self.map.pressable] - here
        near = np.where(felt, 0.0, exp(-0.5 * (ways * ways).sum(axis=1) / (reach * reach)))
        # Far from all sites the weights are 0.
        fresh = matmul(near, ways) / max(float(near.sum()), 1e-6)
        if not felt.any():
            return np.array([0.0, 0.0, 0.0, 0.0, 0.0, *fresh])
        u, v, contrast = self.stiffest()
        mean = float(self.contrast[self.map.pressable][felt].mean())
        excess = contrast / max(mean, MEAN_LEAST) - 1.0
        spot = 0.5 * (np.array([u, v]) + 1.0) * self.chart.extent - here
        return np.array([felt.mean(), mean, min(max(excess, -EXCESS_BOUND), EXCESS_BOUND), *spot, *fresh])


def stiffest_spots(bell_fit: BellFit, product: FloatArray, square: FloatArray) -> FloatArray:
    """Place and contrast of the stiffest spot of n records (n, 3), from their sums of readings (n, n_site) each.

    The place is the middle of the best bell (`BellFit`); if no bell improves the fit, the site of the largest contrast.
    The contrast is that of the nearest site, averaged with its eight neighbours. A record without readings gives zeros.
    """
    sums = bell_fit.cropped(np.stack([product, square]))
    bell = bell_fit.best(*sums)
    around = ratio(*_with_neighbours(sums)).reshape(len(product), -1)
    felt = sums[1].reshape(len(product), -1) > 0.0
    best = np.where(bell.site >= 0, bell.site, np.argmax(np.where(felt, around, -np.inf), axis=1))
    place = np.where((bell.site >= 0)[:, None], bell.place, bell_fit.places[best])
    spots = np.column_stack([place, around[np.arange(len(best)), best]])
    return np.where(felt.any(axis=1)[:, None], spots, 0.0)


def _with_neighbours(values: FloatArray) -> FloatArray:
    """Sums over three by three sites, for values (..., row, column)."""
    larger = framed(values.reshape(-1, *values.shape[-2:]), 0.0)
    rows = larger[:, :-2] + larger[:, 1:-1] + larger[:, 2:]
    return (rows[:, :, :-2] + rows[:, :, 1:-1] + rows[:, :, 2:]).reshape(values.shape)
