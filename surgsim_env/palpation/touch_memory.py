"""Running record of a moving tip's contrast at each site of a chart, in a fixed size for observations."""

import math
from dataclasses import dataclass

import numpy as np

from msdm_core.material.regions import Material
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.palpation.chart import Chart


@dataclass(frozen=True)
class Indenter:
    """A ball on a soft half space: the model of a press on healthy tissue.

    Args:
        radius: of the ball [m].
        material: of the tissue.
    """

    radius: float
    material: Material

    def force(self, depth: float) -> float:
        """Hertz's force [N] at a depth [m]: 4/3 E / (1 - nu^2) sqrt(R) d^1.5 (Johnson, Contact Mechanics, 1985)."""
        modulus = self.material.youngs_modulus / (1.0 - self.material.poisson_ratio**2)
        return 4.0 / 3.0 * modulus * math.sqrt(self.radius) * max(depth, 0.0) ** 1.5


class TouchMemory:
    """Contrast at each site of a chart: force over Hertz's for nominal tissue, fitted to all readings there.

    Readings f_i at depths with Hertz's forces h_i give the least-squares contrast sum(f_i h_i) / sum(h_i^2), so that
    deep presses, which have the least relative noise, weigh most. Readings beyond the chart, and at less than half the
    scene's press depth, are left out: |contrast| is at most the sensor's range over Hertz's force there (`bound`).
    """

    def __init__(self, chart: Chart, indenter: Indenter, *, press_depth: float, force_range: float) -> None:
        """Start with an empty record.

        Args:
            chart: its sites are recorded.
            indenter: model of the healthy press.
            press_depth: of the scene [m].
            force_range: of the sensor, each axis [N].
        """
        self.chart, self.indenter = chart, indenter
        self.least_depth = 0.5 * press_depth
        self.bound = math.sqrt(3.0) * force_range / indenter.force(self.least_depth)
        self.forget()

    def forget(self) -> None:
        """Begin an episode."""
        self.product, self.square = np.zeros((2, self.chart.side_count**2))

    def feel(self, place: FloatArray, depth: float, force: float) -> None:
        """Add a reading of the force along the normal [N], at a place of the chart (2,) and a depth [m]."""
        site = self.chart.site(place)
        if site is None or depth < self.least_depth:
            return
        healthy = self.indenter.force(depth)
        self.product[site] += force * healthy
        self.square[site] += healthy**2

    @property
    def visited(self) -> FloatArray:
        """1 where a site has a reading, else 0, shape (n_site,)."""
        return (self.square > 0.0).astype(np.float64)

    @property
    def contrast(self) -> FloatArray:
        """Contrast of each site, 0 without a reading, shape (n_site,)."""
        return _ratio(self.product, self.square)

    def stiffest(self) -> FloatArray:
        """Place (2,) and contrast of the stiffest site, averaged with its eight neighbours; zeros without a reading."""
        if not self.square.any():
            return np.zeros(3)
        around = _ratio(self._with_neighbours(self.product), self._with_neighbours(self.square))
        best = int(np.argmax(np.where(self.square > 0.0, around, -np.inf)))
        return np.append(self.chart.sites[best], around[best])

    def _with_neighbours(self, values: FloatArray) -> FloatArray:
        """Sums over three by three sites."""
        side = self.chart.side_count
        padded = np.pad(values.reshape(side, side), 1)
        rows = padded[:-2] + padded[1:-1] + padded[2:]
        return (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]).ravel()


def _ratio(product: FloatArray, square: FloatArray) -> FloatArray:
    return np.divide(product, square, out=np.zeros_like(product), where=square > 0.0)
