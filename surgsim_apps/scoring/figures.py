"""Figures of a method of palpation over many organs, with their bootstrap intervals."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from surgsim_env.palpation import FOUND_SHARE, matched_distances, ospa

# Episodes for the scores of all methods; no training and no tuning uses them.
EVALUATION_SEEDS = range(1_000_000, 1_000_100)
# The line for a method's median error [m].
ERROR_LINE = 0.005
# Draws of the bootstrap and the percentiles of its interval [%].
RESAMPLES = 2000
INTERVAL = (2.5, 97.5)


@dataclass(frozen=True, eq=False)
class MapScore:
    """Map of stiffness beside the truth, at points with both.

    Fields:
        excess: estimated excess of the log contrast at the sites of the chart's grid                   (n_site,)
        lesion: True for sites over a lesion                                                            (n_site,)
        outline, outline_true: points of the estimate's map inside its outline, and inside the true one (g1, g0)
        cell_area: of the surface, per point of the outlines [m^2]
    """

    excess: FloatArray
    lesion: NDArray[np.bool_]
    outline: NDArray[np.bool_]
    outline_true: NDArray[np.bool_]
    cell_area: float


@dataclass(frozen=True, eq=False)
class PalpationRecord:
    """Record of an episode for its score.

    Fields:
        truth: points of the surface nearest to the lesions' centres [m]                                (m, 3)
        estimates: estimated places on the surface after each press [m]                                 n x (k, 3)
        cutoff: of OSPA [m]
        force, force_peak: of each press, held and largest [N]                                          (n,)
        pressure, strain: largest of the tissue at the end of each press [Pa], (1)                      (n,)
        impulse: integral of the contact force over all presses [N s]
        seconds: simulated and counted time [s]
        path_length: of the tip [m]
        soft_force: the soft limit [N]
        hard_limit: True if a press passed the hard limit
        fault: of the simulation, or ""
        map: the last estimate as a map; None for methods with places alone
    """

    truth: FloatArray
    estimates: Sequence[FloatArray]
    cutoff: float
    force: FloatArray
    force_peak: FloatArray
    pressure: FloatArray
    strain: FloatArray
    impulse: float
    seconds: float
    path_length: float
    soft_force: float
    hard_limit: bool
    fault: str
    map: MapScore | None


@dataclass(frozen=True)
class ScoreEstimate:
    """Score and its bootstrap interval; None if undefined, infinity for a line never reached."""

    value: float | None
    low: float | None
    high: float | None


def score(records: Sequence[PalpationRecord], budget: int, rng: np.random.Generator) -> dict[str, ScoreEstimate]:
    """Figures of a method over its episodes, each with its interval over organs (Efron 1979, percentiles).

    Errors are in mm. `presses_to_median`, `presses_to_p90`, recall, centroid error, outline and map are over organs
    with a lesion; `precision` is over those with an estimate.
    """
    errors = np.array([press_errors(record, budget) for record in records])
    columns = {"error_mm": errors[:, -1] * 1000.0, "error_of_presses_mm": errors.mean(axis=1) * 1000.0}
    columns |= {name: np.array([of(record) for record in records]) for name, of in EPISODE_FIGURES.items()}
    table = np.array(list(columns.values()))
    has_lesion = np.array([len(record.truth) > 0 for record in records])

    def figures(sample: NDArray[np.intp]) -> dict[str, float]:
        values = dict(zip(columns, _means(table[:, sample]).tolist(), strict=True))
        with_lesion = errors[sample[has_lesion[sample]]]
        for name, percentile in (("presses_to_median", 50.0), ("presses_to_p90", 90.0)):
            values[name] = presses_to_line(with_lesion, percentile) if len(with_lesion) else math.nan
        values["error_median_mm"] = float(np.median(with_lesion[:, -1])) * 1000.0 if len(with_lesion) else math.nan
        return values

    whole = figures(np.arange(len(records)))
    draws = [figures(rng.integers(len(records), size=len(records))) for _ in range(RESAMPLES)]
    return {
        name: figure_with_interval(value, np.array([draw[name] for draw in draws])) for name, value in whole.items()
    }


def with_intervals(columns: Mapping[str, FloatArray], rng: np.random.Generator) -> dict[str, ScoreEstimate]:
    """Means over episodes, with intervals, of one number per episode (n,), NaN if undefined."""
    table = np.array(list(columns.values()))
    count = table.shape[1]
    draws = np.array([_means(table[:, rng.integers(count, size=count)]) for _ in range(RESAMPLES)])
    means = _means(table).tolist()
    return {name: figure_with_interval(mean, draw) for name, mean, draw in zip(columns, means, draws.T, strict=True)}


def press_errors(record: PalpationRecord, budget: int) -> FloatArray:
    """OSPA [m] after each press of a budget, shape (budget,); after an early end it stays the last one."""
    errors = [ospa(record.truth, estimate, record.cutoff) for estimate in record.estimates]
    return np.array(errors + [errors[-1]] * (budget - len(errors)))


def presses_to_line(errors: FloatArray, percentile: float) -> float:
    """Presses until a percentile of the errors over organs is and stays at most ERROR_LINE; infinity if never.

    Args:
        errors: after each press [m], shape (n_organ, n_press).
        percentile: 50 for the median, 90 for the bad cases.
    """
    above = np.flatnonzero(np.percentile(errors, percentile, axis=0) > ERROR_LINE)
    if len(above) == 0:
        return 1.0
    return float(above[-1] + 2) if above[-1] + 1 < errors.shape[1] else math.inf


def _means(values: FloatArray) -> FloatArray:
    """Means along the last axis over the entries other than NaN; NaN if there is none."""
    defined = ~np.isnan(values)
    count = defined.sum(axis=-1)
    total = np.where(defined, values, 0.0).sum(axis=-1)
    return np.divide(total, count, out=np.full(count.shape, math.nan), where=count > 0)


def figure_with_interval(value: float, draws: FloatArray) -> ScoreEstimate:
    """Figure with its interval from bootstrap draws (n,); undefined draws, NaN, are left out."""
    defined = np.sort(draws[~np.isnan(draws)])
    if math.isnan(value) or len(defined) == 0:
        return ScoreEstimate(None, None, None)
    # The nearest draw: there is no interpolation between a number and infinity.
    low, high = (float(np.percentile(defined, percent, method="nearest")) for percent in INTERVAL)
    return ScoreEstimate(value, low, high)


def _matched(record: PalpationRecord) -> FloatArray:
    """Distances [m] of found lesions from their last estimates."""
    distance = matched_distances(record.truth, record.estimates[-1], record.cutoff)[2]
    return distance[distance <= FOUND_SHARE * record.cutoff]


def _outline_iou(record: PalpationRecord) -> float:
    if record.map is None or not record.map.outline_true.any():
        return math.nan
    union = (record.map.outline | record.map.outline_true).sum()
    return float((record.map.outline & record.map.outline_true).sum() / union)


def _outline_difference_mm2(record: PalpationRecord) -> float:
    if record.map is None:
        return math.nan
    return float((record.map.outline ^ record.map.outline_true).sum()) * record.map.cell_area * 1e6


def _auroc(record: PalpationRecord) -> float:
    if record.map is None or record.map.lesion.all() or not record.map.lesion.any():
        return math.nan
    from sklearn.metrics import roc_auc_score

    return float(roc_auc_score(record.map.lesion, record.map.excess))


def _average_precision(record: PalpationRecord) -> float:
    if record.map is None or not record.map.lesion.any():
        return math.nan
    from sklearn.metrics import average_precision_score

    return float(average_precision_score(record.map.lesion, record.map.excess))


# One number per episode, NaN if undefined; a method's figure is their mean.
EPISODE_FIGURES: Mapping[str, Callable[[PalpationRecord], float]] = {
    "centroid_error_mm": lambda record: float(_means(_matched(record))) * 1000.0,
    "recall": lambda record: len(_matched(record)) / len(record.truth) if len(record.truth) else math.nan,
    "precision": lambda record: (
        len(_matched(record)) / len(record.estimates[-1]) if len(record.estimates[-1]) else math.nan
    ),
    "count_right": lambda record: float(len(record.estimates[-1]) == len(record.truth)),
    "outline_iou": _outline_iou,
    "outline_difference_mm2": _outline_difference_mm2,
    "auroc": _auroc,
    "average_precision": _average_precision,
    "force_mean": lambda record: float(record.force.mean()),
    "force_p95": lambda record: float(np.percentile(record.force_peak, 95.0)),
    "force_peak": lambda record: float(record.force_peak.max()),
    "pressure_peak": lambda record: float(record.pressure.max()),
    "strain_peak": lambda record: float(record.strain.max()),
    "soft_force_share": lambda record: float((record.force_peak > record.soft_force).mean()),
    "impulse": lambda record: record.impulse,
    "seconds": lambda record: record.seconds,
    "path_length": lambda record: record.path_length,
    "hard_limit_share": lambda record: float(record.hard_limit),
    "fault_share": lambda record: float(bool(record.fault)),
}
