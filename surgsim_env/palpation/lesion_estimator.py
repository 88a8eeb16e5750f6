"""Lesions estimated from presses on a chart: the Gaussian process of the contrast, and the benchmark's estimator."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.arithmetic import exp, matmul, solve
from msdm_core.mesh.tet_mesh import FloatArray

# The numbers below hold for lesions of 8 mm, the mean of those in `phantom`; lengths scale with the lesions'
# radius, as the bell curves of their contrast do. They were chosen on organs outside all evaluations, for the smallest
# mean error over random presses (docs/palpation.md).
REFERENCE_LESION_RADIUS = 0.008
# Prior standard deviation of the background's log contrast, one number for the organ: moduli of +-30 % and a capsule.
BACKGROUND_SPREAD = 0.25
# Prior of the lesions' excess: standard deviation, and correlation length [m]. A press over a lesion measures a
# bell curve of spread s = 7 mm, and a sum of such curves at random places has the correlation length sqrt(2) s.
EXCESS_SPREAD = 0.225
EXCESS_LENGTH = 0.010
# Deviation of healthy presses beside the sensor's noise: a capsule absent from the map, the mesh.
MODEL_SPREAD = 0.05
# Deviation of the gradient of healthy presses about the map of a curved organ [1/m]: the mesh moves the centre of
# pressure within a cell. On `liver_family` 12, for lesions of 8 mm; a little more keeps errors of neighbouring presses,
# which are alike, from adding up to false lesions.
ORGAN_GRADIENT_SPREAD = 15.0
# Deviation of the gradient by taxels beside their noise [1/m]: bells that are not the process', the mesh.
GRADIENT_SPREAD = 14.0
# Deviation of healthy presses about the map of a curved organ: capsules and moduli absent from the map show where the
# tissue is thinner, and a member's map has errors. On the training split of `liver_family` 0.009 to 0.032; more
# costs nothing there, less adds false lesions (docs/palpation.md). On blocks, with flat faces, 0.007 to 0.016,
# within EXCESS_LEAST.
ORGAN_MAP_SPREAD = 0.035
# A lesion is a maximum of the excess above the first of these plus the second times the sensor's noise plus the third
# times the map's deviation,
EXCESS_LEAST, EXCESS_LEAST_NOISE, EXCESS_LEAST_MAP = 0.07, 0.75, 2.0
# with gradients this more,
EXCESS_LEAST_GRADIENT = 0.03
# at least this far [m] from a stronger one,
DISTANCE_LEAST = 0.012
# placed at the centroid of the excess within this [m] of it,
CENTROID_RADIUS = 0.009
# with an outline where the excess is above this share of its maximum.
OUTLINE_SHARE = 0.6
LESIONS_MOST = 3
# Distance between the points of the excess map [m].
MAP_SPACING = 0.002


@dataclass(frozen=True, eq=False)
class ContrastProcess:
    """Gaussian process regression with fixed hyperparameters (Rasmussen & Williams 2006, eq. 2.25 and 2.26).

    log contrast at x = b + e(x) + noise, b ~ N(0, sb^2), e ~ GP(0, se^2 exp(-|x - x'|^2 / (2 l^2))): b is common to all
    sites (modulus, capsule, the sensor's bias), e the excess over it. With taxels a press also measures
    grad e + noise, whose covariances are the derivatives of e's (section 9.4).

    Args:
        axes: coordinates of a grid's columns and rows along the chart's sides [m], shapes (g0,) and (g1,)
        length: correlation length l of the excess [m]
        noise_variance: of one press
        gradient_variance: of the gradient's noise along each side [1/m^2]; 0 without taxels
    """

    axes: tuple[FloatArray, FloatArray]
    length: float
    noise_variance: float
    gradient_variance: float = 0.0

    def mean(
        self, places: FloatArray, values: FloatArray, gradients: FloatArray | None = None
    ) -> tuple[float, FloatArray]:
        """Posterior means of the background, and of the excess at the grid's points (g1, g0).

        Args:
            places: of the presses [m], shape (n, 2).
            values: their log contrast, shape (n,).
            gradients: of the log contrast along the chart's sides [1/m], shape (n, 2); read with taxels.
        """
        if len(values) == 0:
            return 0.0, np.zeros((len(self.axes[1]), len(self.axes[0])))
        measured = values
        if self.gradient_variance:
            assert gradients is not None
            measured = np.concatenate([values, gradients.T.ravel()])
        weights = solve(self._covariance(places), measured).reshape(-1, len(places))
        # The covariance is a product over the axes: the map is a matrix product for each derivative.
        grid = self._to_grid(places)
        parts = [matmul(along * part, across.T) for (along, across), part in zip(grid, weights, strict=True)]
        background = BACKGROUND_SPREAD * BACKGROUND_SPREAD * float(weights[0].sum())
        return background, EXCESS_SPREAD * EXCESS_SPREAD * np.sum(parts, axis=0)

    def spread(self, places: FloatArray) -> FloatArray:
        """Posterior standard deviation of the excess at the grid's points (g1, g0), given presses at places (n, 2)."""
        shape = (len(self.axes[1]), len(self.axes[0]))
        if len(places) == 0:
            return np.full(shape, EXCESS_SPREAD)
        parts = [along[:, None] * across for along, across in self._to_grid(places)]
        between = EXCESS_SPREAD * EXCESS_SPREAD * np.concatenate(parts, axis=2).reshape(-1, len(places) * len(parts))
        explained = solve(self._covariance(places), between.T).T
        variance = EXCESS_SPREAD * EXCESS_SPREAD - (explained * between).sum(axis=1)
        return np.sqrt(np.maximum(variance, 0.0)).reshape(shape)

    def variance_reduction(self, places: FloatArray, points: FloatArray) -> FloatArray:
        """Decrease of the excess' variance, summed over points, by a further press at each of them, shape (k,).

        sum over x' of cov(e(x'), y(x))^2 / var(y(x)), given the presses (Cohn 1996; Seo et al. 2000); of the further
        press the log contrast alone counts.

        Args:
            places: of the presses [m], shape (n, 2).
            points: on the chart [m], shape (k, 2).
        """
        prior, count = self.excess_covariance(points, points)[: len(points), : len(points)], len(places)
        variance = EXCESS_SPREAD * EXCESS_SPREAD + BACKGROUND_SPREAD * BACKGROUND_SPREAD + self.noise_variance
        between = self.excess_covariance(points, places)[: len(points)]
        felt = between + BACKGROUND_SPREAD * BACKGROUND_SPREAD * (np.arange(between.shape[1]) < count)
        weights = solve(self._covariance(places), felt.T) if count else felt.T
        left = variance - (felt * weights.T).sum(axis=1)
        return np.square(prior - matmul(between, weights)).sum(axis=0) / left

    @property
    def _derivatives(self) -> tuple[tuple[int, int], ...]:
        """Orders of the measured derivatives along the chart's first and second axis."""
        return ((0, 0), (1, 0), (0, 1)) if self.gradient_variance else ((0, 0),)

    def _to_grid(self, places: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Factors of the correlation of each measured derivative with rows (g1, n) and with columns (g0, n)."""
        columns, rows = (self._factors(axis, places[:, i]) for i, axis in enumerate(self.axes))
        return [(rows[0, second], columns[0, first]) for first, second in self._derivatives]

    def excess_covariance(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Covariance of the excess, and of its gradient if measured, at places [m] (n, 2) and (m, 2).

        Shape (n, m), or (3 n, 3 m): of the excess and its derivatives along the first and the second axis.
        """
        columns, rows = (self._factors(first[:, i], second[:, i]) for i in range(2))
        orders = self._derivatives
        blocks = [[columns[i, k] * rows[j, m] for k, m in orders] for i, j in orders]
        return EXCESS_SPREAD * EXCESS_SPREAD * np.block(blocks)

    def _covariance(self, places: FloatArray) -> FloatArray:
        """Covariance of the measured log contrasts and gradients, (n, n) or (3 n, 3 n)."""
        count, covariance = len(places), self.excess_covariance(places, places)
        covariance[:count, :count] += BACKGROUND_SPREAD * BACKGROUND_SPREAD
        diagonal = covariance.ravel()[:: len(covariance) + 1]
        diagonal[:count] += self.noise_variance
        diagonal[count:] += self.gradient_variance
        return covariance

    def _factors(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Correlation along one axis between coordinates (n,) and (m,), and its derivatives, (2, 2, n, m).

        The first index is the order of the derivative by the first coordinate, the second that by the second.
        """
        step = (first[:, None] - second) / self.length
        value = exp(-0.5 * np.square(step))
        slope = value * step / self.length
        return np.array([[value, slope], [-slope, value * (1.0 - step * step) / (self.length * self.length)]])


def contrast_process(
    axes: tuple[FloatArray, FloatArray],
    *,
    lesion_radius: float,
    noise: float,
    length_share: float = 1.0,
    gradient_noise: float = 0.0,
) -> ContrastProcess:
    """Process for lesions of a radius [m] and a sensor's standard deviation of one log contrast.

    Args:
        axes: see `ContrastProcess`.
        lesion_radius: mean radius of the lesions [m].
        noise: standard deviation of one log contrast by the force sensor.
        length_share: factor on the correlation length.
        gradient_noise: standard deviation of the gradient of one press by the taxels [1/m]; 0 without taxels.
    """
    scale = lesion_radius / REFERENCE_LESION_RADIUS
    spread = GRADIENT_SPREAD / scale if gradient_noise else 0.0
    return ContrastProcess(
        axes,
        length_share * (EXCESS_LENGTH * scale),
        noise * noise + MODEL_SPREAD * MODEL_SPREAD,
        gradient_noise * gradient_noise + spread * spread,
    )


@dataclass(frozen=True, eq=False)
class LesionEstimate:
    """Lesions estimated from presses.

    Fields:
        points: places of the lesions on the chart [m], the strongest first                             (k, 2)
        strength: largest excess of the log contrast over each                                          (k,)
        background: log contrast of the tissue around them
        excess: of the log contrast by lesions, at the map's points, rows along the second axis         (g1, g0)
        outline: True for the map's points over a lesion                                                (g1, g0)
        axes: the map's coordinates along the chart's first and second axis [m]                         (g0,), (g1,)
    """

    points: FloatArray
    strength: FloatArray
    background: float
    excess: FloatArray
    outline: NDArray[np.bool_]
    axes: tuple[FloatArray, FloatArray]


class LesionEstimator:
    """Lesions as the maxima of the posterior mean excess of a Gaussian process (`ContrastProcess`).

    Args:
        extent: of the chart, with coordinates from 0 on [m], shape (2,).
        lesion_radius: mean radius of the lesions [m]; the model's lengths scale with it.
        noise: standard deviation of one log contrast by the sensor: its noise over the force of a healthy press.
        map_spread: standard deviation of the log contrast of healthy presses about the map, 0 on a block.
        gradient_noise: standard deviation of the gradient of one press by the taxels [1/m]; 0 without taxels.
    """

    def __init__(
        self,
        extent: ArrayLike,
        *,
        lesion_radius: float,
        noise: float,
        map_spread: float = 0.0,
        gradient_noise: float = 0.0,
    ) -> None:
        self.extent = np.asarray(extent, dtype=np.float64)
        self.lesion_radius, self.noise, self.gradient_noise = lesion_radius, noise, gradient_noise
        self.scale = lesion_radius / REFERENCE_LESION_RADIUS
        self.excess_least = EXCESS_LEAST + EXCESS_LEAST_NOISE * noise + EXCESS_LEAST_MAP * map_spread
        if gradient_noise:
            self.excess_least += EXCESS_LEAST_GRADIENT
        # Coordinates of the map's points along each axis [m], from edge to edge.
        spacing = MAP_SPACING * self.scale
        first, second = (np.linspace(0.0, side, max(2, round(side / spacing) + 1)) for side in self.extent)
        self.axes = (first, second)
        self.process = contrast_process(
            self.axes, lesion_radius=lesion_radius, noise=noise, gradient_noise=gradient_noise
        )

    def estimate(
        self, places: ArrayLike, log_contrast: ArrayLike, gradients: FloatArray | None = None
    ) -> LesionEstimate:
        """Estimate lesions from presses; none without a press.

        Args:
            places: of the presses on the chart [m], shape (n, 2).
            log_contrast: log of stiffness over healthy stiffness, shape (n,).
            gradients: of the log contrast along the chart's sides [1/m], shape (n, 2); read with taxels.
        """
        places = np.asarray(places, dtype=np.float64).reshape(-1, 2)
        values = np.asarray(log_contrast, dtype=np.float64)
        background, excess = self.process.mean(places, values, gradients)
        points, strength = self._maxima(excess)
        return LesionEstimate(points, strength, background, excess, self._outline(excess, points, strength), self.axes)

    def _maxima(self, excess: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places of the lesions [m], shape (k, 2), and their strength, shape (k,)."""
        rows, columns = _local_maxima(excess, self.excess_least)
        peaks = np.column_stack([self.axes[0][columns], self.axes[1][rows]])
        chosen, points = strongest_apart(
            excess[rows, columns],
            peaks,
            DISTANCE_LEAST * self.scale,
            place=lambda index: self._centroid(excess, peaks[index]),
        )
        return points[:LESIONS_MOST], excess[rows, columns][chosen[:LESIONS_MOST]]

    def _squared_distance(self, point: FloatArray) -> FloatArray:
        """Squared distance of the map's points from a point [m^2], shape (g1, g0)."""
        return np.square(self.axes[1][:, None] - point[1]) + np.square(self.axes[0] - point[0])

    def _centroid(self, excess: FloatArray, point: FloatArray) -> FloatArray:
        """Centroid [m] of the positive excess around a maximum, finer than the grid's spacing."""
        near = self._squared_distance(point) <= (CENTROID_RADIUS * self.scale) * (CENTROID_RADIUS * self.scale)
        weight = np.where(near, np.maximum(excess, 0.0), 0.0)
        total = weight.sum()
        return np.array([matmul(weight.sum(axis=0), self.axes[0]), matmul(weight.sum(axis=1), self.axes[1])]) / total

    def _outline(self, excess: FloatArray, points: FloatArray, strength: FloatArray) -> NDArray[np.bool_]:
        """True for the map's points with more than OUTLINE_SHARE of the nearest lesion's excess."""
        if len(points) == 0:
            return np.zeros(excess.shape, dtype=bool)
        nearest = np.argmin([self._squared_distance(point) for point in points], axis=0)
        return excess >= OUTLINE_SHARE * strength[nearest]


def strongest_apart(
    height: FloatArray, peaks: FloatArray, distance_least: float, *, place: Callable[[int], FloatArray] | None = None
) -> tuple[list[int], FloatArray]:
    """Choose peaks from the highest down, each at least a distance from the places of those chosen before.

    Args:
        height: of the peaks, shape (n,).
        peaks: their positions [m], shape (n, d).
        distance_least: [m].
        place: maps a peak's index to the point (d,) to keep away from; by default the peak itself.

    Returns:
        Indices of the chosen peaks, the highest first, and their places, shape (k, d).
    """
    chosen: list[int] = []
    places = np.zeros((0, peaks.shape[1]))
    for index in np.argsort(-height, kind="stable").tolist():
        if (np.sqrt(np.square(places - peaks[index]).sum(axis=1)) < distance_least).any():
            continue
        chosen.append(index)
        places = np.vstack([places, peaks[index] if place is None else place(index)])
    return chosen, places


def _local_maxima(values: FloatArray, least: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of values above `least` and not below their eight neighbours, border included."""
    padded = np.full((values.shape[0] + 2, values.shape[1] + 2), -np.inf)
    padded[1:-1, 1:-1] = values
    # The largest of three rows, then of three columns.
    of_rows = np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:])
    around = np.maximum(np.maximum(of_rows[:, :-2], of_rows[:, 1:-1]), of_rows[:, 2:])
    rows, columns = np.nonzero((values >= around) & (values > least))
    return rows, columns
