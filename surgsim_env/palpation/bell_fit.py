"""Fit of a bell-shaped excess of contrast to touches on a map of sites: the place of a single lesion."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import exp, matmul, solve
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.palpation.chart import MAP_SIDE, TouchMap

# Width of the bell, its standard deviation, over the lesion's felt radius (`touches.felt_lesion_radius`):
# that of contrast over lesions of the blocks is 0.56 to 0.98.
BELL_WIDTH = 0.7
# Prior standard deviations of contrast: the mean, the other terms of the background, the bell's height, and the
# model's error at a site beside the sensor's noise.
MEAN_SPREAD, BACKGROUND_SPREAD, BELL_SPREAD, MODEL_ERROR = 10.0, 0.1, 0.3, 0.05


class FittedBell(NamedTuple):
    """Best bell of each of n records of touches.

    Fields:
        site: index in `BellFit.sites` of the site nearest to its middle, -1 if no bell improves the fit      (n,)
        place: its middle, between sites, on the chart; 0 without a bell                                       (n, 2)
    """

    site: NDArray[np.intp]
    place: FloatArray


class BellFit:
    """Least-squares fit of background and bell to the contrasts of a touch map.

    The contrast at site i with readings of noise s and sum of squares q_i (`TouchMemory`) is modelled as

        c_i = sum_k b_k p_k(u_i, v_i) + h exp(-|x_i - x|^2 / (2 w^2)),   variance s^2 / q_i + MODEL_ERROR^2,

    with p_k the six monomials up to the second power in the chart's coordinates; their coefficients and the height h
    have normal priors. For each middle x the fit is linear; the best one has the largest decrease of the sum of squares
    with h > 0, among the sites with a reading or next to one, and a parabola through its neighbours places it between
    sites. The background models the drop of contrast near the rim, which would bias a plain argmax.

    Fields:
        sites: numbers of the sites in the rows and columns that have a pressable one, row by row    (n_site,)
        places: of these sites on the chart                                                          (n_site, 2)
    """

    def __init__(self, touch_map: TouchMap, lesion_radius: float, noise: float) -> None:
        """Prepare the fit on a map.

        Args:
            touch_map: the sites.
            lesion_radius: mean felt radius of the lesions [m].
            noise: standard deviation of a reading of force [N].
        """
        rows, columns = (slice(numbers[0], numbers[-1] + 1) for numbers in touch_map.rows_and_columns)
        self._part = (..., rows, columns)
        numbers = np.arange(MAP_SIDE * MAP_SIDE).reshape(MAP_SIDE, MAP_SIDE)
        self.sites = numbers[rows, columns].ravel()
        self.places = touch_map.places[self.sites]
        self._noise, self._extent = noise, touch_map.extent
        first, second = touch_map.axes
        self._axes = second[rows], first[columns]
        self._pressable = touch_map.pressable.reshape(MAP_SIDE, MAP_SIDE)[rows, columns]
        width = BELL_WIDTH * lesion_radius
        self._bells = [exp(-0.5 * np.square((axis[:, None] - axis) / width)) for axis in self._axes]
        v, u = np.meshgrid(
            *(2.0 * axis / side - 1.0 for axis, side in zip(self._axes, self._extent[::-1], strict=True)), indexing="ij"
        )
        self._terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v])
        spread = np.array([MEAN_SPREAD, *[BACKGROUND_SPREAD] * (len(self._terms) - 1)])
        self._prior = np.diag(1.0 / (spread * spread))

    def cropped(self, values: FloatArray) -> FloatArray:
        """Values (..., MAP_SIDE**2) of the map at `sites`, (..., row, column)."""
        return values.reshape(*values.shape[:-1], MAP_SIDE, MAP_SIDE)[self._part]

    def best(self, product: FloatArray, square: FloatArray) -> FittedBell:
        """Best bells of n records, from their cropped sums of readings (`TouchMemory`)."""
        score = self._score(product, square)
        flat = score.reshape(len(score), -1)
        best = flat.argmax(axis=1)
        records = np.arange(len(score))
        has_bell = flat[records, best] > 0.0
        row, column = np.divmod(best, score.shape[2])
        around = framed(score, -np.inf)
        middle = around[records, row + 1, column + 1]
        sites = [
            _between(
                self._axes[1], column, around[records, row + 1, column], middle, around[records, row + 1, column + 2]
            ),
            _between(
                self._axes[0], row, around[records, row, column + 1], middle, around[records, row + 2, column + 1]
            ),
        ]
        place = np.where(has_bell[:, None], 2.0 * np.column_stack(sites) / self._extent - 1.0, 0.0)
        return FittedBell(np.where(has_bell, best, -1), place)

    def _score(self, product: FloatArray, square: FloatArray) -> FloatArray:
        """Decrease of the sum of squares by a bell at each site, (n, row, column); -inf for sites without a bell."""
        felt, terms = square > 0.0, self._terms.reshape(len(self._terms), -1)
        weight = np.where(felt, square / (np.square(self._noise) + square * (MODEL_ERROR * MODEL_ERROR)), 0.0)
        weighted = weight * ratio(product, square)
        flat, count = weight.reshape(len(weight), 1, -1), len(weight)
        normal = matmul(terms * flat, terms.T) + self._prior
        background = solve(normal, matmul(weighted.reshape(count, -1), terms.T)[..., None])
        # Of bells at all sites: product with the background's terms, with the residual, and with themselves.
        across = self._with_bells(weight[:, None] * self._terms).reshape(count, len(terms), -1)
        residual = self._with_bells(weighted).reshape(count, -1) - (across * background).sum(axis=1)
        own = self._with_bells(weight, power=2).reshape(count, -1)
        own = own - (across * solve(normal, across)).sum(axis=1) + 1.0 / (BELL_SPREAD * BELL_SPREAD)
        score = (np.square(np.maximum(residual, 0.0)) / own).reshape(felt.shape)
        return np.where(_bordering(felt) & self._pressable, score, -np.inf)

    def _with_bells(self, values: FloatArray, power: int = 1) -> FloatArray:
        """Sums of values (..., row, column) times a power of the bell around each site."""
        along, across = (bell if power == 1 else bell * bell for bell in self._bells)
        return matmul(matmul(along, values), across)


def framed(values: np.ndarray, fill: float) -> np.ndarray:
    """Values (n, row, column) with a border of a row or column on each side, filled with a number."""
    count, rows, columns = values.shape
    larger = np.full((count, rows + 2, columns + 2), fill, dtype=values.dtype)
    larger[:, 1:-1, 1:-1] = values
    return larger


def ratio(product: FloatArray, square: FloatArray) -> FloatArray:
    """Contrasts from the sums of readings of a record (`TouchMemory`); 0 without a reading."""
    return np.divide(product, square, out=np.zeros_like(product), where=square > 0.0)


def _bordering(felt: np.ndarray) -> np.ndarray:
    """True for sites with a reading, or a neighbour with one, shape (n, row, column)."""
    larger = framed(felt, False)
    rows = larger[:, :-2] | larger[:, 1:-1] | larger[:, 2:]
    return rows[:, :, :-2] | rows[:, :, 1:-1] | rows[:, :, 2:]


def _between(
    axis: FloatArray, number: np.ndarray, before: FloatArray, middle: FloatArray, after: FloatArray
) -> FloatArray:
    """Top (n,) of the parabolas through three neighbouring values; the middle site without a neighbour."""
    inside = np.isfinite(before) & np.isfinite(after)
    before, middle, after = (np.where(inside, values, 0.0) for values in (before, middle, after))
    bend = 2.0 * middle - before - after
    # The middle value is the largest, so the step is at most a half.
    step = np.divide(0.5 * (after - before), bend, out=np.zeros_like(bend), where=bend > 0.0)
    ahead, behind = np.minimum(number + 1, len(axis) - 1), np.maximum(number - 1, 0)
    return axis[number] + step * 0.5 * (axis[ahead] - axis[behind])
