"""A patient's scene as the text of a TOML file, with the reasons of its numbers."""

import json
import math

from surgsim_env.patient.materials import TissueMaterial
from surgsim_env.patient.patient_scene import (
    CELL_PER_CONTACT_RADIUS,
    HARD_PER_PRESS,
    SITES_MOST,
    SOFT_PER_PRESS,
    PatientScene,
)
from surgsim_env.patient.toml_lines import comment, entry
from surgsim_env.scenes import LesionDraw, Scene

# By this first line an earlier run's file is known, which may be replaced.
FIRST_LINE = "# Made by surgsim from a patient's organ."


def scene_text(found: PatientScene) -> str:
    """The text of a scene file; `surgsim_env.scenes.load_scene` reads it."""
    patient, scene = found.patient, found.scene
    tets, lines = scene.mesh.tets, [FIRST_LINE]
    assert tets is not None
    lines += [
        f"# From {comment(', '.join(patient.sources))}.",
        f"# Mesh: {patient.mesher}, cells of {patient.cell_size * 1e3:.4g} mm.",
        f"# Axes: {patient.convention}.",
        "# Change any number here; surgsim organ replaces this file only if it begins as it does.",
        *(f"# Note: {comment(note)}" for note in (*patient.notes, *found.notes)),
        entry("description", scene.description),
        *_retraction(scene),
        "",
        "[mesh.tets]",
        entry("file", tets.file),
        entry("length_unit", tets.length_unit),
        "",
        *tissue_lines(found, scene),
    ]
    return "\n".join([*lines, *_anchors(scene), *_touch(found), ""])


def _retraction(scene: Scene) -> list[str]:
    if scene.retract_scene is not None:
        return [entry("retract_scene", scene.retract_scene, "which environments of retraction take")]
    if scene.retract_refusal is not None:
        return [entry("retract_refusal", scene.retract_refusal)]
    return []


def tissue_lines(found: PatientScene, scene: Scene) -> list[str]:
    """Materials, regions, capsule and damping of a scene of the organ."""
    lines = [
        "[material]             # " + comment(f"{found.patient.organ_name}: {found.organ.source}"),
        *_material(found.organ),
    ]
    for region in scene.regions:
        what = found.regions[region.name]
        lines += [
            "",
            "[[regions]]            # tets of the mesh with a material of their own",
            entry("name", region.name),
        ]
        if region.lesion:
            lines.append(entry("lesion", True, "palpation looks for it; healthy organs do not have it"))
        lines += [f"[regions.material]     # {comment(what.source)}", *_material(what)]
    return lines + _shell(scene)


def _shell(scene: Scene) -> list[str]:
    capsule = scene.capsule
    assert capsule is not None and capsule.thickness is not None
    return [
        "",
        "[capsule]              # on the boundary; as in the scene liver, with its sources; delete it where none is",
        entry("youngs_modulus", capsule.youngs_modulus, "[Pa]"),
        entry("thickness", capsule.thickness, "[m]; only modulus x thickness matters"),
        "",
        "[damping]              # as in the scene liver",
        entry("alpha", scene.damping.alpha, "[1/s]"),
        entry("beta", scene.damping.beta),
    ]


def _anchors(scene: Scene) -> list[str]:
    lines = []
    for anchor in scene.anchors:
        lines += ["", "[[anchors]]", entry("name", anchor.name)]
        if anchor.bed is not None:
            shown = f"{{ direction = {json.dumps(anchor.bed.direction)}, share = {anchor.bed.share!r} }}"
            lines.append(f"bed = {shown} # chosen: it lies on the side away from the probe; put its ligaments here")
        else:
            assert anchor.ball is not None
            centre = json.dumps(anchor.ball.centre)
            lines.append(f"ball = {{ centre = {centre}, radius = {anchor.ball.radius!r} }} # given on the command line")
    return lines


def _touch(found: PatientScene) -> list[str]:
    scene = found.scene
    return [
        "",
        "[contact]",
        entry("stiffness", scene.contact.stiffness, "[N/m^3] chosen: 18 E / cell"),
        entry("damping", scene.contact.damping, "[N s/m^3] as in the scene liver"),
        entry("friction", scene.contact.friction, "as in the scene liver"),
        *_instrument(found),
        "",
        f"[limits]               # [N] chosen: {SOFT_PER_PRESS:g} and {HARD_PER_PRESS:g} times a healthy press (Hertz)",
        entry("soft_force", scene.limits.soft_force),
        entry("hard_force", scene.limits.hard_force),
        "",
        "[sensor]               # per axis, as in the scene liver",
        entry("noise", scene.sensor.noise, "[N]"),
        entry("bias", scene.sensor.bias, "[N]"),
        entry("range", scene.sensor.range, "[N]"),
        *_palpation(found),
        *(_lesion(scene.lesion) if scene.lesion else []),
    ]


def _instrument(found: PatientScene) -> list[str]:
    instrument, timing, depth = found.scene.instrument, found.scene.timing, found.scene.palpation.press_depth
    share = found.anatomy.palpable_cell / math.sqrt(instrument.tip_radius * depth)
    why = f"[m] chosen for the cells: cell / contact radius {share:.2f}, asked for {CELL_PER_CONTACT_RADIUS}"
    return [
        "",
        "[instrument]",
        entry("model", instrument.model),
        entry("tip_radius", instrument.tip_radius, why),
        entry("approach", instrument.approach, "direction of the probe, in the axes above"),
        "",
        "[timing]",
        entry("haptic_step", timing.haptic_step, "[s]"),
        entry("substep_count", timing.substep_count, "stable with contact, every lesion here and the worst drawn"),
        entry("haptic_steps_per_control", timing.haptic_steps_per_control),
    ]


def _palpation(found: PatientScene) -> list[str]:
    palpation = found.scene.palpation
    sites = f"[m] {found.site_count} sites, at most {SITES_MOST} unless given"
    return [
        "",
        "[palpation]",
        entry("press_depth", palpation.press_depth, "[m] chosen: 7/12 of the tip's radius, as in the scene liver"),
        entry("face_angle_deg", palpation.face_angle_deg),
        entry("face_margin", palpation.face_margin, "[m]"),
        entry("thickness_smallest", palpation.thickness_smallest, "[m] of organ below a site"),
        entry("site_spacing", palpation.site_spacing, sites),
        entry("clearance", palpation.clearance, "[m]"),
    ]


def _lesion(draw: LesionDraw) -> list[str]:
    return [
        "",
        "[lesion]               # hidden anew in each episode, in the organ without its segmented lesions",
        entry("radius", draw.radius, "[m] chosen in proportion to the tip, as in the scene liver"),
        entry("cover", draw.cover, "[m] tissue above its top"),
        entry(
            "modulus_ratio", draw.modulus_ratio, "HCC 51, metastases 50 in 6.6 kPa liver (doi 10.1177/8756479317733713)"
        ),
        entry("rim_distance", draw.rim_distance, "[m]"),
    ]


def _material(what: TissueMaterial) -> list[str]:
    return [
        entry("youngs_modulus", what.material.youngs_modulus, "[Pa]"),
        entry("density", what.material.density, "[kg/m^3] a common textbook value, not checked against a source"),
        entry("poisson_ratio", what.material.poisson_ratio, "chosen: nearly incompressible"),
    ]
