"""Healthy map of a member of a family, from that of its template and few presses of its own.

The mesh's part of a press's stiffness varies from node to node, and members have the template's tets: at the
same place of the face the ratio r of both stiffnesses varies as slowly as the deformation. A Gaussian process with
fixed hyperparameters (Rasmussen & Williams 2006, eq. 2.25) interpolates log r from PRESS_COUNT sites, far from each
other, to all.
"""

from functools import lru_cache

import numpy as np

from msdm_core.arithmetic import exp, log, matmul, norm, solve
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.palpation.chart import (
    ChartedFace,
    HealthyMap,
    Site,
    as_map,
    cache_folder,
    charted_face,
    healthy_map_of,
    keep_map,
    map_digest,
    press_sites,
    quickened,
)
from surgsim_env.scene.anatomy import Anatomy, MemberName, load_anatomy
from surgsim_env.scene.digest import content_digest
from surgsim_env.scene.family import make_member
from surgsim_env.scene.load import with_instrument
from surgsim_env.scene.model import Scene
from surgsim_env.scene.motions import STILL, with_motion
from surgsim_env.step_progress import StepProgress

# Pressed sites, six times as many as float32 has lanes. On the 16 members of the validation split of
# `liver_family`, pressed at every site, log k is then off by 0.017 (standard deviation) and by at most 0.15, the most
# beside the falciform ligament and at the rim.
PRESS_COUNT = 96
# Standard deviations of log r about its mean, each with its correlation length over the longer half side of the chart:
# the smooth deformation, and its effect on edges and ligaments. Standard deviation of one press, by stretched cells.
RATIO_TERMS, PRESS_SPREAD = ((0.15, 0.5), (0.05, 0.08)), 0.015
# Number of members' maps in memory, 5 kB each.
MAPS_MOST = 1000


def still_template(scene: Scene) -> Anatomy:
    """Anatomy of a scene for its healthy map: with the probe, and without motion."""
    return load_anatomy(with_instrument(with_motion(scene, STILL), "probe"))


@lru_cache(maxsize=MAPS_MOST)
def member_map(template: Anatomy, name: MemberName, between: int = 1) -> HealthyMap:
    """Healthy map of a member of a family, from the cache on disk (`chart.healthy_map`) or by presses.

    Args:
        template: `still_template` of the family's scene.
        name: of the member.
        between: division of the grid's cells.

    Raises:
        ValueError: as in `healthy_map`.
    """
    member = make_member(template, name)
    path = cache_folder() / f"healthy-{content_digest(map_digest(template), map_digest(member))}-{between}.npy"
    if path.is_file():
        return HealthyMap(np.load(path, allow_pickle=False))
    base = healthy_map_of(template, between)
    with StepProgress.on_stderr() as progress:
        grid = _corrected(base, member, template, progress, between)
    keep_map(path, grid)
    return HealthyMap(grid)


def _corrected(
    base: HealthyMap, member: Anatomy, template: Anatomy, progress: StepProgress, between: int
) -> FloatArray:
    """`HealthyMap.grid` of a member: the template's, corrected by presses on the member, (m, m, 3)."""
    charted, own = charted_face(member), charted_face(template)
    sites = charted.grid_sites(between)
    places = np.array([own.chart.place(member.face.carried(site.point, template.face)) for site in sites])
    inside = np.clip(places, -1.0, 1.0)
    expected, centre = base.stiffness(inside), base.centre(inside)
    spread = far_apart(charted, sites)
    quick = quickened(member, progress)
    presses = press_sites(quick, [sites[index] for index in spread], progress, np.float32, str(member.member))
    log_ratio = log(presses[:, 0] / expected[spread])
    differences = np.column_stack([log_ratio, presses[:, 1:] - centre[spread]])
    points = np.array([site.place for site in sites]) * charted.chart.extent / charted.chart.extent.max()
    mean = differences.mean(axis=0)
    weights = solve(
        _covariance(points[spread], points[spread]) + PRESS_SPREAD * PRESS_SPREAD * np.eye(len(spread)),
        differences - mean,
    )
    added = mean + matmul(_covariance(points, points[spread]), weights)
    return as_map(np.column_stack([expected * exp(added[:, 0]), centre + added[:, 1:]]))


def _covariance(first: FloatArray, second: FloatArray) -> FloatArray:
    """Covariance of log r between points (n, 2) and (m, 2), in longer half sides of the chart, shape (n, m)."""
    square = np.square(first[:, None] - second).sum(axis=2)
    return np.sum(
        [spread * spread * exp(-square / (2.0 * (length * length))) for spread, length in RATIO_TERMS], axis=0
    )


def far_apart(charted: ChartedFace, sites: list[Site]) -> list[int]:
    """Indices of at most PRESS_COUNT different sites, from the middle on each as far as possible from those before."""
    places = np.array([site.place for site in sites]) * charted.chart.extent
    chosen, distance = [], norm(places, axis=1)
    index = int(np.argmin(distance))
    nearest = np.full(len(places), np.inf)
    while len(chosen) < PRESS_COUNT and nearest[index] > 0.0:
        chosen.append(index)
        nearest = np.minimum(nearest, norm(places - places[index], axis=1))
        index = int(np.argmax(nearest))
    return chosen
