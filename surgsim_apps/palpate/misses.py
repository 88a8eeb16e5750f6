"""Why a hidden lesion was not felt: for each one a reason, with the numbers that show it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from msdm_core.arithmetic import arccos, matmul, norm
from msdm_core.kernels import OrganModel
from msdm_core.material import Lesion
from msdm_core.mesh import FloatArray
from surgsim_apps.palpate.contrast_map import ContrastMap, LesionScore, smoothed
from surgsim_apps.palpate.truth import Truth, felt_weights, surface_points
from surgsim_env.palpation import scan
from surgsim_env.scene import Anatomy, Scene

# A lesion is not under the pressed face where another point of the surface is pressed with so many times its strain.
HIDDEN_RATIO = 2.0
# A baseline from fewer healthy sites is weak.
HEALTHY_FEWEST = 8
# The sensor's noise hides a lesion that changes a press's force by less than this many of its standard deviations.
NOISES_LEAST = 2.0

NOT_FACED, NEAR_SUPPORT, NO_SITE, NOISE, TOO_DEEP, NO_MAXIMUM = (
    *("not under the pressed face", "too near a support", "no complete press near it", "below the sensor's noise"),
    *("deeper than the map's reach", "no maximum of the map"),
)


@dataclass(frozen=True)
class Miss:
    """Why one lesion was not felt on one map.

    Args:
        map_name, lesion: names of the map and the lesion.
        reason: one of the reasons above.
        text: the reason with its numbers.
    """

    map_name: str
    lesion: str
    reason: str
    text: str


def explain_misses(
    anatomy: Anatomy,
    organ: OrganModel,
    lesions: Sequence[Lesion],
    truths: Sequence[Truth],
    maps: Sequence[ContrastMap],
    sites: FloatArray,
    ended_early: FloatArray,
    progress: Callable[[int], Callable[[], None]] | None = None,
) -> tuple[Miss, ...]:
    """The reason for each lesion that a map does not show; presses once with and once without each of those.

    Args:
        anatomy: the organ.
        organ: compiled, with all lesions.
        lesions: in it.
        truths: their places, as in the maps' scores.
        maps: with scores.
        sites: of the maps [m], shape (n_site, 3).
        ended_early: sites whose presses ended early [m], shape (n, 3).
        progress: called with the number of presses; gives back what is called after each.
    """
    missed = [index for index in range(len(lesions)) if not all(one.scores[index].felt for one in maps)]
    advance = progress(2 * len(missed)) if progress and missed else lambda: None
    misses = []
    for index in missed:
        truth = truths[index]
        hidden = _hidden(anatomy, lesions[index], truth)
        bare = anatomy.organ([lesion for number, lesion in enumerate(lesions) if number != index])
        force, force_without = (
            scan(anatomy, model, truth.point[None], truth.normal[None], progress=advance)[0].force
            for model in (organ, bare)
        )
        for one in maps:
            if one.scores[index].felt:
                continue
            reason, text = _why(
                one, one.scores[index], (force, force_without), hidden, anatomy.scene, (sites, ended_early)
            )
            if one.healthy_count < HEALTHY_FEWEST:
                text += f"; the baseline is weak: {one.healthy_count} healthy sites, {HEALTHY_FEWEST} are the rule"
            misses.append(Miss(one.name, truth.name, reason, f"{reason}: {text}"))
    return tuple(misses)


def _hidden(anatomy: Anatomy, lesion: Lesion, truth: Truth) -> tuple[str, str] | None:
    """Reason and text for a lesion that is better felt from where no site is; None for any other."""
    points, normals = surface_points(anatomy)
    weights = felt_weights(anatomy, lesion, points, normals)
    here = float(felt_weights(anatomy, lesion, truth.point[None], truth.normal[None])[0])
    best = int(np.argmax(weights))
    if weights[best] < HIDDEN_RATIO * here:
        return None
    more = f"{weights[best] / here:.1f} times" if here > 0.0 else "much"
    there = f"a press at {_place(points[best])} mm would strain it {more} as much"
    facing = np.degrees(arccos(np.clip(matmul(-normals[best], anatomy.face.approach), -1.0, 1.0)))
    if facing <= anatomy.scene.palpation.face_angle_deg and not anatomy.clear_of_supports(points[best][None])[0]:
        return NEAR_SUPPORT, f"{there}, where the organ is held: move the anchor, if it is not there"
    into = ",".join(f"{value:.2f}" for value in -normals[best] + 0.0)
    return NOT_FACED, f"{there}; --approach {into} faces it"


def _why(
    one: ContrastMap,
    score: LesionScore,
    forces: tuple[float, float],
    hidden: tuple[str, str] | None,
    scene: Scene,
    pressed: tuple[FloatArray, FloatArray],
) -> tuple[str, str]:
    truth, (force, force_without) = score.truth, forces
    contrast = force / force_without
    (sites, ended_early), spacing, noise = pressed, scene.palpation.site_spacing, scene.sensor.noise
    felt = f"a press feels {force:.3f} N, {force_without:.3f} N without the lesion (contrast {contrast:.2f})"
    weak = contrast - 1.0 < one.threshold
    if hidden is not None and weak:
        return hidden
    away = norm(sites - truth.point, axis=1)
    if away.min() > spacing:
        early = norm(ended_early - truth.point, axis=1) <= spacing
        said = f"{int(early.sum())} presses near it ended early, " if early.any() else ""
        return NO_SITE, f"{said}the nearest site of the map is {away.min() * 1e3:.1f} mm away"
    if abs(force - force_without) < NOISES_LEAST * noise:
        return NOISE, f"{felt}; the sensor's noise is {noise:g} N"
    if weak:
        return TOO_DEEP, f"{felt}; this map shows what exceeds its surroundings by {one.threshold:.2f}"
    level = float(smoothed(sites, one.contrast, spacing=spacing)[int(np.argmin(away))])
    return NO_MAXIMUM, (
        f"{felt}, but the smoothed contrast of the nearest site, {away.min() * 1e3:.1f} mm away, is {level:.2f} "
        f"and no maximum within its radius of {truth.radius * 1e3:.1f} mm exceeds its surroundings by "
        f"{one.threshold:.2f}"
    )


def _place(point: FloatArray) -> str:
    return ", ".join(f"{value * 1e3:.1f}" for value in point)
