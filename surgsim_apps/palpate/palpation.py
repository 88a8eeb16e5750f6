"""Palpation of an organ: presses site by site, contrast maps against two baselines, estimated lesions."""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from msdm_core.arithmetic import cos, exp, matmul, sin
from msdm_core.kernels import OrganModel
from msdm_core.material import Lesion
from msdm_core.mesh import FloatArray
from surgsim_apps.palpate.contrast_map import (
    ContrastMap,
    contrast_with_model,
    contrast_with_neighbours,
    feel_lesions,
    score_map,
)
from surgsim_apps.palpate.hold import Hold, hold_of
from surgsim_apps.palpate.misses import Miss, explain_misses
from surgsim_apps.palpate.sites import plan_sites
from surgsim_apps.palpate.truth import Truth, seen_from_surface
from surgsim_env.coupling import ForceReading
from surgsim_env.palpation import Press, scan
from surgsim_env.scene import (
    Anatomy,
    Ball,
    ForceSensor,
    PalpableFace,
    Scene,
    hidden_share,
    load_anatomy,
    tangent_axes,
    with_added_mass,
    with_substeps,
)
from surgsim_env.step_progress import StepProgress

# Errors of the pre-operative model: modulus by up to this share, place of each press by this distance [m].
MODEL_MODULUS_ERROR = 0.2
MODEL_SITE_ERROR = 0.002
# Decay length of the rim's influence on stiffness [m].
RIM_REACH = 0.015
# Names of the baselines.
NEIGHBOURS, MODEL = "healthy neighbours", "pre-operative model"


@dataclass(frozen=True, eq=False)
class PalpationResult:
    """Result of a palpation.

    Fields:
        anatomy, lesions, truths: the organ, its hidden lesions, and their places on the surface
        presses: of the organ, one per site
        model_presses: of the pre-operative model, at sites that are MODEL_SITE_ERROR off
        reading: of the force sensor along the normal at the end of each press [N]                 (n_site,)
        used: sites whose two presses both reached the set depth and read a force above 0           (n_site,)
        maps: against the healthy neighbours and against the model, over the used sites
        misses: reasons for lesions that a map does not show
        hold: of the healthy model; None without a complete press
        model_modulus_factor: modulus of the model over the true one
        support_count: raster sites too near to a support, which were not pressed
        seed, wall_time [s]: of the run
    """

    anatomy: Anatomy
    lesions: tuple[Lesion, ...]
    truths: tuple[Truth, ...]
    presses: tuple[Press, ...]
    model_presses: tuple[Press, ...]
    reading: FloatArray
    used: np.ndarray
    maps: tuple[ContrastMap, ContrastMap]
    misses: tuple[Miss, ...]
    hold: Hold | None
    model_modulus_factor: float
    support_count: int
    seed: int
    wall_time: float

    @property
    def model_map(self) -> ContrastMap:
        """The map against the pre-operative model."""
        return self.maps[1]

    @property
    def hidden_share(self) -> float:
        """Share of contrast - 1 that contact hides at the used site with the largest force."""
        scene = self.anatomy.scene
        pressed = [press for press, used in zip(self.presses, self.used, strict=True) if used]
        hardest = max(pressed, key=lambda press: press.force)
        tip, depth = scene.instrument.tip_radius, scene.palpation.press_depth
        return hidden_share(hardest.force, hardest.slope, tip, depth, scene.contact.stiffness)

    @property
    def sites(self) -> FloatArray:
        """The pressed sites [m], shape (n_site, 3)."""
        return np.array([press.site for press in self.presses])

    @property
    def simulated_time(self) -> float:
        """Duration of the presses of the organ and of its model [s]."""
        return math.fsum(press.duration for press in (*self.presses, *self.model_presses))


def load_stable_anatomy(scene: Scene, lesions: Sequence[Lesion], *, modulus_factor_largest: float) -> Anatomy:
    """The anatomy with substeps, fewer by a little added mass, for the organ with lesions and a stiffer one without.

    Tissue that stiffens keeps its substeps: its stable step is shorter under a press than at rest.

    Args:
        scene: its mesh, materials and timing.
        lesions: hidden in the organ.
        modulus_factor_largest: largest modulus of the pre-operative model over the scene's.
    """

    def organs_of(anatomy: Anatomy) -> Iterator[OrganModel]:
        yield anatomy.organ(lesions)
        yield anatomy.organ(modulus_factor=modulus_factor_largest)

    anatomy = load_anatomy(scene)
    stable = with_substeps(anatomy, [*organs_of(anatomy)], least=scene.timing.substep_count)
    return with_added_mass(stable, organs_of) if scene.material.stiffening is None else stable


