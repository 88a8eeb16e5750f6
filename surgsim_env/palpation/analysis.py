"""From presses to contrast maps: stiffness against the healthy neighbours, and against a pre-operative model."""

import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.scenes import ForceSensor

# Rounds of reweighting: the first with Huber's weights, which cannot get stuck, then Tukey's, which leave lesions out.
HUBER_ROUNDS = 8
ROUNDS = 30
HUBER_LIMIT = 1.345  # 95 % efficient for normal residuals (Holland & Welsch 1977)
TUKEY_LIMIT = 4.685
# A baseline needs this many sites for each of its coefficients; with fewer it is a plane, then the median.
SITES_PER_COEFFICIENT = 3
# Share of the spread of each regressor that holds its coefficient back (ridge).
RIDGE = 0.03
# A map without noise has no spread; its residuals still need a scale [in log stiffness].
SMALLEST_SCALE = 1e-3


def sensor_readings(
    force: FloatArray, normals: FloatArray, sensor: ForceSensor, rng: np.random.Generator
) -> FloatArray:
    """What the scene's force sensor reads along each normal [N]: force + bias + noise, cut at the range, (n_site,).

    Args:
        force: along the normal [N], shape (n_site,).
        normals: unit outward normals, shape (n_site, 3).
        sensor: its noise is drawn for every reading, its bias once for the whole scan.
        rng: random generator.
    """
    bias = rng.uniform(-sensor.bias, sensor.bias, 3)
    noise = rng.normal(0.0, 1.0, normals.shape) * sensor.noise
    return np.clip(force + (normals * (bias + noise)).sum(axis=1), -sensor.range, sensor.range)


def healthy_majority(values: FloatArray) -> tuple[float, float]:
    """Middle and spread of the shortest half of the values (Rousseeuw 1984), the spread as a standard deviation.

    Lesions push one way and a large one reaches many sites, which shifts a median; the densest half stays healthy.
    """
    if len(values) == 0:
        return 1.0, 0.0
    ordered = np.sort(values)
    half = len(ordered) // 2 + 1
    width = ordered[half - 1 :] - ordered[: len(ordered) - half + 1]
    start = int(np.argmin(width))
    # The middle half of normal data is 1.349 standard deviations wide.
    return float(np.median(ordered[start : start + half])), float(width[start]) / 1.349


def robust_spread(values: FloatArray) -> float:
    """1.4826 times the median distance from the median: the standard deviation of normal data, deaf to outliers."""
    if len(values) == 0:
        return 0.0
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def contrast_with_neighbours(
    stiffness: FloatArray, plane: FloatArray, geometry: FloatArray | None = None
) -> FloatArray:
    """Stiffness over a baseline that follows the healthy majority of the sites, shape (n_site,).

    The baseline is a robust regression of log stiffness on a quadratic in the projection plane and on what else is
    known of each site's geometry; lesions are its outliers.

    Args:
        stiffness: above 0 [N/m], shape (n_site,).
        plane: coordinates of the sites across the approach [m], shape (n_site, 2).
        geometry: further regressors such as the reciprocal thickness, shape (n_site, n_regressor).

    Raises:
        ValueError: names the site whose stiffness is not above 0.
    """
    _check_stiffness(stiffness, "stiffness")
    log_stiffness = np.log(stiffness)
    contrast = np.exp(log_stiffness - _robust_fit(_regressors(plane, geometry), log_stiffness))
    return contrast / healthy_majority(contrast)[0]


def contrast_with_model(stiffness: FloatArray, model_stiffness: FloatArray) -> FloatArray:
    """Stiffness over a pre-operative model's at the same sites, over that ratio's healthy majority, shape (n_site,).

    Dividing by the majority takes out the patient's modulus, which the model does not know.

    Raises:
        ValueError: names the site whose stiffness is not above 0.
    """
    _check_stiffness(stiffness, "stiffness")
    _check_stiffness(model_stiffness, "the model's stiffness")
    ratio = stiffness / model_stiffness
    return ratio / healthy_majority(ratio)[0]


def _check_stiffness(stiffness: FloatArray, what: str) -> None:
    bad = np.flatnonzero(~(np.isfinite(stiffness) & (stiffness > 0.0)))
    if bad.size:
        raise ValueError(
            f"{what} of site {bad[0]} is {stiffness[bad[0]]:g} N/m; it must be above 0: press deeper, or use a sensor "
            "with less bias and noise"
        )


def _regressors(plane: FloatArray, geometry: FloatArray | None) -> FloatArray:
    """Columns of the regression, scaled to order 1; fewer of them where there are few sites, (n_site, n_column)."""
    count = len(plane)
    constant = np.ones((count, 1))
    if count == 0:
        return constant
    u, v = ((plane - plane.mean(axis=0)) / max(float(np.ptp(plane, axis=0).max()), 1e-9)).T
    linear = np.column_stack([constant, u, v])
    extra = np.zeros((count, 0)) if geometry is None else _standardised(geometry)
    full = np.column_stack([linear, u * u, u * v, v * v, extra])
    for columns in (full, full[:, :6], linear):
        if count >= SITES_PER_COEFFICIENT * columns.shape[1]:
            return columns
    return constant


def _standardised(columns: FloatArray) -> FloatArray:
    spread = columns.std(axis=0)
    varying = spread > 1e-12
    return (columns[:, varying] - columns[:, varying].mean(axis=0)) / spread[varying]


def _robust_fit(columns: FloatArray, values: FloatArray) -> FloatArray:
    """Fitted values of an iteratively reweighted least-squares regression, shape (n_site,)."""
    if columns.shape[1] == 1:
        return np.full(len(values), np.median(values)) if len(values) else values
    # Ridge: all but the constant are held back, so that an end of the raster is not bent to where no site says so.
    held = np.sqrt(RIDGE * len(values)) * np.diag(columns.std(axis=0))
    zeros = np.zeros(len(held))
    weight = np.ones(len(values))
    fitted = values
    for round_ in range(ROUNDS):
        root = np.sqrt(weight)
        matrix = np.concatenate([columns * root[:, None], held])
        coefficients = np.linalg.lstsq(matrix, np.concatenate([values * root, zeros]), rcond=None)[0]
        fitted = columns @ coefficients
        scaled = np.abs(values - fitted) / max(robust_spread(values - fitted), SMALLEST_SCALE)
        if round_ < HUBER_ROUNDS:
            weight = np.minimum(1.0, HUBER_LIMIT / np.maximum(scaled, HUBER_LIMIT))
        else:
            weight = np.maximum(1.0 - (scaled / TUKEY_LIMIT) ** 2, 0.0) ** 2
    return fitted
