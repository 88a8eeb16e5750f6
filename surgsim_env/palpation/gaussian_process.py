"""Gaussian process of the log contrast over a chart: the estimate of contrast between presses."""

from dataclasses import dataclass

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray

# The numbers below hold for a tip of 8 mm; lengths scale with the tip's radius, as the patch that it touches does. They
# were chosen on organs that no evaluation uses, for the smallest mean error over random presses (docs/palpation.md).
REFERENCE_TIP_RADIUS = 0.008
# Prior of the background's log contrast, one number for the organ: moduli of +-30 % and a capsule.
BACKGROUND_SPREAD = 0.25
# Prior of the excess that lesions add: standard deviation, and correlation length [m]. A press over a lesion sees a
# bell curve of spread s = 7 mm, and a sum of such curves at random places has the correlation length sqrt(2) s.
EXCESS_SPREAD = 0.225
EXCESS_LENGTH = 0.010
# Deviation of healthy presses that the sensor's noise does not explain: a capsule that the map lacks, the mesh.
MODEL_SPREAD = 0.05


@dataclass(frozen=True, eq=False)
class ContrastProcess:
    """Gaussian process regression with fixed hyperparameters (Rasmussen & Williams 2006, eq. 2.25 and 2.26).

    log contrast at x = b + e(x) + noise, b ~ N(0, sb^2), e ~ GP(0, se^2 exp(-|x - x'|^2 / (2 l^2))): b is what all
    sites share (modulus, capsule, the sensor's bias), e the excess over it.

    Args:
        axes: coordinates of a grid's columns and rows along the chart's sides [m], shapes (g0,) and (g1,)
        length: correlation length l of the excess [m]
        noise_variance: of one press
    """

    axes: tuple[FloatArray, FloatArray]
    length: float
    noise_variance: float

    def mean(self, places: FloatArray, values: FloatArray) -> tuple[float, FloatArray]:
        """Posterior means of the background, and of the excess at the grid's points (g1, g0).

        Args:
            places: of the presses [m], shape (n, 2).
            values: their log contrast, shape (n,).
        """
        along, across = self._to_grid(places)
        if len(values) == 0:
            return 0.0, np.zeros((len(along), len(across)))
        weights = np.linalg.solve(self._covariance(places), values)
        # The covariance is a product over the axes: the map is one matrix product.
        return BACKGROUND_SPREAD**2 * float(weights.sum()), EXCESS_SPREAD**2 * (along * weights) @ across.T

    def spread(self, places: FloatArray) -> FloatArray:
        """Posterior standard deviation of the excess at the grid's points (g1, g0), given presses at places (n, 2)."""
        along, across = self._to_grid(places)
        if len(places) == 0:
            return np.full((len(along), len(across)), EXCESS_SPREAD)
        between = EXCESS_SPREAD**2 * along[:, None] * across
        explained = np.linalg.solve(self._covariance(places), between.reshape(-1, len(places)).T).T
        variance = EXCESS_SPREAD**2 - (explained.reshape(between.shape) * between).sum(axis=2)
        return np.sqrt(np.maximum(variance, 0.0))

    def _to_grid(self, places: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Factors of the correlation between rows and presses (g1, n), and between columns and presses (g0, n)."""
        across, along = (self._correlation(axis, places[:, i]) for i, axis in enumerate(self.axes))
        return along, across

    def _covariance(self, places: FloatArray) -> FloatArray:
        """Of the presses' log contrasts, (n, n)."""
        correlation = self._correlation(places[:, 0], places[:, 0]) * self._correlation(places[:, 1], places[:, 1])
        covariance = EXCESS_SPREAD**2 * correlation + BACKGROUND_SPREAD**2
        covariance.flat[:: len(places) + 1] += self.noise_variance
        return covariance

    def _correlation(self, first: FloatArray, second: FloatArray) -> FloatArray:
        return np.exp(-0.5 * ((first[:, None] - second) / self.length) ** 2)


def contrast_process(
    axes: tuple[FloatArray, FloatArray], *, tip_radius: float, noise: float, length_share: float = 1.0
) -> ContrastProcess:
    """The process for a tip's radius [m] and a sensor's standard deviation of one log contrast.

    Args:
        axes: see `ContrastProcess`.
        tip_radius: of the ball that presses [m].
        noise: standard deviation of one log contrast by the force sensor.
        length_share: factor on the correlation length.
    """
    length = length_share * (EXCESS_LENGTH * (tip_radius / REFERENCE_TIP_RADIUS))
    return ContrastProcess(axes, length, noise**2 + MODEL_SPREAD**2)
