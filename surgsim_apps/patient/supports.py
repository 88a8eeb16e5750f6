"""Supports of a patient's organ: fat on the side away from the probe, attachments by the organ's name."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from msdm_core.arithmetic import matmul, norm
from msdm_core.mesh import FloatArray, TetMesh
from surgsim_env.scene import Anchor, Ball, Side, Vector

# Fat around an organ but for the side of the probe: E / h and E / 3h of 8 mm of it (chosen).
# E is 3 x 752 Pa, by the shear modulus of unloaded human fat in MR elastography at 50 Hz (gluteal, J Mech Behav Biomed
# Mater 2023, "Strain-dependent shear properties of human adipose tissue in vivo"); in pigs 3 x 530 Pa (doi
# 10.1007/s10237-010-0207-9).
FAT_STIFFNESS, FAT_SHEAR_STIFFNESS = 2.8e5, 9.4e4
# It reaches around the flanks: largest angle between outward normal and approach [degrees].
FAT_ANGLE = 110.0
FAT_SOURCE = (
    "[N/m^3] E / h, and E / 3h across, of a layer of fat, h 8 mm (chosen), E 3 x 752 Pa (human, MR elastography 2023)"
)
FAT_NAME = "surrounding fat and wall"

# Stiffness of ligaments and of a hilum, per area [N/m^3]: chosen, four times that of fat: 1 mm under 1 kPa.
LIGAMENT_STIFFNESS, LIGAMENT_SHEAR_STIFFNESS = 1.0e6, 3.3e5
LIGAMENT_SOURCE = "[N/m^3] chosen, four times that of fat; no source was found; place and size are chosen: edit them"
PLACE_DIGITS = 4


@dataclass(frozen=True)
class Attachment:
    """Anatomical attachment of an organ.

    Args:
        name: of the tissue.
        direction: from the organ's middle in the axes of a scan: x to the patient's left, y to the back, z to the head.
        radius: of a ball around the surface point there, over the organ's largest extent.
    """

    name: str
    direction: Vector
    radius: float


# Names of the fat around organs, and their attachments, by a word of the organ's name.
FAT_NAMES: Mapping[str, str] = {"kidney": "perirenal fat and Gerota's fascia"}
ATTACHMENTS: Mapping[str, tuple[Attachment, ...]] = {
    "liver": (
        Attachment("bare area and coronary ligaments", (-0.35, 0.75, 0.55), 0.16),
        Attachment("falciform ligament", (0.15, -0.2, 0.97), 0.06),
    ),
    "spleen": (Attachment("hilum", (-0.9, -0.4, 0.0), 0.14),),
    "kidney": (Attachment("hilum", (-1.0, -0.3, 0.0), 0.10),),
}


def soft_bed(approach: Vector, name: str = FAT_NAME) -> Anchor:
    """Fat over the side away from the probe and the flanks."""
    return Anchor(name, side=Side(approach, FAT_ANGLE), stiffness=FAT_STIFFNESS, shear_stiffness=FAT_SHEAR_STIFFNESS)


def organ_anchors(
    organ_name: str, mesh: TetMesh, approach: Vector, *, is_scan: bool
) -> tuple[tuple[Anchor, ...], dict[str, str]]:
    """Anchors of a patient's organ, and the sources of their numbers by the path of their entry in a scene.

    Attachments need the axes of a scan: the axes of a surface do not tell the back, and fat alone holds it.

    Args:
        organ_name: such as "left kidney".
        mesh: of the organ.
        approach: of the probe, of length 1.
        is_scan: true for the axes of a scan.
    """
    word = next((name for name in ATTACHMENTS if name in organ_name.lower()), "")
    anchors = [soft_bed(approach, FAT_NAMES.get(word, FAT_NAME))]
    sources = {"anchors[0].stiffness": FAT_SOURCE, "anchors[0].side": "away from the probe"}
    for attachment in ATTACHMENTS.get(word, ()) if is_scan else ():
        direction = np.array(attachment.direction)
        if word == "kidney" and "right" in organ_name.lower():
            direction[0] *= -1.0
        x, y, z = np.round(_surface_point(mesh, direction), PLACE_DIGITS).tolist()
        radius = round(attachment.radius * float(np.ptp(mesh.points, axis=0).max()), PLACE_DIGITS)
        sources[f"anchors[{len(anchors)}].stiffness"] = LIGAMENT_SOURCE
        place, along, across = Ball((x, y, z), radius), LIGAMENT_STIFFNESS, LIGAMENT_SHEAR_STIFFNESS
        anchors.append(Anchor(attachment.name, ball=place, stiffness=along, shear_stiffness=across))
    return tuple(anchors), sources


def _surface_point(mesh: TetMesh, direction: FloatArray) -> FloatArray:
    """Surface node [m] (3,) nearest in angle to a direction from the organ's centroid."""
    centre = matmul(mesh.volumes, mesh.points[mesh.tets].mean(axis=1)) / mesh.volumes.sum()
    surface = mesh.points[mesh.boundary_nodes]
    away = surface - centre
    return surface[int(np.argmax(matmul(away, direction) / norm(away, axis=1)))]


def held_text(anchor: Anchor) -> str:
    """An anchor in words, for reports."""
    if anchor.stiffness is None or anchor.shear_stiffness is None:
        return f"{anchor.name}: fixed"
    return f"{anchor.name}: {anchor.stiffness:g} N/m^3 along the normal, {anchor.shear_stiffness:g} N/m^3 across"
