"""Reasons for hidden lesions that were not felt, with their numbers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from msdm_core.arithmetic import arccos, matmul, norm
from msdm_core.kernels import OrganModel
from msdm_core.material import Lesion
from msdm_core.mesh import FloatArray
from surgsim_apps.palpate.contrast_map import ContrastMap, LesionScore, smoothed
from surgsim_apps.palpate.hold import place_text
from surgsim_apps.palpate.truth import Truth, felt_weights, surface_points
from surgsim_env.palpation import scan
from surgsim_env.scene import Anatomy, Scene
from surgsim_env.step_progress import StepProgress

# A lesion is not under the pressed face if a press elsewhere on the surface strains it so many times as much.
HIDDEN_RATIO = 2.0
# A baseline from fewer healthy sites is weak.
HEALTHY_FEWEST = 8
# Least change of a press's force by a lesion, in standard deviations of the sensor's noise.
NOISES_LEAST = 2.0

NOT_FACED, NEAR_SUPPORT, NO_SITE, NOISE, TOO_DEEP, NO_MAXIMUM = (
    *("not under the pressed face", "too near a support", "no complete press near it", "below the sensor's noise"),
    *("deeper than the map's reach", "no maximum of the map"),
)


@dataclass(frozen=True)
class Miss:
    """Reason for a lesion that was not felt on a map.

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
    progress: StepProgress | None = None,
) -> tuple[Miss, ...]:
    """Misses of all maps; presses once with and once without each missed lesion.

    Args:
        anatomy: the organ.
        organ: compiled, with all lesions.
        lesions: in the organ.
        truths: their places, as in the maps' scores.
        maps: scored.
        sites: of the maps [m], shape (n_site, 3).
        ended_early: sites whose presses ended early [m], shape (n, 3).
        progress: display of the presses; none by default.
    """
    missed = [index for index in range(len(lesions)) if not all(entry.scores[index].felt for entry in maps)]
    if not missed:
        return ()
    misses = []
    with (progress or StepProgress()).step("pressing over missed lesions", 2 * len(missed)) as advance:
        for index in missed:
            truth = truths[index]
            hidden = _hidden(anatomy, lesions[index], truth)
            bare = anatomy.organ([lesion for number, lesion in enumerate(lesions) if number != index])
            force, bare_force = (
                scan(anatomy, model, truth.point[None], truth.normal[None], progress=lambda: advance(1))[0].force
                for model in (organ, bare)
            )
            for contrast_map in maps:
                score, healthy_count = contrast_map.scores[index], contrast_map.healthy_count
                if score.felt:
                    continue
                reason, text = _reason(
                    contrast_map, score, (force, bare_force), hidden, anatomy.scene, (sites, ended_early)
                )
                if healthy_count < HEALTHY_FEWEST:
                    text += f"; the baseline is weak: {healthy_count} healthy sites, {HEALTHY_FEWEST} are the rule"
                misses.append(Miss(contrast_map.name, truth.name, reason, f"{reason}: {text}"))
    return tuple(misses)


def _hidden(anatomy: Anatomy, lesion: Lesion, truth: Truth) -> tuple[str, str] | None:
    """Reason and text for a lesion that is felt better from a point without a site; None for any other."""
    points, normals = surface_points(anatomy)
    weights = felt_weights(anatomy, lesion, points, normals)
    here = float(felt_weights(anatomy, lesion, truth.point[None], truth.normal[None])[0])
    best = int(np.argmax(weights))
    if weights[best] < HIDDEN_RATIO * here:
        return None
    ratio = f"{weights[best] / here:.1f} times" if here > 0.0 else "much"
    text = f"a press at {place_text(points[best])} mm would strain it {ratio} as much"
    facing = np.degrees(arccos(np.clip(matmul(-normals[best], anatomy.face.approach), -1.0, 1.0)))
    if facing <= anatomy.scene.palpation.face_angle_deg and not anatomy.clear_of_supports(points[best][None])[0]:
        return NEAR_SUPPORT, f"{text}, where the organ is held: move the anchor, if it is not there"
    into = ",".join(f"{value:.2f}" for value in -normals[best] + 0.0)
    return NOT_FACED, f"{text}; --approach {into} faces it"


def _reason(
    contrast_map: ContrastMap,
    score: LesionScore,
    forces: tuple[float, float],
    hidden: tuple[str, str] | None,
    scene: Scene,
    pressed: tuple[FloatArray, FloatArray],
) -> tuple[str, str]:
    truth, (force, bare_force) = score.truth, forces
    # A press may slide off, without a force.
    contrast = force / bare_force if bare_force > 0.0 else 1.0
    (sites, ended_early), spacing, noise = pressed, scene.palpation.site_spacing, scene.sensor.noise
    felt = f"a press feels {force:.3f} N, {bare_force:.3f} N without the lesion (contrast {contrast:.2f})"
    weak = contrast - 1.0 < contrast_map.threshold
    if hidden is not None and weak:
        return hidden
    away = norm(sites - truth.point, axis=1)
    if away.min() > spacing:
        early = norm(ended_early - truth.point, axis=1) <= spacing
        ended = f"{int(early.sum())} presses near it ended early, " if early.any() else ""
        return NO_SITE, f"{ended}the nearest site of the map is {away.min() * 1e3:.1f} mm away"
    if abs(force - bare_force) < NOISES_LEAST * noise:
        return NOISE, f"{felt}; the sensor's noise is {noise:g} N"
    if weak:
        return TOO_DEEP, f"{felt}; this map shows what exceeds its surroundings by {contrast_map.threshold:.2f}"
    level = float(smoothed(sites, contrast_map.contrast, spacing=spacing)[int(np.argmin(away))])
    return NO_MAXIMUM, (
        f"{felt}, but the smoothed contrast of the nearest site, {away.min() * 1e3:.1f} mm away, is {level:.2f} "
        f"and no maximum within its radius of {truth.radius * 1e3:.1f} mm exceeds its surroundings by "
        f"{contrast_map.threshold:.2f}"
    )
