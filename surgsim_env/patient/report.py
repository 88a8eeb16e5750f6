"""report.html of a patient's organ: what came of the file, in one page."""

from html import escape

import numpy as np

from msdm_core.organ import compile_organ
from msdm_core.quality import mesh_quality
from msdm_core.stability import stable_dt
from surgsim_env.cell_share import share_text
from surgsim_env.html_page import html_page, html_picture, html_table, page_start
from surgsim_env.patient.patient_mesh import DIHEDRAL_SMALLEST
from surgsim_env.patient.patient_scene import PatientScene, material_rows
from surgsim_env.patient.pictures import organ_picture, quality_picture
from surgsim_env.patient.retract_scene import RetractScene, told

# By this an earlier run's report is known, which may be replaced.
GENERATOR = "surgsim organ"
MARK = page_start(GENERATOR)
VOLUME_ERROR_LARGEST = 0.02


def report_page(
    found: PatientScene, scene_text: str, scene_file: str, command: str, retraction: RetractScene | str | None = None
) -> str:
    """The page's text.

    Args:
        found: the organ with its scene.
        scene_text: the scene as it is written.
        scene_file: its file's name.
        command: that makes this report.
        retraction: its scene, or why there is none; None where nobody looked.
    """
    patient = found.patient
    whole = html_picture(
        organ_picture(found),
        "From three sides",
        "Above the whole organ, below cut open through the middle of its largest region; the part nearer to the viewer "
        "is taken away. Lighter: the face that the probe can press; grey: what is held.",
    )
    tets = html_picture(quality_picture(patient.mesh), "Tets", "How well shaped they are; counts are logarithmic.")
    sections = [
        ("notes", "What was dropped, mended or is odd", _notes(found)),
        ("volumes", "From the file to the mesh", _source(found) + _volumes(found)),
        ("pictures", "Pictures", whole),
        ("mesh", "Mesh", _mesh(found) + tets),
        ("tissue", "Tissue, masses and step", _tissue(found) + _step(found)),
        ("touch", "How it is palpated", _touch(found)),
        ("retraction", "How it is retracted", "" if retraction is None else f"<p>{escape(told(retraction))}</p>"),
        ("scene", f"The scene, {scene_file}", f"<pre><code>{escape(scene_text)}</code></pre>"),
        ("command", "The command that made this report", f"<pre><code>{escape(command)}</code></pre>"),
    ]
    shown = [one for one in sections if one[2]]
    return html_page(f"Organ: {found.scene.description}", verdict(found), shown, generator=GENERATOR)


def verdict(found: PatientScene) -> str:
    """What matters most, in a sentence or two."""
    patient, quality = found.patient, mesh_quality(found.patient.mesh)
    fits = abs(patient.volume_error) <= VOLUME_ERROR_LARGEST
    shaped = quality.dihedral_smallest_deg >= DIHEDRAL_SMALLEST
    said = (
        f"{quality.tet_count} tets hold {quality.volume * 1e6:.1f} ml, {patient.volume_error:+.2%} of what the file has"
        f"{'' if fits else ' (more than 2 %: use smaller cells)'}; the smallest dihedral angle is "
        f"{quality.dihedral_smallest_deg:.1f} degrees{'' if shaped else ' (below 10: the step is short for it)'}."
    )
    count = len(patient.lesions)
    said += (
        f" {count} segmented lesion{'s are' if count != 1 else ' is'} in it." if count else " No lesion was segmented."
    )
    remarks = len(patient.notes) + len(found.notes)
    return said + (f" {remarks} thing{'s' if remarks != 1 else ''} to know, below." if remarks else "")


def _notes(found: PatientScene) -> str:
    notes = [*found.patient.notes, *found.notes]
    return "<ul>" + "".join(f"<li>{escape(note)}</li>" for note in notes) + "</ul>" if notes else ""


