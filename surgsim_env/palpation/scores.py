"""Scores of palpation: OSPA, and the figures of a method over many organs with their intervals."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.scene.levels import REFERENCE_TIP

# Episodes that every method is scored on; no training and no tuning uses them.
EVALUATION_SEEDS = range(1_000_000, 1_000_100)
# OSPA's cutoff [m] for a tip of REFERENCE_TIP: a lesion missed, or one too many, counts as one at this distance. It
# scales with the tip's radius, as the lesions that a scene hides do.
CUTOFF = 0.020
# A lesion is found where an estimate is within this share of the cutoff: 10 mm for a tip of REFERENCE_TIP.
FOUND_SHARE = 0.5
# The line that a method's median error must cross [m].
ERROR_LINE = 0.005
# Draws of the bootstrap and the percentiles of its interval [%].
RESAMPLES = 2000
INTERVAL = (2.5, 97.5)


def ospa_cutoff(tip_radius: float) -> float:
    """The benchmark's cutoff for a tip's radius [m]."""
    return CUTOFF * tip_radius / REFERENCE_TIP


def ospa(truth: FloatArray, estimate: FloatArray, cutoff: float) -> float:
    """Optimal subpattern assignment of order 1 [m] (Schuhmacher, Vo & Vo 2008, eq. 1).

    With m <= n points: (min over assignments of the sum of min(distance, c) + c (n - m)) / n; 0 where both are empty.

    Args:
        truth: true places [m], shape (m, d).
        estimate: estimated places [m], shape (k, d).
        cutoff: c, the largest that a distance counts and what each point without a partner costs [m].
    """
    larger = max(len(truth), len(estimate))
    if larger == 0:
        return 0.0
    distance = np.minimum(matched_distances(truth, estimate, cutoff)[2], cutoff)
    return float(distance.sum() + cutoff * (larger - len(distance))) / larger


def matched_distances(
    truth: FloatArray, estimate: FloatArray, cutoff: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Indices of true and estimated places as OSPA matches them, one to one, and distances [m], each (min(m, k),)."""
    from scipy.optimize import linear_sum_assignment

    distance = np.sqrt(np.square(np.asarray(truth)[:, None] - np.asarray(estimate)).sum(axis=2))
    rows, columns = linear_sum_assignment(np.minimum(distance, cutoff))
    return rows, columns, distance[rows, columns]


