"""Scene files of a patient's organ, with sources and units in comments."""

import math

from surgsim_apps.patient.patient_scene import LAYOUT as PALPATION
from surgsim_apps.patient.patient_scene import PatientScene
from surgsim_apps.patient.retract_scene import LAYOUT as RETRACT
from surgsim_apps.patient.retract_scene import RetractScene
from surgsim_env.scene import Scene, as_toml

SCENE_MARK = "Made by surgsim from a patient's organ."


def scene_text(organ: PatientScene) -> str:
    """Text of the palpation scene."""
    patient, scene = organ.patient, organ.scene
    instrument, depth = scene.instrument, scene.palpation.press_depth
    share = organ.anatomy.palpable_cell / math.sqrt(instrument.tip_radius * depth)
    head = (
        SCENE_MARK,
        f"From {', '.join(patient.sources)}.",
        f"Mesh: {patient.mesher}, {patient.cells_text}.",
        f"Axes: {patient.convention}.",
        "Change any number here; surgsim organ replaces this file when it is run again with the same --out.",
        *(f"Note: {note}" for note in organ.notes),
    )
    comments = {
        "retract_scene": "used by the retraction environments",
        "cranial": "where the head is, for motions" if patient.is_scan else "where the head is: chosen, for motions",
        **organ.anchor_sources,
        "mesh.fine_surface": "what pictures and the live page draw; delete it to see the boundary of the tets",
        "contact.stiffness": "[N/m^3] chosen: 200 E / contact radius with the E that a press feels, at most 2.5e8",
        "contact.damping": "[N s/m^3] as in the scene liver",
        "contact.friction": "as in the scene liver",
        "instrument.tip_radius": f"[m] chosen with the cells: cell / contact radius {share:.2f}",
        "instrument.approach": "direction of the probe, in the axes above",
        "timing.haptic_step": "[s]",
        "timing.substep_count": "stable with contact, by a little added mass also with the stiffest lesions",
        "limits": f"[N] chosen: {PALPATION.soft_per_press:g} and {PALPATION.hard_per_press:g} times a healthy press "
        "(Hertz)",
        "sensor": "per axis, as in the scene liver",
        "sensor.noise": "[N]",
        "sensor.bias": "[N]",
        "sensor.range": "[N]",
        "palpation.press_depth": "[m] chosen: 7/12 of the tip's radius, as in the scene liver",
        "palpation.face_margin": "[m]",
        "palpation.thickness_smallest": "[m] of organ below a site",
        "palpation.site_spacing": f"[m] {organ.site_count} sites, at most {PALPATION.sites_most}",
        "palpation.clearance": "[m]",
        "lesion": "drawn anew in each episode, in the organ without its segmented lesions",
        "lesion.radius": "[m] chosen in proportion to the tip, as in the scene liver",
        "lesion.cover": "[m] tissue above its top",
        "lesion.modulus_ratio": "HCC 51, metastases 50 in 6.6 kPa liver (doi 10.1177/8756479317733713)",
        "lesion.rim_distance": "[m]",
    }
    return as_toml(scene, head=head, comments={**_tissue_comments(organ, scene), **comments})


def retract_text(organ: PatientScene, retraction: RetractScene) -> str:
    """Text of the retraction scene."""
    rim = retraction.rim
    rows = "; ".join(", ".join(f"{value:.6f}" for value in row) for row in rim.frame.T)
    place = ", ".join(f"{value:.6f}" for value in retraction.origin)
    head = (
        SCENE_MARK,
        f"The organ of {', '.join(organ.patient.sources)}, turned so that a thin edge of it can be lifted.",
        "x runs along that edge, y out over it, z up; the bed's top is z = 0. A point p of the patient is here at",
        "R (p - o) [m], without any change of shape:",
        f"  o = ({place}), R = ({rows}), one row each.",
        f"The edge is {rim.thickness * 1e3:.0f} mm thick where a jaw takes it. Only the flap around it moves.",
    )
    comments = {
        "gravity": "a scan shows the organ under its weight: that shape is its rest here",
        "cranial": "where the head is, for motions",
        "anchors": "chosen: all but the flap is held",
        "supports": f"chosen: it ends {RETRACT.bed_inside * 1e3:g} mm inside the edge, so that a jaw gets around the "
        "edge",
        "supports.position": f"[m] its top {RETRACT.bed_gap * 1e3:g} mm below the lowest of the organ above it",
        "supports.friction": "as in the scene lobe",
        "contact": "of tools and of the bed, as in the scene lobe: as stiff as light fingers bear",
        "instrument": "the jaw points along the middle of the edge",
        "instrument.tip_radius": "[m] chosen: of a right arm's ball, wider than its neck",
        "port": "as in the scene lobe, at the same distance from the edge",
        "ports": "as in the scene lobe, at the same distance from the edge",
        "limits": "[N] as in the scene lobe: they follow from the holding force of its jaw",
        "sensor": "[N] per axis, as in the scene lobe",
        "palpation": "not used: the organ is pressed in its palpation scene",
        "endoscope": "on the free side; chosen so that the target is visible once the edge is lifted",
        "retract": "drawn anew in each episode",
        "retract.target_distance": "[m] behind the bed's border, hidden at rest",
        "retract.start_lower": "[m] at the same distance from the edge as in the scene lobe",
        "retract.scale": "a patient's organ has its size",
        "retract.youngs_modulus": f"[Pa] +-{RETRACT.modulus_spread:.0%}: normal liver 6.63 +- 1.65 kPa "
        "(doi 10.1177/8756479317733713)",
        "retract.capsule_share": "the capsule is the organ's own, above",
        "retract.flap": "[m] the part that is lifted",
        "retract.camera": "[m], degrees",
    }
    scene = retraction.anatomy.scene
    return as_toml(scene, head=head, comments={**_tissue_comments(organ, scene), **comments})


def _tissue_comments(organ: PatientScene, scene: Scene) -> dict[str, str]:
    """Sources and units of materials, regions, capsule and damping."""
    comments = {
        "material": f"{organ.patient.organ_name}: {organ.tissue.source}",
        "regions": "tets of the mesh with a material of their own",
        "regions.lesion": "whether palpation looks for it; healthy organs do not have it then",
        "capsule": "on the boundary; as in the scene liver, with its sources; delete it for an organ without one",
        "capsule.youngs_modulus": "[Pa]",
        "capsule.thickness": "[m]; only modulus x thickness matters",
        "damping": "as in the scene liver",
        "damping.alpha": "[1/s]",
        "damping.beta": "[s]",
    }
    for table in ("material", "regions.material"):
        comments[f"{table}.youngs_modulus"] = "[Pa] at equilibrium"
        comments[f"{table}.density"] = "[kg/m^3] a common textbook value, not checked against a source"
        comments[f"{table}.relaxation"] = "as pig liver relaxes (scenes/materials/pig_liver_ex_vivo_relaxing.toml)"
        comments[f"{table}.relaxation.times"] = "[s]"
        comments[f"{table}.poisson_ratio"] = "chosen: nearly incompressible"
    for number, region in enumerate(scene.regions):
        comments[f"regions[{number}].material"] = organ.regions[region.name].source
    return comments