def _source(found: PatientScene) -> str:
    patient = found.patient
    rows = [
        ("files", ", ".join(patient.sources)),
        ("axes", patient.convention),
        ("mesher", f"{patient.mesher}, cells of {patient.cell_size * 1e3:.4g} mm"),
    ]
    if patient.smoothing is not None and patient.smoothing_change is not None:
        rows.append(
            (
                "smoothing",
                f"Gaussian of {patient.smoothing * 1e3:.3g} mm; by itself it changed the volume by "
                f"{patient.smoothing_change:+.2%}, which the level was moved to make up for",
            )
        )
    return html_table("Where it comes from", ("", ""), rows)


def _volumes(found: PatientScene) -> str:
    rows = [
        (
            f"{one.name}{' (whole)' if number == 0 else ''}",
            f"{one.source * 1e6:.2f} ml",
            f"{one.mesh * 1e6:.2f} ml",
            f"{one.error:+.2%}",
        )
        for number, one in enumerate(found.patient.volumes)
    ]
    return html_table("Volumes", ("", "in the file", "in the mesh", "error"), rows)


def _mesh(found: PatientScene) -> str:
    mesh = found.patient.mesh
    quality = mesh_quality(mesh)
    x, y, z = np.ptp(mesh.points, axis=0) * 1e3
    low = " ".join(f"{value * 1e3:.1f}" for value in mesh.points.min(axis=0))
    rows = [
        ("nodes, tets, boundary triangles", f"{mesh.node_count}, {mesh.tet_count}, {quality.boundary_triangle_count}"),
        ("extent", f"{x:.1f} x {y:.1f} x {z:.1f} mm, from {low} mm"),
        ("dihedral angles", f"{quality.dihedral_smallest_deg:.1f} to {quality.dihedral_largest_deg:.1f} degrees"),
        ("radius ratio", f"from {quality.radius_ratio_smallest:.3f}"),
    ]
    return html_table("Counts and shape", ("", ""), rows)


def _tissue(found: PatientScene) -> str:
    rows = []
    for name, what, volume in material_rows(found):
        material = what.material
        rows.append(
            (
                name,
                f"{volume * 1e6:.2f} ml",
                f"{volume * material.density:.4f} kg",
                f"{material.youngs_modulus:g} Pa",
                f"{material.poisson_ratio:g}",
                what.source,
            )
        )
    heads = ("region", "volume", "mass", "Young's modulus", "Poisson's ratio", "where the modulus comes from")
    return html_table("Regions", heads, rows)


def _step(found: PatientScene) -> str:
    anatomy, scene = found.anatomy, found.scene
    organ = compile_organ(anatomy.specification(anatomy.demonstration_lesions()))
    capsule = scene.capsule
    shell = "none" if capsule is None else f"{capsule.youngs_modulus:g} Pa, {capsule.thickness or 0.0:g} m"
    rows = [
        ("mass of all", f"{organ.node_mass.sum():.4f} kg"),
        ("springs", f"{len(organ.spring_nodes)}"),
        ("nodes that are held", f"{len(anatomy.anchors)}: {', '.join(one.name for one in scene.anchors)}"),
        ("capsule", f"{shell}, over {len(organ.surface_triangles)} free boundary triangles"),
        (
            "stable step",
            f"{organ.stable_step * 1e3:.3f} ms, in contact {stable_dt(organ, scene.contact.law) * 1e3:.3f} ms",
        ),
        ("substeps in a haptic step of 1 ms", f"{scene.timing.substep_count}"),
    ]
    return html_table("The organ with its segmented lesions", ("", ""), rows)


def _touch(found: PatientScene) -> str:
    scene, palpation = found.scene, found.scene.palpation
    tip, depth = scene.instrument.tip_radius, palpation.press_depth
    x, y, z = scene.instrument.approach
    rows = [
        ("tip and press", f"ball of {tip * 1e3:g} mm radius, {depth * 1e3:g} mm deep"),
        ("approach", f"{x:g}, {y:g}, {z:g}"),
        ("sites", f"{found.site_count}, {palpation.site_spacing * 1e3:g} mm apart"),
        ("cell / contact radius", share_text(found.anatomy.palpable_cell, tip, depth)),
        ("force limits", f"{scene.limits.soft_force:g} and {scene.limits.hard_force:g} N"),
    ]
    return html_table("Palpation", ("", ""), rows)