@dataclass(frozen=True, eq=False)
class MapScore:
    """A map of stiffness beside the truth, at the points where both are known.

    Fields:
        excess: estimated excess of the log contrast at the sites of the chart's grid                   (n_site,)
        lesion: whether a site lies over a lesion                                                       (n_site,)
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
    """One episode, as scored.

    Fields:
        truth: points of the surface nearest to the lesions' centres [m]                                (m, 3)
        estimates: estimated places on the surface after each press [m]                                 n x (k, 3)
        cutoff: of OSPA [m]
        force, force_peak: of each press, held and largest [N]                                          (n,)
        impulse: integral of the contact force over all presses [N s]
        seconds: simulated and counted time [s]
        path_length: of the tip [m]
        soft_force: the soft limit [N]
        hard_limit: whether a press passed the hard limit
        fault: of the simulation, or ""
        map: the last estimate as a map; None for a method that estimates places alone
    """

    truth: FloatArray
    estimates: Sequence[FloatArray]
    cutoff: float
    force: FloatArray
    force_peak: FloatArray
    impulse: float
    seconds: float
    path_length: float
    soft_force: float
    hard_limit: bool
    fault: str
    map: MapScore | None


@dataclass(frozen=True)
class ScoreEstimate:
    """A score and its bootstrap interval; None where it is undefined, infinity for a line never reached."""

    value: float | None
    low: float | None
    high: float | None


def score(records: Sequence[PalpationRecord], budget: int, rng: np.random.Generator) -> dict[str, ScoreEstimate]:
    """All figures of a method over its episodes, each with its interval over organs (Efron 1979, percentiles).

    Errors are in mm. `presses_to_median` and `presses_to_p90` are over organs with at least one lesion, as recall,
    centroid error, outline and map are; `precision` over those with an estimate.
    """
    errors = np.array([press_errors(record, budget) for record in records])
    columns = {"error_mm": errors[:, -1] * 1000.0, "error_of_presses_mm": errors.mean(axis=1) * 1000.0}
    columns |= {name: np.array([of(record) for record in records]) for name, of in EPISODE_FIGURES.items()}
    table = np.array(list(columns.values()))
    has_lesion = np.array([len(record.truth) > 0 for record in records])

    def figures(chosen: NDArray[np.intp]) -> dict[str, float]:
        found = dict(zip(columns, _means(table[:, chosen]).tolist(), strict=True))
        with_lesion = errors[chosen[has_lesion[chosen]]]
        for name, percentile in (("presses_to_median", 50.0), ("presses_to_p90", 90.0)):
            found[name] = presses_to_line(with_lesion, percentile) if len(with_lesion) else math.nan
        found["error_median_mm"] = float(np.median(with_lesion[:, -1])) * 1000.0 if len(with_lesion) else math.nan
        return found

    whole = figures(np.arange(len(records)))
    draws = [figures(rng.integers(len(records), size=len(records))) for _ in range(RESAMPLES)]
    return {
        name: figure_with_interval(value, np.array([draw[name] for draw in draws])) for name, value in whole.items()
    }


def with_intervals(columns: Mapping[str, FloatArray], rng: np.random.Generator) -> dict[str, ScoreEstimate]:
    """Means over episodes, with intervals, of one number per episode (n,), NaN where it is undefined."""
    table = np.array(list(columns.values()))
    count = table.shape[1]
    draws = np.array([_means(table[:, rng.integers(count, size=count)]) for _ in range(RESAMPLES)])
    means = _means(table).tolist()
    return {name: figure_with_interval(mean, draw) for name, mean, draw in zip(columns, means, draws.T, strict=True)}


def press_errors(record: PalpationRecord, budget: int) -> FloatArray:
    """OSPA [m] after each press of a budget, shape (budget,); an episode that ended early keeps its last one."""
    errors = [ospa(record.truth, estimate, record.cutoff) for estimate in record.estimates]
    return np.array(errors + [errors[-1]] * (budget - len(errors)))


def presses_to_line(errors: FloatArray, percentile: float) -> float:
    """Presses until a percentile of the errors over organs is and stays at most ERROR_LINE; infinity if it never is.

    Args:
        errors: after each press [m], shape (n_organ, n_press).
        percentile: 50 for the median, 90 for the bad cases.
    """
    above = np.flatnonzero(np.percentile(errors, percentile, axis=0) > ERROR_LINE)
    if len(above) == 0:
        return 1.0
    return float(above[-1] + 2) if above[-1] + 1 < errors.shape[1] else math.inf


def _means(values: FloatArray) -> FloatArray:
    """Means along the last axis over the entries that are not NaN; NaN where there is none."""
    defined = ~np.isnan(values)
    count = defined.sum(axis=-1)
    total = np.where(defined, values, 0.0).sum(axis=-1)
    return np.divide(total, count, out=np.full(count.shape, math.nan), where=count > 0)


def figure_with_interval(value: float, draws: FloatArray) -> ScoreEstimate:
    """A figure with its interval from draws of it (n,); undefined draws, NaN, are left out."""
    defined = np.sort(draws[~np.isnan(draws)])
    if math.isnan(value) or len(defined) == 0:
        return ScoreEstimate(None, None, None)
    # The nearest draw: there is no interpolation between a number and infinity.
    low, high = (float(np.percentile(defined, one, method="nearest")) for one in INTERVAL)
    return ScoreEstimate(value, low, high)


def _matched(record: PalpationRecord) -> FloatArray:
    """Distances [m] between lesions and the last estimates that found them."""
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


# One number per episode, NaN where it is undefined; a method's figure is their mean.
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
    "soft_force_share": lambda record: float((record.force_peak > record.soft_force).mean()),
    "impulse": lambda record: record.impulse,
    "seconds": lambda record: record.seconds,
    "path_length": lambda record: record.path_length,
    "hard_limit_share": lambda record: float(record.hard_limit),
    "fault_share": lambda record: float(bool(record.fault)),
}
