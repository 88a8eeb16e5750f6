"""Contrast maps: stiffness over a healthy baseline at each site, estimated lesions and their errors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from msdm_core.arithmetic import exp, log, lstsq, matmul, norm
from msdm_core.mesh import FloatArray, SurfaceDistance
from surgsim_apps.palpate.truth import Truth
from surgsim_env.palpation import strongest_apart

# Rounds of reweighting: Huber's weights first, for a convex problem, then Tukey's, which reject lesions.
HUBER_ROUNDS = 8
ROUNDS = 30
HUBER_LIMIT = 1.345  # 95 % efficient for normal residuals (Holland & Welsch 1977)
TUKEY_LIMIT = 4.685
# Least sites per coefficient of a baseline; with fewer it is a plane, then the median.
SITES_PER_COEFFICIENT = 3
# Ridge penalty of each coefficient, as a share of its regressor's spread.
RIDGE = 0.03
# Least scale of the residuals [log stiffness]: without noise they vanish.
SMALLEST_SCALE = 1e-3

# A maximum is felt if the smoothed contrast exceeds its surroundings by the floor, and by this many times the
# scatter from site to site. The floor was set by trial on 15 lesions in the shipped and a CT liver, none of
# them pressed by a test; no model map without a lesion came near it.
SCATTERS_ABOVE = 5.0
CONTRAST_FLOOR = 0.17
# Its surroundings: the lower quartile between these distances, in site spacings; lesions only raise contrast.
SURROUNDINGS_SPACINGS = (2.0, 4.5)
FEWEST_SURROUNDING = 4
# In site spacings: width of the smoothing, least distance between two maxima, reach of the centroid around one.
KERNEL_SPACINGS = 0.6
APART_SPACINGS = 2.5
CENTROID_SPACINGS = 1.7
# Sites with less than this share of the peak's excess do not pull at the centroid.
EXCESS_SHARE = 0.25
# Sites farther than radius + HEALTHY_DISTANCE [m] from every lesion count as healthy.
HEALTHY_DISTANCE = 0.015
# Distances are capped at this [m] when estimates are matched with lesions.
MATCHING_REACH = 0.05


@dataclass(frozen=True, eq=False)
class Estimate:
    """An estimated lesion: point [m] (3,), peak contrast, and its excess over the surroundings."""

    point: FloatArray
    contrast: float
    excess: float


@dataclass(frozen=True, eq=False)
class LesionScore:
    """Match of a lesion on a map: index of the estimate or None, error along the surface [m], largest contrast."""

    truth: Truth
    estimate: int | None
    error: float
    contrast: float

    @property
    def felt(self) -> bool:
        """True if the estimate lies within the lesion's radius."""
        return self.error <= self.truth.radius


@dataclass(frozen=True, eq=False)
class ContrastMap:
    """A contrast map with the lesions estimated on it and their errors.

    Fields:
        name: of the baseline.
        contrast: stiffness / baseline at each site                                                 (n_site,)
        estimates: lesions, strongest first
        scores: one for each lesion
        false_alarms: estimates outside every lesion's radius
        healthy_count: sites far from every lesion
        healthy_std: of the contrast over them
        threshold: least excess of a felt maximum over its surroundings, of the smoothed contrast
    """

    name: str
    contrast: FloatArray
    estimates: tuple[Estimate, ...]
    scores: tuple[LesionScore, ...]
    false_alarms: int
    healthy_count: int
    healthy_std: float
    threshold: float

    @property
    def felt_count(self) -> int:
        """Number of lesions felt within their radius."""
        return sum(score.felt for score in self.scores)


def healthy_majority(values: FloatArray) -> tuple[float, float]:
    """Middle and spread of the shortest half of the values (Rousseeuw 1984), the spread as a standard deviation.

    Lesions only raise contrast, and a large one covers many sites, which shifts a median; the densest half is healthy.
    """
    ordered = np.sort(values)
    half = len(ordered) // 2 + 1
    width = ordered[half - 1 :] - ordered[: len(ordered) - half + 1]
    start = int(np.argmin(width))
    # The middle half of normal data is 1.349 standard deviations wide.
    return float(np.median(ordered[start : start + half])), float(width[start]) / 1.349


