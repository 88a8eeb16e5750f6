"""From presses on a chart to lesions: the one estimator that every method of the benchmark is scored through."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.mesh import FloatArray

# The numbers below hold for a tip of 8 mm and lengths go with the tip's radius, as the patch that it feels does. They
# were chosen on organs that no evaluation uses, for the smallest mean error over random presses (docs/palpation.md).
REFERENCE_TIP_RADIUS = 0.008
# Prior of the background's log contrast, one number for the organ: moduli of +-30 % and a capsule.
BACKGROUND_SPREAD = 0.25
# Prior of what lesions add to it: spread, and length [m] over which it changes. A lesion is felt as a bell curve of
# spread s = 7 mm, and a sum of such curves at random places has the correlation length sqrt(2) s.
EXCESS_SPREAD = 0.225
EXCESS_LENGTH = 0.010
# What no press of a healthy organ explains besides the sensor's noise: a capsule that the map has not, the mesh.
MODEL_SPREAD = 0.05
# A lesion is a maximum of the excess above the first of these and so many standard deviations of the sensor's noise,
EXCESS_LEAST = 0.07
EXCESS_LEAST_NOISE = 0.75
# at least so far [m] from a stronger one,
DISTANCE_LEAST = 0.012
# placed at the centroid of the excess within this [m] of it,
CENTROID_RADIUS = 0.009
# and its outline is where the excess is above this share of it.
OUTLINE_SHARE = 0.6
LESIONS_MOST = 3
# Distance between the points of the excess map [m].
MAP_SPACING = 0.002


@dataclass(frozen=True, eq=False)
class LesionEstimate:
    """What presses say of the lesions below them.

    Fields:
        points: where the lesions are on the chart [m], the strongest first                             (k, 2)
        strength: largest excess of the log contrast over each                                          (k,)
        background: log contrast of the tissue around them
        excess: what lesions add to the log contrast, at the map's points: row along the second axis    (g1, g0)
        outline: which of the map's points lie over a lesion                                            (g1, g0)
        axes: the map's coordinates along the chart's first and second axis [m]                         (g0,), (g1,)
    """

    points: FloatArray
    strength: FloatArray
    background: float
    excess: FloatArray
    outline: NDArray[np.bool_]
    axes: tuple[FloatArray, FloatArray]


class LesionEstimator:
    """Lesions as the maxima of a Gaussian process with fixed hyperparameters (Rasmussen & Williams 2006, eq. 2.25).

    log contrast at x = b + e(x) + noise, b ~ N(0, sb^2), e ~ GP(0, se^2 exp(-|x - x'|^2 / (2 l^2))). The mean of e
    given the presses is the excess map; b takes up what is common to all sites: modulus, capsule, the sensor's bias.

    Args:
        extent: of the chart, whose coordinates run from 0 to it [m], shape (2,).
        tip_radius: of the ball that presses [m]; the model's lengths go with it.
        noise: standard deviation of one log contrast by the sensor: its noise over the force of a healthy press.

    Raises:
        ValueError: an extent or tip_radius that is not above 0, a noise below 0.
    """

    def __init__(self, extent: ArrayLike, *, tip_radius: float, noise: float) -> None:
        self.extent = np.asarray(extent, dtype=np.float64)
        if self.extent.shape != (2,) or not (np.isfinite(self.extent) & (self.extent > 0.0)).all():
            raise ValueError(f"extent is {extent}; it must be two lengths above 0 in metres")
        if not 0.0 < tip_radius < np.inf:
            raise ValueError(f"tip_radius is {tip_radius:g} m; it must be above 0")
        if not 0.0 <= noise < np.inf:
            raise ValueError(f"noise is {noise:g}; it must be a standard deviation of log contrast, 0 or more")
        self.tip_radius, self.noise = tip_radius, noise
        self.scale = tip_radius / REFERENCE_TIP_RADIUS
        self.length = EXCESS_LENGTH * self.scale
        self.noise_variance = noise**2 + MODEL_SPREAD**2
        self.excess_least = EXCESS_LEAST + EXCESS_LEAST_NOISE * noise
        self.axes = (self._axis(0), self._axis(1))

    def _axis(self, index: int) -> FloatArray:
        """Coordinates of the map's points along an axis [m], from edge to edge."""
        count = max(2, round(self.extent[index] / (MAP_SPACING * self.scale)) + 1)
        return np.linspace(0.0, self.extent[index], count)

    def estimate(self, places: ArrayLike, log_contrast: ArrayLike) -> LesionEstimate:
        """The lesions that presses tell of; without a press there are none.

        Args:
            places: of the presses on the chart [m], shape (n, 2).
            log_contrast: log of stiffness over healthy stiffness, shape (n,).

        Raises:
            ValueError: shapes that do not belong together, or a number that is not finite.
        """
        places = np.asarray(places, dtype=np.float64).reshape(-1, 2)
        values = np.asarray(log_contrast, dtype=np.float64)
        if values.shape != (len(places),):
            raise ValueError(f"{len(places)} places but log contrasts of shape {values.shape}; give one for each")
        if not (np.isfinite(places).all() and np.isfinite(values).all()):
            raise ValueError("a place or a log contrast is not finite: leave out presses that ended in a fault")
        background, excess = self.posterior(places, values)
        points, strength = self._maxima(excess)
        return LesionEstimate(points, strength, background, excess, self._outline(excess, points, strength), self.axes)

    def posterior(self, places: FloatArray, values: FloatArray) -> tuple[float, FloatArray]:
        """Posterior means of the background and of the excess at the map's points, shape (g1, g0)."""
        across, along = (self._correlation(axis, places[:, i]) for i, axis in enumerate(self.axes))
        if len(values) == 0:
            return 0.0, np.zeros((len(along), len(across)))
        correlation = self._correlation(places[:, 0], places[:, 0]) * self._correlation(places[:, 1], places[:, 1])
        covariance = EXCESS_SPREAD**2 * correlation + BACKGROUND_SPREAD**2
        covariance.flat[:: len(values) + 1] += self.noise_variance
        weights = np.linalg.solve(covariance, values)
        # The RBF is a product over the axes: the map is one matrix product.
        return BACKGROUND_SPREAD**2 * float(weights.sum()), EXCESS_SPREAD**2 * (along * weights) @ across.T

    def _correlation(self, first: FloatArray, second: FloatArray) -> FloatArray:
        return np.exp(-0.5 * ((first[:, None] - second) / self.length) ** 2)

    def _maxima(self, excess: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where the lesions are [m], shape (k, 2), and how strong, shape (k,)."""
        rows, columns = _local_maxima(excess, self.excess_least)
        order = np.argsort(-excess[rows, columns], kind="stable")
        points, strength = np.zeros((0, 2)), []
        for row, column in zip(rows[order], columns[order], strict=True):
            point = np.array([self.axes[0][column], self.axes[1][row]])
            if (np.hypot(*(points - point).T) < DISTANCE_LEAST * self.scale).any():
                continue
            points = np.vstack([points, self._centroid(excess, point)])
            strength.append(excess[row, column])
            if len(strength) == LESIONS_MOST:
                break
        return points, np.array(strength)

    def _squared_distance(self, point: FloatArray) -> FloatArray:
        """From each of the map's points to a point [m^2], shape (g1, g0)."""
        return (self.axes[1][:, None] - point[1]) ** 2 + (self.axes[0] - point[0]) ** 2

    def _centroid(self, excess: FloatArray, point: FloatArray) -> FloatArray:
        """Centroid [m] of the positive excess around a maximum: a grid's point would be half a spacing off."""
        near = self._squared_distance(point) <= (CENTROID_RADIUS * self.scale) ** 2
        weight = np.where(near, np.maximum(excess, 0.0), 0.0)
        total = weight.sum()
        return np.array([weight.sum(axis=0) @ self.axes[0], weight.sum(axis=1) @ self.axes[1]]) / total

    def _outline(self, excess: FloatArray, points: FloatArray, strength: FloatArray) -> NDArray[np.bool_]:
        """Which of the map's points have more than a share of the excess of the lesion that they are nearest to."""
        if len(points) == 0:
            return np.zeros(excess.shape, dtype=bool)
        nearest = np.argmin([self._squared_distance(point) for point in points], axis=0)
        return excess >= OUTLINE_SHARE * strength[nearest]


def _local_maxima(values: FloatArray, least: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of values above `least` that none of the eight neighbours exceeds; the border counts."""
    padded = np.full((values.shape[0] + 2, values.shape[1] + 2), -np.inf)
    padded[1:-1, 1:-1] = values
    # The largest of three rows, then of three columns.
    of_rows = np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:])
    around = np.maximum(np.maximum(of_rows[:, :-2], of_rows[:, 1:-1]), of_rows[:, 2:])
    rows, columns = np.nonzero((values >= around) & (values > least))
    return rows, columns
