"""A patient's scenes as TOML texts, with the reasons for their values."""

import math

from surgsim_env.patient.patient_scene import (
    CELL_PER_CONTACT_RADIUS,
    HARD_PER_PRESS,
    SITES_MOST,
    SOFT_PER_PRESS,
    PatientScene,
)
from surgsim_env.patient.retract_scene import BED_GAP, BED_INSIDE, MODULUS_SPREAD, RetractScene
from surgsim_env.scene.model import Scene
from surgsim_env.scene.save import scene_toml

MARK = "Made by surgsim from a patient's organ."
# A file with this first line was written by an earlier run and may be replaced.
FIRST_LINE = f"# {MARK}"


def scene_text(found: PatientScene) -> str:
    """The text of a patient's palpation scene."""
    patient, scene = found.patient, found.scene
    instrument, depth = scene.instrument, scene.palpation.press_depth
    share = found.anatomy.palpable_cell / math.sqrt(instrument.tip_radius * depth)
    head = (
        MARK,
        f"From {', '.join(patient.sources)}.",
        f"Mesh: {patient.mesher}, cells of {patient.cell_size * 1e3:.4g} mm.",
        f"Axes: {patient.convention}.",
        "Change any number here; surgsim organ replaces this file only while its first line is unchanged.",
        *(f"Note: {note}" for note in (*patient.notes, *found.notes)),
    )
    comments = {
        "retract_scene": "used by the retraction environments",
        "anchors.bed": "chosen: it lies on the side away from the probe; put its ligaments here",
        "anchors.ball": "given on the command line",
        "contact.stiffness": "[N/m^3] chosen: 18 E / cell",
        "contact.damping": "[N s/m^3] as in the scene liver",
        "contact.friction": "as in the scene liver",
        "instrument.tip_radius": f"[m] chosen for the cells: cell / contact radius {share:.2f}, wanted "
        f"{CELL_PER_CONTACT_RADIUS}",
        "instrument.approach": "direction of the probe, in the axes above",
        "timing.haptic_step": "[s]",
        "timing.substep_count": "stable with contact, with all lesions here and the stiffest drawn one",
        "limits": f"[N] chosen: {SOFT_PER_PRESS:g} and {HARD_PER_PRESS:g} times a healthy press (Hertz)",
        "sensor": "per axis, as in the scene liver",
        "sensor.noise": "[N]",
        "sensor.bias": "[N]",
        "sensor.range": "[N]",
        "palpation.press_depth": "[m] chosen: 7/12 of the tip's radius, as in the scene liver",
        "palpation.face_margin": "[m]",
        "palpation.thickness_smallest": "[m] of organ below a site",
        "palpation.site_spacing": f"[m] {found.site_count} sites, at most {SITES_MOST} unless given",
        "palpation.clearance": "[m]",
        "lesion": "drawn anew in each episode, in the organ without its segmented lesions",
        "lesion.radius": "[m] chosen in proportion to the tip, as in the scene liver",
        "lesion.cover": "[m] tissue above its top",
        "lesion.modulus_ratio": "HCC 51, metastases 50 in 6.6 kPa liver (doi 10.1177/8756479317733713)",
        "lesion.rim_distance": "[m]",
    }
    return scene_toml(scene, head=head, comments={**_tissue_comments(found, scene), **comments})


def retract_text(found: PatientScene, made: RetractScene) -> str:
    """The text of a patient's retraction scene."""
    rows = "; ".join(", ".join(f"{value:.6f}" for value in row) for row in made.frame.T)
    place = ", ".join(f"{value:.6f}" for value in made.origin)
    head = (
        MARK,
        f"The organ of {', '.join(found.patient.sources)}, turned so that a thin edge of it can be lifted.",
        "x runs along that edge, y out over it, z up; the bed's top is z = 0. A point p of the patient is here at",
        "R (p - o) [m], without any change of shape:",
        f"  o = ({place}), R = ({rows}), one row each.",
        f"The edge is {made.rim.thickness * 1e3:.0f} mm thick where a jaw takes it. Only the flap around it moves.",
    )
    comments = {
        "gravity": "a scan shows the organ under its weight: that shape is its rest here",
        "anchors": "chosen: all but the flap is held",
        "supports": f"chosen: it ends {BED_INSIDE * 1e3:g} mm inside the edge, so that a jaw gets around the edge",
        "supports.position": f"[m] its top {BED_GAP * 1e3:g} mm below the lowest of the organ above it",
        "supports.friction": "as in the scene lobe",
        "contact": "of tools and of the bed",
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
        "retract.youngs_modulus": f"[Pa] +-{MODULUS_SPREAD:.0%}: normal liver 6.63 +- 1.65 kPa "
        "(doi 10.1177/8756479317733713)",
        "retract.capsule_share": "the capsule is the organ's own, above",
        "retract.flap": "[m] the part that is lifted",
        "retract.camera": "[m], degrees",
    }
    scene = made.anatomy.scene
    return scene_toml(scene, head=head, comments={**_tissue_comments(found, scene), **comments})


def _tissue_comments(found: PatientScene, scene: Scene) -> dict[str, str]:
    """Sources and units of materials, regions, capsule and damping."""
    comments = {
        "material": f"{found.patient.organ_name}: {found.organ.source}",
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
        comments[f"{table}.youngs_modulus"] = "[Pa]"
        comments[f"{table}.density"] = "[kg/m^3] a common textbook value, not checked against a source"
        comments[f"{table}.poisson_ratio"] = "chosen: nearly incompressible"
    for number, region in enumerate(scene.regions):
        comments[f"regions[{number}].material"] = found.regions[region.name].source
    return comments
