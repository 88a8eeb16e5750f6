"""Palpation scene of a patient's organ: tip, press, limits and hidden lesions scaled to its cells and tissue."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from msdm_core.kernels import OrganModel
from msdm_core.material import Material
from surgsim_apps.palpate.hold import Hold
from surgsim_apps.palpate.palpation import MODEL_MODULUS_ERROR
from surgsim_apps.palpate.scene_options import SceneOptions, with_options
from surgsim_apps.palpate.sites import plan_sites
from surgsim_apps.patient.facing import faced_note, facing_approach
from surgsim_apps.patient.fine_surface import mesh_source
from surgsim_apps.patient.lesion_room import lack_of_room, sample_face
from surgsim_apps.patient.materials import TissueMaterial, organ_material, region_material, without_number
from surgsim_apps.patient.meshers import PatientMesh
from surgsim_apps.patient.supports import organ_anchors
from surgsim_apps.patient.touch import DEPTH_STEP, TouchPlan
from surgsim_env.scene import (
    Anatomy,
    LesionDraw,
    Limits,
    PalpationSettings,
    Scene,
    TissueRegion,
    Vector,
    anatomy_of,
    contact_radius,
    hertz_force,
    make_scene,
    press_modulus,
    with_added_mass,
    with_substeps,
)

PATTERN = "liver"
# From the front and above in a scan's axes; against the third axis of files, whose axes have no stated meaning.
APPROACH_SCAN: Vector = (0.0, math.sqrt(0.5), -math.sqrt(0.5))
APPROACH_FILE: Vector = (0.0, 0.0, -1.0)
# Direction of the head, likewise; in files across the usual approach.
CRANIAL_SCAN: Vector = (0.0, 0.0, 1.0)
CRANIAL_FILE: Vector = (1.0, 0.0, 0.0)


@dataclass(frozen=True)
class PalpationLayout:
    """Numbers of the scene in proportion to tip, press and cells, as in the scene liver; the others are chosen.

    Fields:
        contact_share: contact stiffness times contact radius over the modulus that a press feels: hides a few per cent
            of a contrast over 1
        contact_stiffness_most: what the probe of 0.18 kg bears [N/m^3]
        spacing_per_tip, spacing_step: spacing of sites over the tip's radius, and the step of its rounding [m]
        sites_most: a raster of more sites takes minutes: its spacing is then enlarged
        thicknesses: least thickness of organ below a site, in press depths; the first that leaves any site is taken
        soft_per_press, hard_per_press: force limits over the force of a healthy press (Hertz)
        lesion_radius, lesion_cover, lesion_rim: ranges of hidden lesions in tip radii
        lesion_ratio: range of a lesion's modulus over the organ's
        lesion_shrinks: factors on these ranges, tried in turn for organs without enough room
    """

    contact_share: float = 200.0
    contact_stiffness_most: float = 2.5e8
    spacing_per_tip: float = 13.0 / 12.0
    spacing_step: float = 5e-4
    sites_most: int = 60
    thicknesses: tuple[float, ...] = (5.0, 3.0, 0.0)
    soft_per_press: float = 2.0
    hard_per_press: float = 4.0
    lesion_radius: tuple[float, float] = (1.5, 2.1)
    lesion_cover: tuple[float, float] = (0.25, 0.65)
    lesion_rim: float = 2.1
    lesion_ratio: tuple[float, float] = (5.0, 8.0)
    lesion_shrinks: tuple[float, ...] = (1.0, 0.75, 0.55)


LAYOUT = PalpationLayout()


@dataclass(frozen=True, eq=False)
class PatientScene:
    """A patient's organ with its palpation scene.

    Fields:
        patient: the mesh and its sources
        anatomy: the scene on that mesh, as it will be read from the file
        tissue, regions: materials with their sources, of the healthy tissue and of each region by name
        site_count: number of sites of its raster
        notes: remarks on unusual choices
        anchor_sources: sources of the anchors' numbers, by the path of their entry in the scene
        hold: of the organ in healthy presses, where it was checked
    """

    patient: PatientMesh
    anatomy: Anatomy
    tissue: TissueMaterial
    regions: Mapping[str, TissueMaterial]
    site_count: int
    notes: tuple[str, ...]
    anchor_sources: Mapping[str, str]
    hold: Hold | None = None

    @property
    def scene(self) -> Scene:
        """The scene."""
        return self.anatomy.scene


def approach_of(options: SceneOptions, *, is_scan: bool) -> Vector:
    """Direction of the probe: as given, or the default for axes of a patient or of a file."""
    return options.approach or (APPROACH_SCAN if is_scan else APPROACH_FILE)


def patient_scene(
    patient: PatientMesh, out: Path, *, touch: TouchPlan, options: SceneOptions, moduli: Mapping[str, float]
) -> PatientScene:
    """Palpation scene of a patient's organ.

    Args:
        patient: the organ.
        out: path of the mesh file, beside the scene file; its stem names the scene.
        touch: tip and press depth.
        options: approach and healthy tissue.
        moduli: of regions by name [Pa].

    Raises:
        ValueError: a modulus for a region that does not exist, a value out of range, no site to press.
    """
    tissue = organ_material(patient.organ_name, options.youngs_modulus)
    names = [volume.name for volume in patient.volumes[1:]]
    regions = {name: region_material(name, patient.organ_name, tissue.material, moduli) for name in names}
    _check_moduli(moduli, names)
    scene = _first_scene(patient, out, tissue.material, regions, touch, options)
    anchors, sources = organ_anchors(
        patient.organ_name, patient.mesh, scene.instrument.approach, is_scan=patient.is_scan
    )
    scene = replace(scene, anchors=anchors)
    notes = faced_note(patient, scene)
    anatomy, sites = _with_sites(scene, patient, notes)
    anatomy = _with_lesions(anatomy, notes)
    return PatientScene(patient, _substeps_of_worst(anatomy), tissue, regions, sites, tuple(notes), sources)


def _check_moduli(moduli: Mapping[str, float], names: Sequence[str]) -> None:
    for name in moduli:
        if not any(name in (region, without_number(region)) for region in names):
            raise ValueError(f"--modulus {name}=...: there is no such region; there are {', '.join(names) or 'none'}")


def _first_scene(
    patient: PatientMesh,
    out: Path,
    material: Material,
    regions: Mapping[str, TissueMaterial],
    touch: TouchPlan,
    options: SceneOptions,
) -> Scene:
    """The scene by the touch, the cells and the tissue, without anchors, thickness and hidden lesions."""
    liver = make_scene(PATTERN)
    tip, depth = touch.tip_radius, touch.press_depth
    press = hertz_force(material, tip, depth)
    usual = approach_of(options, is_scan=patient.is_scan)
    approach = options.approach or facing_approach(patient, usual, liver.palpation.face_angle_deg)
    description = f"{patient.organ_name} of {', '.join(patient.sources)}, {patient.mesh.volumes.sum() * 1e6:.0f} ml"
    if patient.lesions:
        description += f", {len(patient.lesions)} segmented lesion(s)"
    scene = replace(
        liver,
        name=out.stem,
        description=description,
        folder=out.parent,
        mesh=mesh_source(out, patient.surface),
        material=material,
        contact=replace(liver.contact, stiffness=_contact_stiffness(material, contact_radius(tip, depth))),
        limits=Limits(_digits(LAYOUT.soft_per_press * press, 2), _digits(LAYOUT.hard_per_press * press, 2)),
        palpation=PalpationSettings(
            press_depth=depth,
            face_angle_deg=liver.palpation.face_angle_deg,
            face_margin=tip,
            site_spacing=_rounded(LAYOUT.spacing_per_tip * tip, LAYOUT.spacing_step),
        ),
        # Its number of substeps is that of the organ alone at first (`_substeps_of_worst`).
        timing=replace(liver.timing, mass_scaling=False),
        lesion=None,
        demonstration=(),
        regions=tuple(TissueRegion(name, region.material, name in patient.lesions) for name, region in regions.items()),
        cranial=CRANIAL_SCAN if patient.is_scan else CRANIAL_FILE,
    )
    # Normalises the approach, and refuses values out of range.
    scene = with_options(scene, replace(options, approach=approach, tip_radius=tip, press_depth=depth))
    x, y, z = (round(part, 6) + 0.0 for part in scene.instrument.approach)
    return replace(scene, instrument=replace(scene.instrument, approach=(x, y, z)))


def _contact_stiffness(material: Material, radius: float) -> float:
    """Contact stiffness [N/m^3] for a contact radius [m]."""
    return min(_digits(LAYOUT.contact_share * press_modulus(material) / radius, 3), LAYOUT.contact_stiffness_most)


def _with_sites(scene: Scene, patient: PatientMesh, notes: list[str]) -> tuple[Anatomy, int]:
    """The anatomy with a raster of 1 to `sites_most` sites, and their number."""
    anatomy, count = _thick_enough(scene, patient, notes)
    while count > LAYOUT.sites_most:
        palpation = anatomy.scene.palpation
        factor = max(math.sqrt(count / LAYOUT.sites_most), 1.02)
        wider = math.ceil(palpation.site_spacing * factor / LAYOUT.spacing_step) * LAYOUT.spacing_step
        palpation = replace(palpation, site_spacing=_rounded(wider, LAYOUT.spacing_step))
        anatomy = anatomy_of(replace(scene, palpation=palpation), patient.mesh)
        count = len(plan_sites(anatomy)[0])
    return anatomy, count


def _thick_enough(scene: Scene, patient: PatientMesh, notes: list[str]) -> tuple[Anatomy, int]:
    """The anatomy with the first of `thicknesses` for which there are sites to press, and their number."""
    palpation = scene.palpation
    for thickness in LAYOUT.thicknesses:
        thick = replace(palpation, thickness_smallest=_rounded(thickness * palpation.press_depth, DEPTH_STEP))
        anatomy = anatomy_of(replace(scene, palpation=thick), patient.mesh)
        try:
            count = len(plan_sites(anatomy)[0])
        except ValueError:
            if thickness == LAYOUT.thicknesses[-1]:
                raise
            continue
        if thickness != LAYOUT.thicknesses[0]:
            notes.append(f"the organ is thin: sites with {thickness:g} instead of 5 press depths of organ are pressed")
        return anatomy, count
    raise AssertionError("thicknesses is empty")


def _with_lesions(anatomy: Anatomy, notes: list[str]) -> Anatomy:
    """The anatomy with fitting ranges of hidden lesions; without a lesion table if none fit."""
    tip, lack = anatomy.scene.instrument.tip_radius, ""
    sample = sample_face(anatomy)
    for shrink in LAYOUT.lesion_shrinks:
        draw = LesionDraw(
            radius=_pair(LAYOUT.lesion_radius, shrink * tip),
            cover=_pair(LAYOUT.lesion_cover, shrink * tip),
            modulus_ratio=LAYOUT.lesion_ratio,
            rim_distance=_rounded(LAYOUT.lesion_rim * shrink * tip, DEPTH_STEP),
        )
        reason = lack_of_room(sample, draw)
        if not reason:
            if lack:
                notes.append(f"hidden lesions are {shrink:g} times the size that suits the tip, since {lack}")
            return replace(anatomy, scene=replace(anatomy.scene, lesion=draw))
        lack = reason
    notes.append(
        f"no hidden lesions: there is no [lesion] table, and environments of palpation refuse the organ, since {lack}"
    )
    return anatomy


def _substeps_of_worst(anatomy: Anatomy) -> Anatomy:
    """The anatomy with the fewest substeps for a little mass added to its stiffest organs, healthy and with lesions."""
    draw, worst = anatomy.scene.lesion, np.random.default_rng(0)
    lesions = [anatomy.demonstration_lesions()]
    if draw is not None:
        hardest = replace(
            draw, radius=(draw.radius[1],) * 2, cover=(draw.cover[0],) * 2, modulus_ratio=(draw.modulus_ratio[1],) * 2
        )
        lesions += [[anatomy.random_lesion(worst, hardest)] for _ in range(2)]

    def organs_of(scaled: Anatomy) -> Iterator[OrganModel]:
        yield from (scaled.organ(balls) for balls in lesions)
        yield scaled.organ(modulus_factor=1.0 + MODEL_MODULUS_ERROR)

    return with_added_mass(with_substeps(anatomy, [*organs_of(anatomy)]), organs_of)


def _pair(share: tuple[float, float], length: float) -> tuple[float, float]:
    return _rounded(share[0] * length, DEPTH_STEP), _rounded(share[1] * length, DEPTH_STEP)


def _rounded(value: float, step: float) -> float:
    """Rounded to a multiple of a step [m]."""
    return round(round(value / step) * step, 7)


def _digits(value: float, count: int) -> float:
    return float(f"{value:.{count}g}")