def robust_spread(values: FloatArray) -> float:
    """1.4826 times the median distance from the median: the standard deviation of normal data, robust to outliers."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def contrast_with_neighbours(
    stiffness: FloatArray, plane: FloatArray, geometry: FloatArray | None = None
) -> FloatArray:
    """Stiffness over a baseline through the healthy majority of the sites, shape (n_site,).

    The baseline is a robust regression of log stiffness on a quadratic in the projection plane and on further
    geometric regressors; lesions are its outliers.

    Args:
        stiffness: above 0 [N/m], shape (n_site,).
        plane: coordinates of the sites across the approach [m], shape (n_site, 2).
        geometry: further regressors such as the reciprocal thickness, shape (n_site, n_regressor).
    """
    log_stiffness = log(stiffness)
    contrast = exp(log_stiffness - _robust_fit(_regressors(plane, geometry), log_stiffness))
    return contrast / healthy_majority(contrast)[0]


def contrast_with_model(stiffness: FloatArray, model_stiffness: FloatArray) -> FloatArray:
    """Stiffness over a pre-operative model's at the same sites, over that ratio's healthy majority, shape (n_site,).

    Dividing by the majority cancels the patient's modulus, unknown to the model.
    """
    ratio = stiffness / model_stiffness
    return ratio / healthy_majority(ratio)[0]


def _regressors(plane: FloatArray, geometry: FloatArray | None) -> FloatArray:
    """Columns of the regression, scaled to order 1; fewer of them where there are few sites, (n_site, n_column)."""
    count = len(plane)
    constant = np.ones((count, 1))
    u, v = ((plane - plane.mean(axis=0)) / max(float(np.ptp(plane, axis=0).max()), 1e-9)).T
    linear = np.column_stack([constant, u, v])
    extra = np.zeros((count, 0)) if geometry is None else geometry
    spread = extra.std(axis=0)
    varying = spread > 1e-12
    extra = (extra[:, varying] - extra[:, varying].mean(axis=0)) / spread[varying]
    full = np.column_stack([linear, u * u, u * v, v * v, extra])
    for columns in (full, full[:, :6], linear):
        if count >= SITES_PER_COEFFICIENT * columns.shape[1]:
            return columns
    return constant


def _robust_fit(columns: FloatArray, values: FloatArray) -> FloatArray:
    """Fitted values of an iteratively reweighted least-squares regression, shape (n_site,)."""
    if columns.shape[1] == 1:
        return np.full(len(values), np.median(values))
    # Ridge on all but the constant, so that the baseline does not bend at the ends of the raster without data.
    held = np.sqrt(RIDGE * len(values)) * np.diag(columns.std(axis=0))
    zeros = np.zeros(len(held))
    weight = np.ones(len(values))
    fitted = values
    for round_ in range(ROUNDS):
        root = np.sqrt(weight)
        matrix = np.concatenate([columns * root[:, None], held])
        coefficients = lstsq(matrix, np.concatenate([values * root, zeros]))
        fitted = matmul(columns, coefficients)
        scaled = np.abs(values - fitted) / max(robust_spread(values - fitted), SMALLEST_SCALE)
        if round_ < HUBER_ROUNDS:
            weight = np.minimum(1.0, HUBER_LIMIT / np.maximum(scaled, HUBER_LIMIT))
        else:
            weight = np.square(np.maximum(1.0 - np.square(scaled / TUKEY_LIMIT), 0.0))
    return fitted


def feel_lesions(sites: FloatArray, contrast: FloatArray, *, spacing: float) -> list[Estimate]:
    """Local maxima of the smoothed contrast above their surroundings, strongest first.

    The contrast is smoothed by a Gaussian; maxima near a stronger one are dropped; each is placed at the centroid of
    the excess contrast around it.

    Args:
        sites: on the surface [m], shape (n_site, 3).
        contrast: shape (n_site,).
        spacing: of the raster [m].
    """
    distance = norm(sites[:, None] - sites[None], axis=2) / spacing
    smooth = smoothed(sites, contrast, spacing=spacing)
    middle = healthy_majority(smooth)[0]
    threshold = felt_threshold(sites, contrast, spacing=spacing)
    near = distance <= CENTROID_SPACINGS
    maxima = np.flatnonzero(smooth >= np.where(near, smooth, -np.inf).max(axis=1))
    excess = np.array([smooth[peak] - _surroundings(smooth, distance[peak], middle) for peak in maxima])
    maxima, excess = maxima[excess > threshold], excess[excess > threshold]
    chosen, _ = strongest_apart(smooth[maxima], sites[maxima], APART_SPACINGS * spacing)
    estimates = []
    for peak, above in zip(maxima[chosen], excess[chosen], strict=True):
        pull = smooth - middle - EXCESS_SHARE * (smooth[peak] - middle)
        weight = np.where(near[peak], np.maximum(pull, 0.0), 0.0)
        point = matmul(weight, sites) / weight.sum() if weight.any() else sites[peak]
        largest = float(contrast[distance[peak] <= 1.0].max())
        estimates.append(Estimate(point=point, contrast=largest, excess=float(above)))
    return estimates


def smoothed(sites: FloatArray, contrast: FloatArray, *, spacing: float) -> FloatArray:
    """The contrast smoothed over the sites by a Gaussian, shape (n_site,); arguments as in `feel_lesions`."""
    distance = norm(sites[:, None] - sites[None], axis=2) / spacing
    kernel = exp(-0.5 * np.square(distance / KERNEL_SPACINGS))
    return matmul(kernel, contrast) / kernel.sum(axis=1)


def felt_threshold(sites: FloatArray, contrast: FloatArray, *, spacing: float) -> float:
    """Least excess of a felt maximum over its surroundings; arguments as in `feel_lesions`."""
    return max(CONTRAST_FLOOR, SCATTERS_ABOVE * robust_spread(contrast - smoothed(sites, contrast, spacing=spacing)))


def _surroundings(smooth: FloatArray, distance: FloatArray, majority: float) -> float:
    """Healthy level around a site; that of the whole map near the end of the raster."""
    low, high = SURROUNDINGS_SPACINGS
    ring = (distance > low) & (distance <= high)
    return float(np.quantile(smooth[ring], 0.25)) if ring.sum() >= FEWEST_SURROUNDING else majority


def score_map(
    name: str,
    sites: FloatArray,
    contrast: FloatArray,
    estimates: Sequence[Estimate],
    truths: Sequence[Truth],
    surface: SurfaceDistance,
    *,
    spacing: float,
) -> ContrastMap:
    """Match estimates to lesions one to one by the least sum of distances along the surface, and measure the map."""
    from scipy.optimize import linear_sum_assignment

    places = np.array([estimate.point for estimate in estimates]).reshape(-1, 3)
    error = np.array([surface(truth.point, places) for truth in truths]).reshape(len(truths), len(places))
    rows, columns = linear_sum_assignment(np.minimum(error, MATCHING_REACH))
    matched = dict(zip(rows.tolist(), columns.tolist(), strict=True))
    from_lesion = [norm(sites - truth.point, axis=1) for truth in truths]
    scores = []
    for index, truth in enumerate(truths):
        over = contrast[from_lesion[index] <= truth.radius]
        column = matched.get(index)
        off = float(error[index, column]) if column is not None else np.inf
        scores.append(LesionScore(truth, column, off, contrast=float(over.max()) if len(over) else np.nan))
    healthy = np.ones(len(sites), dtype=bool)
    for truth, distance in zip(truths, from_lesion, strict=True):
        healthy &= distance > truth.radius + HEALTHY_DISTANCE
    inside = error <= np.array([truth.radius for truth in truths])[:, None]
    return ContrastMap(
        name=name,
        contrast=contrast,
        estimates=tuple(estimates),
        scores=tuple(scores),
        false_alarms=int((~inside.any(axis=0)).sum()) if len(places) else 0,
        healthy_count=int(healthy.sum()),
        healthy_std=float(contrast[healthy].std()) if healthy.any() else np.nan,
        threshold=felt_threshold(sites, contrast, spacing=spacing),
    )
