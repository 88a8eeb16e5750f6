"""Errors of estimated lesions: OSPA of their places, Dice of their areas."""

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.scene.levels import REFERENCE_TIP

# OSPA's cutoff [m] for a tip of REFERENCE_TIP, the cost of a missed lesion and of a spurious one. It scales with the
# tip's radius, as hidden lesions do.
CUTOFF = 0.020
# An estimate finds a lesion within this share of the cutoff: 10 mm for a tip of REFERENCE_TIP.
FOUND_SHARE = 0.5


def ospa_cutoff(tip_radius: float) -> float:
    """Cutoff of the benchmark for a tip's radius [m]."""
    return CUTOFF * tip_radius / REFERENCE_TIP


def ospa(truth: FloatArray, estimate: FloatArray, cutoff: float) -> float:
    """Optimal subpattern assignment of order 1 [m] (Schuhmacher, Vo & Vo 2008, eq. 1).

    With m <= n points: (min over assignments of the sum of min(distance, c) + c (n - m)) / n; 0 where both are empty.

    Args:
        truth: true places [m], shape (m, d).
        estimate: estimated places [m], shape (k, d).
        cutoff: c, the largest counted distance and the cost of each point without a partner [m].
    """
    larger = max(len(truth), len(estimate))
    if larger == 0:
        return 0.0
    distance = np.minimum(matched_distances(truth, estimate, cutoff)[2], cutoff)
    return float(distance.sum() + cutoff * (larger - len(distance))) / larger


def dice(truth: NDArray[np.bool_], estimate: NDArray[np.bool_]) -> float:
    """Coefficient of two masks (n,), 2 |A and B| / (|A| + |B|) (Dice 1945); 1 where both are empty."""
    total = int(truth.sum() + estimate.sum())
    return 2.0 * float((truth & estimate).sum()) / total if total else 1.0


def map_errors(sites: FloatArray, truth: FloatArray, declared: FloatArray, cutoff: float) -> tuple[float, float]:
    """OSPA of the places [m] and Dice of the discs of declared lesions.

    Args:
        sites: points whose number in a disc measures its area [m], shape (n, 2).
        truth: places and radii of the lesions [m], shape (m, 3).
        declared: those of the declared ones [m], shape (k, 3).
        cutoff: of OSPA [m].
    """
    squared = [np.square(sites[:, None] - lesions[:, :2]).sum(axis=2) for lesions in (truth, declared)]
    hidden, drawn = (
        (away <= lesions[:, 2] * lesions[:, 2]).any(axis=1)
        for away, lesions in zip(squared, (truth, declared), strict=True)
    )
    return ospa(truth[:, :2], declared[:, :2], cutoff), dice(hidden, drawn)


def map_score(error: float, overlap: float, cutoff: float) -> float:
    """Score of a declared map, (1 - OSPA / cutoff + Dice) / 2, from 0 to 1."""
    return 0.5 * (1.0 - error / cutoff + overlap)


def matched_distances(
    truth: FloatArray, estimate: FloatArray, cutoff: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Indices of matched true and estimated places (OSPA, one to one), and their distances [m], each (min(m, k),)."""
    from scipy.optimize import linear_sum_assignment

    distance = np.sqrt(np.square(np.asarray(truth)[:, None] - np.asarray(estimate)).sum(axis=2))
    rows, columns = linear_sum_assignment(np.minimum(distance, cutoff))
    return rows, columns, distance[rows, columns]
