"""Where lesions are felt on a contrast map, and how far that is from the truth."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from msdm_core.geodesic import SurfaceDistance
from msdm_core.mesh import FloatArray, TetMesh
from msdm_core.regions import Lesion, lesion_extent
from surgsim_env.palpation.analysis import healthy_majority, robust_spread

# A maximum is felt where the smoothed contrast exceeds its surroundings by the floor, and by this many times the
# scatter from site to site. The floor was set by trial on 15 lesions in the shipped and the CT liver, none of
# them at the places of tests/palpation/places.json; no model map without a lesion came near it.
SCATTERS_ABOVE = 5.0
CONTRAST_FLOOR = 0.17
# Its surroundings: the lower quartile between these distances, in site spacings; lesions only ever push upward.
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
# Beyond this distance [m] it no longer matters which estimate a lesion is matched with.
MATCHING_REACH = 0.05

Projection = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True, eq=False)
class Estimate:
    """One place where a lesion was felt: point [m] (3,), peak contrast, and its excess over the surroundings."""

    point: FloatArray
    contrast: float
    excess: float


@dataclass(frozen=True, eq=False)
class Truth:
    """A lesion seen from the surface: the face's point nearest to its centre [m], the normal there, its radius."""

    name: str
    centre: FloatArray
    point: FloatArray
    normal: FloatArray
    radius: float


@dataclass(frozen=True, eq=False)
class LesionScore:
    """One lesion's best match on a map: index of the estimate or None, its error along the surface [m], felt or not."""

    truth: Truth
    estimate: int | None
    error: float
    contrast: float

    @property
    def felt(self) -> bool:
        """Whether the estimate lies within the lesion's radius."""
        return self.error <= self.truth.radius


@dataclass(frozen=True, eq=False)
class ContrastMap:
    """A contrast map with what was felt on it and how that compares with the truth.

    Fields:
        name: what the stiffness was compared with.
        contrast: stiffness / baseline at each site                                                 (n_site,)
        estimates: where lesions were felt, strongest first
        scores: one for each lesion
        false_alarms: estimates that lie within no lesion's radius
        healthy_std, healthy_robust_std: of the contrast over sites far from every lesion
    """

    name: str
    contrast: FloatArray
    estimates: tuple[Estimate, ...]
    scores: tuple[LesionScore, ...]
    false_alarms: int
    healthy_std: float
    healthy_robust_std: float

    @property
    def felt_count(self) -> int:
        """How many lesions were felt within their radius."""
        return sum(score.felt for score in self.scores)


def feel_lesions(sites: FloatArray, contrast: FloatArray, *, spacing: float) -> list[Estimate]:
    """Local maxima of the smoothed contrast that stand out from the healthy majority, strongest first.

    The contrast is smoothed by a Gaussian; maxima near a stronger one are dropped; each is placed at the centroid of
    the excess contrast around it.

    Args:
        sites: on the surface [m], shape (n_site, 3).
        contrast: shape (n_site,).
        spacing: of the raster [m].
    """
    if len(sites) < 2:
        return []
    distance = np.linalg.norm(sites[:, None] - sites[None], axis=2) / spacing
    kernel = np.exp(-0.5 * (distance / KERNEL_SPACINGS) ** 2)
    smooth = kernel @ contrast / kernel.sum(axis=1)
    middle = healthy_majority(smooth)[0]
    threshold = max(CONTRAST_FLOOR, SCATTERS_ABOVE * robust_spread(contrast - smooth))
    free = np.ones(len(sites), dtype=bool)
    estimates = []
    for peak in np.argsort(-smooth, kind="stable"):
        around = distance[peak] <= CENTROID_SPACINGS
        if not free[peak] or smooth[peak] < smooth[around].max():
            continue
        excess = float(smooth[peak]) - _surroundings(smooth, distance[peak], middle)
        if excess <= threshold:
            continue
        free &= distance[peak] > APART_SPACINGS
        pull = smooth - middle - EXCESS_SHARE * (smooth[peak] - middle)
        weight = np.where(around, np.maximum(pull, 0.0), 0.0)
        point = weight @ sites / weight.sum() if weight.any() else sites[peak]
        largest = float(contrast[distance[peak] <= 1.0].max())
        estimates.append(Estimate(point=point, contrast=largest, excess=excess))
    return estimates


def _surroundings(smooth: FloatArray, distance: FloatArray, majority: float) -> float:
    """The healthy level around a site; that of the whole map where the raster ends too soon."""
    low, high = SURROUNDINGS_SPACINGS
    ring = (distance > low) & (distance <= high)
    return float(np.quantile(smooth[ring], 0.25)) if ring.sum() >= FEWEST_SURROUNDING else majority


def seen_from_surface(lesions: Sequence[Lesion], mesh: TetMesh, project: Projection) -> list[Truth]:
    """The lesions with the nearest point of the palpable face and the normal there."""
    truths = []
    for lesion in lesions:
        centre, half_axes = lesion_extent(mesh, lesion)
        point, normal = project(centre)
        truths.append(Truth(lesion.name, centre, point, normal, float(half_axes.max())))
    return truths


def score_map(
    name: str,
    sites: FloatArray,
    contrast: FloatArray,
    estimates: Sequence[Estimate],
    truths: Sequence[Truth],
    surface: SurfaceDistance,
) -> ContrastMap:
    """Match estimates to lesions one to one by the least sum of distances along the surface, and measure the map."""
    places = np.array([estimate.point for estimate in estimates]).reshape(-1, 3)
    error = np.array([surface(truth.point, places) for truth in truths]).reshape(len(truths), len(places))
    rows, columns = linear_sum_assignment(np.minimum(error, MATCHING_REACH))
    matched = dict(zip(rows.tolist(), columns.tolist(), strict=True))
    from_lesion = [np.linalg.norm(sites - truth.point, axis=1) for truth in truths]
    scores = []
    for index, truth in enumerate(truths):
        over = contrast[from_lesion[index] <= truth.radius]
        column = matched.get(index)
        scores.append(
            LesionScore(
                truth=truth,
                estimate=column,
                error=float(error[index, column]) if column is not None else np.inf,
                contrast=float(over.max()) if len(over) else np.nan,
            )
        )
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
        healthy_std=float(contrast[healthy].std()) if healthy.any() else np.nan,
        healthy_robust_std=robust_spread(contrast[healthy]) if healthy.any() else np.nan,
    )