def run_palpation(
    anatomy: Anatomy,
    *,
    lesions: Sequence[Lesion] | None = None,
    around: Ball | None = None,
    seed: int = 0,
    progress: StepProgress | None = None,
) -> PalpationResult:
    """Palpate a scene's organ; the same scene, lesions and seed give the same result.

    Args:
        anatomy: the organ; its scene defines the press (see load_anatomy).
        lesions: hidden in the organ; the scene's demonstration lesions by default.
        around: press only the raster sites inside this ball.
        seed: of sensor noise and of the errors of the pre-operative model.
        progress: display of the steps; none by default.

    Raises:
        ValueError: the palpable face has no site to press, or no press reached the set depth.
        OrganError: a lesion or a material that is impossible, or a step that is too long.
    """
    begin = time.perf_counter()
    progress = progress or StepProgress()
    scene = anatomy.scene
    hidden = tuple(anatomy.demonstration_lesions() if lesions is None else lesions)
    rng = np.random.default_rng(seed)
    sites, normals, support_count = plan_sites(anatomy, around)
    factor = float(rng.uniform(1.0 - MODEL_MODULUS_ERROR, 1.0 + MODEL_MODULUS_ERROR))
    organ, model = anatomy.organ(hidden), anatomy.organ(modulus_factor=factor)
    model_sites, model_normals = _displaced(anatomy.face, sites, normals, rng)
    with progress.step("pressing the organ", len(sites)) as advance:
        presses = scan(anatomy, organ, sites, normals, progress=lambda: advance(1))
    with progress.step("pressing its pre-operative model", len(sites)) as advance:
        model_presses = scan(anatomy, model, model_sites, model_normals, progress=lambda: advance(1))
    reading = _read(presses, scene.sensor, rng)
    model_reading = _read(model_presses, scene.sensor, rng)
    complete = np.array([not (press.end or other.end) for press, other in zip(presses, model_presses, strict=True)])
    # Bias and noise may exceed the force of a weak press; such a site has no stiffness.
    used = complete & (reading > 0.0) & (model_reading > 0.0)
    if not used.any():
        reason = presses[0].end or model_presses[0].end or "a force reading that is not above 0"
        depth = scene.palpation.press_depth * 1e3
        raise ValueError(
            f"no press gave a stiffness at the set depth of {depth:g} mm; the first ended by: {reason}: change the "
            "press depth, limits.hard_force or the sensor"
        )
    truths = tuple(seen_from_surface(hidden, anatomy))
    maps = _maps(anatomy, presses, model_presses, (reading, model_reading), used, truths)
    return PalpationResult(
        anatomy=anatomy,
        lesions=hidden,
        truths=truths,
        presses=tuple(presses),
        model_presses=tuple(model_presses),
        reading=reading,
        used=used,
        maps=maps,
        misses=explain_misses(anatomy, organ, hidden, truths, maps, sites[used], sites[~used], progress),
        hold=hold_of(anatomy, model_presses, modulus_factor=factor),
        model_modulus_factor=factor,
        support_count=support_count,
        seed=seed,
        wall_time=time.perf_counter() - begin,
    )


def _read(presses: Sequence[Press], sensor: ForceSensor, rng: np.random.Generator) -> FloatArray:
    """Readings of a scan along the normals [N], shape (n_site,): one bias for all, noise for each."""
    reading = ForceReading(sensor)
    reading.reset(rng)
    force, normals = np.array([press.force for press in presses]), np.array([press.normal for press in presses])
    return reading.read_along(force, normals, rng)


def _displaced(
    face: PalpableFace, sites: FloatArray, normals: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Each site moved along the surface in a random direction, and the normals there."""
    moved = []
    for site, normal in zip(sites, normals, strict=True):
        first, second = tangent_axes(normal)
        angle = rng.uniform(0.0, 2.0 * np.pi)
        moved.append(face.project(site + MODEL_SITE_ERROR * (cos(angle) * first + sin(angle) * second)))
    return np.array([point for point, _ in moved]), np.array([normal for _, normal in moved])


def _maps(
    anatomy: Anatomy,
    presses: Sequence[Press],
    model_presses: Sequence[Press],
    readings: tuple[FloatArray, FloatArray],
    used: np.ndarray,
    truths: Sequence[Truth],
) -> tuple[ContrastMap, ContrastMap]:
    """Both contrast maps over the used sites; readings of the organ and of its model [N], each (n_site,)."""
    spacing = anatomy.scene.palpation.site_spacing
    sites = np.array([press.site for press in presses])[used]
    stiffness, model_stiffness = (
        reading[used] / np.array([press.depth for press in pressed])[used]
        for reading, pressed in zip(readings, (presses, model_presses), strict=True)
    )
    plane = matmul(sites, np.column_stack(tangent_axes(anatomy.face.approach)))

    def scored(name: str, contrast: FloatArray) -> ContrastMap:
        estimates = feel_lesions(sites, contrast, spacing=spacing)
        return score_map(name, sites, contrast, estimates, truths, anatomy.along_surface, spacing=spacing)

    return (
        scored(NEIGHBOURS, contrast_with_neighbours(stiffness, plane, _geometry(anatomy.face, sites))),
        scored(MODEL, contrast_with_model(stiffness, model_stiffness)),
    )


def _geometry(face: PalpableFace, sites: FloatArray) -> FloatArray | None:
    """Geometric regressors of healthy stiffness: reciprocal thickness [1/m] and nearness of the rim, (n_site, 2)."""
    if not np.isfinite(face.thickness).any():
        return None
    centres = face.points[face.triangles].mean(axis=1)
    thickness = np.array([face.thickness[np.argmin(np.square(centres - site).sum(axis=1))] for site in sites])
    rim = np.array([face.rim_distance(site) for site in sites])
    return np.column_stack([1.0 / thickness, exp(-rim / RIM_REACH)])
