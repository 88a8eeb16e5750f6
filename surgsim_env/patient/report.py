"""report.html of a patient's organ: source, mesh, tissue, palpation and scene on one page."""

import numpy as np

from msdm_core.mesh.quality import mesh_quality
from msdm_core.organ.compile import compile_organ
from msdm_core.organ.stability import stable_dt
from surgsim_env.patient.patient_mesh import DIHEDRAL_SMALLEST
from surgsim_env.patient.patient_scene import PatientScene, material_rows
from surgsim_env.patient.pictures import organ_picture, quality_picture
from surgsim_env.patient.retract_scene import RetractScene, told
from surgsim_env.reports.html_page import Picture, page_start, render_page
from surgsim_env.scene.palpable_surface import share_text

# Identifies the report of an earlier run, which may be replaced.
GENERATOR = "surgsim organ"
MARK = page_start(GENERATOR)
VOLUME_ERROR_LARGEST = 0.02

# Cells of a table, the first of which names the row.
Rows = list[tuple[str, ...]]


def report_page(
    found: PatientScene, scene_text: str, scene_file: str, command: str, retraction: RetractScene | str | None = None
) -> str:
    """The page's text.

    Args:
        found: the organ with its scene.
        scene_text: the scene as it is written.
        scene_file: its file's name.
        command: the command that makes this report.
        retraction: its scene, or the reason why there is none; None where it was not looked for.
    """
    outside = (
        "Top: the whole organ; bottom: cut open through the middle of its largest region, without the part nearer to "
    )
    outside += "the viewer. Lighter: the face that the probe can press; grey: fixed tissue."
    quality = "Quality of the tets; counts are logarithmic."
    return render_page(
        "organ.html.j2",
        generator=GENERATOR,
        title=f"Organ: {found.scene.description}",
        verdict=verdict(found),
        notes=[*found.patient.notes, *found.notes],
        source=_source(found),
        volumes=_volumes(found),
        organ_picture=Picture("From three sides", outside, organ_picture(found)),
        mesh=_mesh(found),
        quality_picture=Picture("Tets", quality, quality_picture(found.patient.mesh)),
        regions=_regions(found),
        step=_step(found),
        palpation=_palpation(found),
        retraction=None if retraction is None else told(retraction),
        scene_text=scene_text,
        scene_file=scene_file,
        command=command,
    )


def verdict(found: PatientScene) -> str:
    """The most important results in a sentence or two."""
    patient, quality = found.patient, mesh_quality(found.patient.mesh)
    fits = abs(patient.volume_error) <= VOLUME_ERROR_LARGEST
    shaped = quality.dihedral_smallest_deg >= DIHEDRAL_SMALLEST
    said = (
        f"The mesh has {quality.tet_count} tets and {quality.volume * 1e6:.1f} ml, "
        f"{patient.volume_error:+.2%} against the file"
        f"{'' if fits else ' (more than 2 %: use smaller cells)'}; the smallest dihedral angle is "
        f"{quality.dihedral_smallest_deg:.1f} degrees{'' if shaped else ' (below 10: it makes the step short)'}."
    )
    count = len(patient.lesions)
    said += (
        f" {count} segmented lesion{'s are' if count != 1 else ' is'} in it." if count else " No lesion was segmented."
    )
    remarks = len(patient.notes) + len(found.notes)
    return said + (f" {remarks} remark{'s' if remarks != 1 else ''} below." if remarks else "")


def _source(found: PatientScene) -> Rows:
    patient = found.patient
    rows: Rows = [
        ("files", ", ".join(patient.sources)),
        ("axes", patient.convention),
        ("mesher", f"{patient.mesher}, cells of {patient.cell_size * 1e3:.4g} mm"),
    ]
    if patient.smoothing is not None and patient.smoothing_change is not None:
        rows.append(
            (
                "smoothing",
                f"Gaussian of {patient.smoothing * 1e3:.3g} mm; by itself it changed the volume by "
                f"{patient.smoothing_change:+.2%}, which a shift of the level corrects",
            )
        )
    return rows


def _volumes(found: PatientScene) -> Rows:
    return [
        (
            f"{one.name}{' (whole)' if number == 0 else ''}",
            f"{one.source * 1e6:.2f} ml",
            f"{one.mesh * 1e6:.2f} ml",
            f"{one.error:+.2%}",
        )
        for number, one in enumerate(found.patient.volumes)
    ]


def _mesh(found: PatientScene) -> Rows:
    mesh = found.patient.mesh
    quality = mesh_quality(mesh)
    x, y, z = np.ptp(mesh.points, axis=0) * 1e3
    low = " ".join(f"{value * 1e3:.1f}" for value in mesh.points.min(axis=0))
    return [
        ("nodes, tets, boundary triangles", f"{mesh.node_count}, {mesh.tet_count}, {quality.boundary_triangle_count}"),
        ("extent", f"{x:.1f} x {y:.1f} x {z:.1f} mm, from {low} mm"),
        ("dihedral angles", f"{quality.dihedral_smallest_deg:.1f} to {quality.dihedral_largest_deg:.1f} degrees"),
        ("radius ratio", f"from {quality.radius_ratio_smallest:.3f}"),
    ]


def _regions(found: PatientScene) -> Rows:
    rows: Rows = []
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
    return rows


def _step(found: PatientScene) -> Rows:
    anatomy, scene = found.anatomy, found.scene
    organ = compile_organ(anatomy.specification(anatomy.demonstration_lesions()))
    capsule = scene.capsule
    shell = "none" if capsule is None else f"{capsule.youngs_modulus:g} Pa, {capsule.thickness or 0.0:g} m"
    return [
        ("total mass", f"{organ.node_mass.sum():.4f} kg"),
        ("springs", f"{len(organ.spring_nodes)}"),
        ("fixed nodes", f"{len(anatomy.anchors)}: {', '.join(one.name for one in scene.anchors)}"),
        ("capsule", f"{shell}, over {len(organ.surface_triangles)} free boundary triangles"),
        (
            "stable step",
            f"{organ.stable_step * 1e3:.3f} ms, in contact {stable_dt(organ, scene.contact.law) * 1e3:.3f} ms",
        ),
        ("substeps in a haptic step of 1 ms", f"{scene.timing.substep_count}"),
    ]


def _palpation(found: PatientScene) -> Rows:
    scene, palpation = found.scene, found.scene.palpation
    tip, depth = scene.instrument.tip_radius, palpation.press_depth
    x, y, z = scene.instrument.approach
    return [
        ("tip and press", f"ball of {tip * 1e3:g} mm radius, {depth * 1e3:g} mm deep"),
        ("approach", f"{x:g}, {y:g}, {z:g}"),
        ("sites", f"{found.site_count}, {palpation.site_spacing * 1e3:g} mm apart"),
        ("cell / contact radius", share_text(found.anatomy.palpable_cell, tip, depth)),
        ("force limits", f"{scene.limits.soft_force:g} and {scene.limits.hard_force:g} N"),
    ]
