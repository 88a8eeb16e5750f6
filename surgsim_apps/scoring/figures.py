"""Figures of a method over many episodes, with their bootstrap intervals."""

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
        seconds: simulated and counted time [s]
        hard_limit: True if a press passed the hard limit
        fault: of the simulation, or ""
        map: the last estimate as a map; None for methods with places alone
        member: of a family of organs, or ""
    """

    truth: FloatArray
    estimates: Sequence[FloatArray]
    cutoff: float
    force: FloatArray
    force_peak: FloatArray
    pressure: FloatArray
    strain: FloatArray
    seconds: float
    hard_limit: bool
    fault: str
    map: MapScore | None
    member: str = ""


@dataclass(frozen=True)
class ScoreEstimate:
    """Score and its bootstrap interval; None if undefined, infinity for a line never reached."""

    value: float | None
    low: float | None
    high: float | None


def score(
    columns: Mapping[str, FloatArray],
    members: Sequence[str],
    rng: np.random.Generator,
    errors_mm: Sequence[Sequence[float]] = (),
    lesion_counts: Sequence[int] = (),
) -> dict[str, ScoreEstimate]:
    """Figures of a method over its episodes, each with its bootstrap interval (Efron 1979, percentiles).

    Args:
        columns: by name one number per episode (n,), NaN if undefined; their means are figures.
        members: of a family of organs, one per episode, or empty (`resamples`).
        rng: for the bootstrap.
        errors_mm: OSPA after each press of each episode, (n, n_press), for the figure `presses_to_median`.
        lesion_counts: of each of these episodes, (n,).
    """
    table = np.array(list(columns.values()))

    def figures(sample: NDArray[np.intp]) -> dict[str, float]:
        values = dict(zip(columns, _means(table[:, sample]).tolist(), strict=True))
        if len(errors_mm):
            values["presses_to_median"] = median_presses(errors_mm, lesion_counts, sample)
        return values

    count = table.shape[1]
    whole = figures(np.arange(count))
    draws = [figures(sample) for sample in resamples(count, members, rng)]
    return {
        name: figure_with_interval(value, np.array([draw[name] for draw in draws])) for name, value in whole.items()
    }


def resamples(count: int, members: Sequence[str], rng: np.random.Generator) -> list[NDArray[np.intp]]:
    """Episodes of each draw of the bootstrap, numbers below `count`.

    Episodes of one member of a family are alike: a draw is of members with replacement and takes all episodes of each
    (cluster bootstrap, Field & Welsh 2007, "Bootstrapping clustered data"). Without members, on one organ with lesions
    of its own in each episode, a draw is of episodes.
    """
    names = np.array(members)
    clusters = [np.flatnonzero(names == name) for name in dict.fromkeys(members)] or list(np.arange(count)[:, None])
    draws = rng.integers(len(clusters), size=(RESAMPLES, len(clusters)))
    return [np.concatenate([clusters[number] for number in draw]) for draw in draws]


def episode_columns(records: Sequence[PalpationRecord], budget: int) -> dict[str, FloatArray]:
    """One number per episode (n,) of each figure, NaN if undefined; errors in mm."""
    errors = 1000.0 * np.array([press_errors(record, budget) for record in records])
    columns = {"error_of_presses_mm": errors.mean(axis=1), "error_mm": errors[:, -1]}
    return columns | {name: np.array([of(record) for record in records]) for name, of in EPISODE_FIGURES.items()}


def press_errors(record: PalpationRecord, budget: int) -> FloatArray:
    """OSPA [m] after each press of a budget, shape (budget,); after an early end it stays the last one."""
    errors = [ospa(record.truth, estimate, record.cutoff) for estimate in record.estimates]
    return np.array(errors + [errors[-1]] * (budget - len(errors)))


def median_presses(
    errors_mm: Sequence[Sequence[float]], lesion_counts: Sequence[int], episodes: NDArray[np.intp]
) -> float:
    """Presses until the median error over the episodes with lesions is and stays at most ERROR_LINE.

    Infinity if never, NaN without such an episode.
    """
    counted = episodes[np.asarray(lesion_counts)[episodes] > 0]
    if len(counted) == 0:
        return math.nan
    medians = np.median(np.asarray(errors_mm)[counted], axis=0)
    above = np.flatnonzero(0.001 * medians > ERROR_LINE)
    if len(above) == 0:
        return 1.0
    return float(above[-1] + 2) if above[-1] + 1 < len(medians) else math.inf


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


def _auroc(record: PalpationRecord) -> float:
    if record.map is None or record.map.lesion.all() or not record.map.lesion.any():
        return math.nan
    from sklearn.metrics import roc_auc_score

    return float(roc_auc_score(record.map.lesion, record.map.excess))


# One number per episode, NaN if undefined; a method's figure is their mean.
EPISODE_FIGURES: Mapping[str, Callable[[PalpationRecord], float]] = {
    "centroid_error_mm": lambda record: float(_means(_matched(record))) * 1000.0,
    "recall": lambda record: len(_matched(record)) / len(record.truth) if len(record.truth) else math.nan,
    "precision": lambda record: (
        len(_matched(record)) / len(record.estimates[-1]) if len(record.estimates[-1]) else math.nan
    ),
    "count_right": lambda record: float(len(record.estimates[-1]) == len(record.truth)),
    "outline_iou": _outline_iou,
    "auroc": _auroc,
    "force_mean": lambda record: float(record.force.mean()),
    "force_peak": lambda record: float(record.force_peak.max()),
    "pressure_peak": lambda record: float(record.pressure.max()),
    "strain_peak": lambda record: float(record.strain.max()),
    "seconds": lambda record: record.seconds,
    "hard_limit_share": lambda record: float(record.hard_limit),
    "fault_share": lambda record: float(bool(record.fault)),
}
