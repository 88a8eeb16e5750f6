"""OSPA: one distance between a set of true places and a set of estimated ones, wrong counts included."""

import numpy as np
from scipy.optimize import linear_sum_assignment

from msdm_core.mesh import FloatArray

# Cutoff [m] for a tip of 8 mm: a lesion missed, or one too many, counts as one that is so far off. It goes with the
# radius of the tip, as lesions that a scene hides do.
CUTOFF = 0.020
CUTOFF_TIP_RADIUS = 0.008


def ospa_cutoff(tip_radius: float) -> float:
    """The benchmark's cutoff for a tip's radius [m]."""
    return CUTOFF * tip_radius / CUTOFF_TIP_RADIUS


def ospa(truth: FloatArray, estimate: FloatArray, cutoff: float) -> float:
    """Optimal subpattern assignment of order 1 [m] (Schuhmacher, Vo & Vo 2008, eq. 1).

    With m <= n points: (min over assignments of the sum of min(distance, c) + c (n - m)) / n; 0 where both are empty.

    Args:
        truth: true places [m], shape (m, d).
        estimate: estimated places [m], shape (k, d).
        cutoff: c, the largest that a distance counts and what each point without a partner costs [m].

    Raises:
        ValueError: a cutoff that is not above 0.
    """
    if not cutoff > 0.0:
        raise ValueError(f"cutoff is {cutoff:g} m; it must be above 0")
    larger = max(len(truth), len(estimate))
    if larger == 0:
        return 0.0
    distance = np.minimum(matched_distances(truth, estimate, cutoff)[2], cutoff)
    return float(distance.sum() + cutoff * (larger - len(distance))) / larger


def matched_distances(
    truth: FloatArray, estimate: FloatArray, cutoff: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Indices of true and estimated places as OSPA matches them, one to one, and distances [m], each (min(m, k),)."""
    distance = np.sqrt(((np.asarray(truth)[:, None] - np.asarray(estimate)) ** 2).sum(axis=2))
    rows, columns = linear_sum_assignment(np.minimum(distance, cutoff))
    return rows, columns, distance[rows, columns]
