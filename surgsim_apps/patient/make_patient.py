"""A patient's organ from files: mesh and scene made, summary printed, mesh, scenes and report written."""

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from msdm_core.mesh_files import SURFACE_SUFFIXES, LengthUnit
from surgsim_apps.palpate.hold import SITES as HOLD_SITES
from surgsim_apps.palpate.hold import check_hold
from surgsim_apps.palpate.job import plan_sites
from surgsim_apps.palpate.scene_options import PATTERN, SceneOptions, check_options
from surgsim_apps.patient.facing import facing_approach
from surgsim_apps.patient.fine_surface import SurfaceFit, surface_file
from surgsim_apps.patient.label_image import FORM, LabelImage, is_image, parse_labels, read_label_image
from surgsim_apps.patient.materials import is_lesion, organ_material
from surgsim_apps.patient.meshers import (
    Cells,
    PatientMesh,
    PatientSurfaces,
    file_surface,
    image_surface,
    image_volume,
    mesh_image,
    mesh_surfaces,
    read_surfaces,
)
from surgsim_apps.patient.patient_scene import (
    HARD_PER_PRESS,
    SITES_MOST,
    SOFT_PER_PRESS,
    PatientScene,
    approach_of,
    patient_scene,
)
from surgsim_apps.patient.report import report_page
from surgsim_apps.patient.retract_scene import BED_GAP, BED_INSIDE, MODULUS_SPREAD, RetractScene, find_retraction
from surgsim_apps.patient.tet_files import PatientTets, patient_of_tets, read_tets, surfaces_of_tets
from surgsim_apps.patient.touch import plan_text, plan_touch
from surgsim_apps.reports.output_folder import OutputFolder, output_folder
from surgsim_env.palpation import healthy_file, write_healthy_map
from surgsim_env.scene import (
    Scene,
    load_scene,
    make_scene,
    scene_toml,
    share_text,
    warn_of_coarse_cells,
    with_added_mass,
)
from surgsim_env.step_progress import StepProgress

MESHERS = ("lattice", "tetwild")
REPORT_NAME = "report.html"
SCENE_MARK = "Made by surgsim from a patient's organ."


def make_patient(
    files: Sequence[Path],
    out: Path,
    *,
    labels: str | None = None,
    length_unit: LengthUnit | None = None,
    cell_size: float | None = None,
    mesher: str = MESHERS[0],
    mend: bool = False,
    remesh: bool = False,
    options: SceneOptions,
    moduli: Mapping[str, float] | None = None,
    progress: StepProgress,
) -> PatientScene:
    """Mesh an organ and make its palpation scene; writes nothing.

    Args:
        files: a label image; or closed surfaces, the organ's first, then one for each region; or one file of tets.
        out: path of the mesh to be written; its stem names the scene.
        labels: which labels of an image, or tags of tets, are which tissue, as in `parse_labels`.
        length_unit: of surfaces.
        cell_size: of the lattice, the same everywhere [m], from which the tip follows; default: cells follow from the
            tip, fine at the pressed face.
        mesher: one of MESHERS.
        mend: whether holes, self-intersections and cavities are repaired.
        remesh: whether the surfaces of tets are filled anew; else the file's tets are kept.
        options: touch and healthy tissue.
        moduli: Young's modulus of regions by name [Pa].
        progress: where the steps are shown.

    Raises:
        MeshError: a file that cannot become an organ.
        ValueError: arguments that do not go together, or values out of range.
    """
    from msdm_core.mesh_files import FORMATS

    if mesher not in MESHERS:
        raise ValueError(f"--mesher is {mesher!r}; it must be {' or '.join(MESHERS)}")
    check_options(options)
    if cell_size is not None and not 0.0 < cell_size < math.inf:
        raise ValueError(f"cell_size is {cell_size:g}; the rule is a positive length in metres")
    first = files[0]
    if is_image(first):
        if len(files) > 1:
            raise ValueError(f"{first}: one image is taken, {len(files)} files are given")
        if labels is None:
            raise ValueError(f"{first}: which labels are the organ? Give {FORM}")
        with progress.step(f"reading {first.name}"):
            given = read_label_image(first, parse_labels(labels))
        name, volume = given.names[0], image_volume(given)
    elif first.suffix.lower() in FORMATS:
        if len(files) > 1:
            raise ValueError(f"{first}: one file of tets is taken, {len(files)} are given")
        with progress.step(f"reading {first.name}"):
            given = read_tets(first, length_unit, parse_labels(labels) if labels is not None else ())
            if remesh:
                given = surfaces_of_tets(given)
        name, volume = given.organ.name if isinstance(given, PatientSurfaces) else given.names[0], given.volume
    else:
        wrong = [file for file in files if file.suffix.lower() not in SURFACE_SUFFIXES]
        if wrong:
            raise ValueError(f"{wrong[0]}: is no surface; beside {first} only {', '.join(SURFACE_SUFFIXES)} are taken")
        if length_unit is None:
            raise ValueError(
                f'{first}: needs --length-unit: "m", "cm", "mm" or metres per unit; its format states none'
            )
        with progress.step(f"reading {first.name}"):
            given = read_surfaces(files, length_unit, mend=mend)
        name, volume = given.organ.name, given.volume
    approach, angle = approach_of(options, is_scan=is_image(first)), make_scene(PATTERN).palpation.face_angle_deg
    if isinstance(given, PatientTets):
        touch = replace(
            plan_touch(volume, options, cell_size=given.face_cell(approach, angle), graded=False),
            known_node_count=given.mesh.node_count,
        )
    else:
        touch = plan_touch(volume, options, cell_size=cell_size, graded=mesher == MESHERS[0])
    progress.say(plan_text(touch, organ_material(name, options.youngs_modulus).material, approach))
    cells = Cells(touch.cell_size, touch.is_given, touch.coarsening, touch.fine_depth, approach, angle)
    if options.approach is None and touch.coarsening > 1 and _has_lesions(given):
        # Where the probe comes from follows from the lesions, and where cells are fine from that.
        with progress.step("turning the probe to the lesions"):
            rough = replace(cells, size=touch.coarsening * touch.cell_size, is_given=True, coarsening=1)
            approach = facing_approach(_meshed(given, first.name, rough, mesher, mend), approach, angle)
        options, cells = replace(options, approach=approach), replace(cells, approach=approach)
    with progress.step("filling it with tets"):
        mesh = _meshed(given, first.name, cells, mesher, mend)
    with progress.step("fitting its own surface to the tets"):
        mesh = replace(mesh, surface=_own_surface(given, mesh, mend))
    with progress.step("choosing sites, lesions and the step"):
        return patient_scene(mesh, out, touch=touch, options=options, moduli=moduli or {})


def with_hold(found: PatientScene, progress: StepProgress) -> PatientScene:
    """The organ with a check of what holds it: a few healthy presses, with a bar; what is wrong is one of the notes."""
    sites, normals, _ = plan_sites(found.anatomy)
    with progress.step("pressing what holds it", min(HOLD_SITES, len(sites))) as advance:
        quick = with_added_mass(found.anatomy, lambda one: [one.organ()])
        hold = check_hold(quick, sites, normals, progress=lambda: advance(1))
    faults = ("no press of the healthy organ reached its depth",) if hold is None else hold.faults
    return replace(found, hold=hold, notes=(*found.notes, *faults))


def _meshed(
    given: LabelImage | PatientSurfaces | PatientTets, source: str, cells: Cells, mesher: str, mend: bool
) -> PatientMesh:
    if isinstance(given, PatientTets):
        return patient_of_tets(given, cells.size)
    if isinstance(given, PatientSurfaces):
        return mesh_surfaces(given, cells=cells, mesher=mesher)
    return mesh_image(given, source, cells=cells, mesher=mesher, mend=mend)


def _own_surface(given: LabelImage | PatientSurfaces | PatientTets, mesh: PatientMesh, mend: bool) -> SurfaceFit | None:
    """The surface that is drawn; None for tets of a file, whose boundary is the organ's surface."""
    if isinstance(given, PatientTets):
        return None
    return file_surface(given, mesh) if isinstance(given, PatientSurfaces) else image_surface(given, mesh, mend=mend)


def _has_lesions(given: LabelImage | PatientSurfaces | PatientTets) -> bool:
    names = [one.name for one in given.inner] if isinstance(given, PatientSurfaces) else given.names[1:]
    return any(map(is_lesion, names))


def add_retraction(found: PatientScene, out: Path) -> tuple[PatientScene, RetractScene | str]:
    """The organ with a reference to its retraction scene, and that scene; or the reason why there is none in both."""
    turned = _retract_file(out)
    made = find_retraction(found, turned)
    said = {"retract_refusal": made} if isinstance(made, str) else {"retract_scene": turned.with_suffix(".toml").name}
    return replace(found, anatomy=replace(found.anatomy, scene=replace(found.scene, **said))), made


def write_patient(
    found: PatientScene,
    out: Path,
    command: str,
    retraction: RetractScene | str | None = None,
    *,
    healthy_map: bool,
    progress: StepProgress,
) -> list[Path]:
    """Write the mesh, its scene, its surface, report.html, the retraction's files and the healthy map; all or none.

    Args:
        found: the organ with its scene.
        out: path of the mesh; the other files lie beside it.
        command: the command line that makes the organ, for the report.
        retraction: the retraction scene, or why there is none; None if it was not looked for.
        healthy_map: whether the healthy organ is pressed for the map of `SurgSim/PalpateSites-v0`.
        progress: where the steps are shown.

    Returns:
        The paths of the files.

    Warns:
        UserWarning: says why there is no healthy map.
    """
    turned = _retract_file(out)
    healthy = healthy_file(out.with_suffix(".toml")).name
    # Those of an earlier run may be of an organ that is now replaced.
    optional = [turned, turned.with_suffix(".toml"), surface_file(out), surface_file(turned)]
    with output_folder(out.parent, [healthy, *(one.name for one in optional)]) as files:
        with progress.step("drawing the report"):
            names = _write_organ(found, files, out.name, command, retraction)
        if healthy_map and found.scene.lesion is not None:
            try:
                write_healthy_map(load_scene(files / out.with_suffix(".toml").name), files / healthy, progress)
                names.append(healthy)
            except ValueError as error:
                warnings.warn(
                    f"there is no map of the healthy organ, and SurgSim/PalpateSites-v0 refuses this one: {error}",
                    UserWarning,
                    stacklevel=2,
                )
    return [out.with_name(name) for name in names]


def _write_organ(
    found: PatientScene, files: OutputFolder, name: str, command: str, retraction: RetractScene | str | None
) -> list[str]:
    """Write all but the healthy map, by the name of the mesh; returns the names of the files."""
    from msdm_core.mesh_files import write_mesh

    scene_file = Path(name).with_suffix(".toml").name
    text = scene_text(found)
    write_mesh(files / name, found.patient.mesh)
    (files / scene_file).write_text(text, encoding="utf-8", newline="\n")
    written = [name, scene_file, REPORT_NAME]
    own = found.patient.surface
    if own is not None:
        written.append(surface_file(Path(name)).name)
        own.write(files / written[-1])
    # The report's pictures show the surface that lies beside the scene.
    placed = replace(found, anatomy=replace(found.anatomy, scene=load_scene(files / scene_file)))
    page = report_page(placed, text, scene_file, command, retraction)
    # What a page cannot show, such as bytes of a file's name that are not UTF-8, becomes a question mark.
    (files / REPORT_NAME).write_text(page, encoding="utf-8", errors="replace", newline="\n")
    if isinstance(retraction, RetractScene):
        turned = _retract_file(Path(name)).name
        lifted = Path(turned).with_suffix(".toml").name
        write_mesh(files / turned, retraction.anatomy.mesh)
        (files / lifted).write_text(retract_text(found, retraction), encoding="utf-8", newline="\n")
        load_scene(files / lifted)
        written += [turned, lifted]
        if own is not None:
            written.append(surface_file(Path(turned)).name)
            own.turned(retraction.origin, retraction.rim.frame).write(files / written[-1])
    return written


def _retract_file(out: Path) -> Path:
    """Path of the mesh of a retraction scene, beside the organ's."""
    return out.with_name(f"{out.stem}_retract{out.suffix}")


def check_target(out: Path) -> None:
    """Refuse, before the work, a mesh file in an unknown format or below what is no folder."""
    from msdm_core.mesh_files import WRITTEN_SUFFIX

    if out.suffix.lower() != WRITTEN_SUFFIX:
        raise ValueError(f"--out {out}: unknown extension {out.suffix!r}; meshes are written as {WRITTEN_SUFFIX}")
    place = next(one for one in out.absolute().parents if one.exists())
    if not (place.is_dir() and os.access(place, os.W_OK)):
        raise ValueError(f"--out {out}: {place} is no folder that you may write to; choose another place")


def print_patient(found: PatientScene, console: Console) -> None:
    """Print a summary of a patient's organ, and warn of what was dropped, repaired or is unusual."""
    patient, scene, cell = found.patient, found.scene, found.anatomy.palpable_cell
    title = ", ".join(patient.sources)
    touch = (scene.instrument.tip_radius, scene.palpation.press_depth)
    rows = {
        "nodes": f"{patient.mesh.node_count}",
        "tets": f"{patient.mesh.tet_count}",
        "volume": f"{patient.volumes[0].mesh * 1e6:.1f} ml (error {patient.volume_error:+.2%})",
    }
    if patient.surface is not None:
        rows["drawn surface"] = patient.surface.text
    if found.hold is not None:
        rows["held"] = found.hold.text
    for one in patient.volumes[1:]:
        modulus = found.regions[one.name].material.youngs_modulus
        rows[one.name] = f"{one.mesh * 1e6:.2f} ml (error {one.error:+.2%}), E {modulus:g} Pa"
    rows["cell / contact radius"] = share_text(cell, *touch)
    table = Table(title=title, show_header=False)
    for name, value in rows.items():
        table.add_row(name, value)
    console.print(table)
    warn_of_coarse_cells(title, cell, *touch)
    for note in (*patient.notes, *found.notes):
        warnings.warn(note, UserWarning, stacklevel=2)


def scene_text(found: PatientScene) -> str:
    """The text of a patient's palpation scene."""
    patient, scene = found.patient, found.scene
    instrument, depth = scene.instrument, scene.palpation.press_depth
    share = found.anatomy.palpable_cell / math.sqrt(instrument.tip_radius * depth)
    head = (
        SCENE_MARK,
        f"From {', '.join(patient.sources)}.",
        f"Mesh: {patient.mesher}, {patient.cells_text}.",
        f"Axes: {patient.convention}.",
        "Change any number here; surgsim organ replaces this file when it is run again with the same --out.",
        *(f"Note: {note}" for note in (*patient.notes, *found.notes)),
    )
    comments = {
        "retract_scene": "used by the retraction environments",
        "cranial": "where the head is, for motions" if patient.is_scan else "where the head is: chosen, for motions",
        **found.anchor_sources,
        "mesh.fine_surface": "what pictures and the live page draw; delete it to see the boundary of the tets",
        "contact.stiffness": "[N/m^3] chosen: 18 E / cell",
        "contact.damping": "[N s/m^3] as in the scene liver",
        "contact.friction": "as in the scene liver",
        "instrument.tip_radius": f"[m] chosen with the cells: cell / contact radius {share:.2f}",
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
        "palpation.site_spacing": f"[m] {found.site_count} sites, at most {SITES_MOST}",
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
    rows = "; ".join(", ".join(f"{value:.6f}" for value in row) for row in made.rim.frame.T)
    place = ", ".join(f"{value:.6f}" for value in made.origin)
    head = (
        SCENE_MARK,
        f"The organ of {', '.join(found.patient.sources)}, turned so that a thin edge of it can be lifted.",
        "x runs along that edge, y out over it, z up; the bed's top is z = 0. A point p of the patient is here at",
        "R (p - o) [m], without any change of shape:",
        f"  o = ({place}), R = ({rows}), one row each.",
        f"The edge is {made.rim.thickness * 1e3:.0f} mm thick where a jaw takes it. Only the flap around it moves.",
    )
    comments = {
        "gravity": "a scan shows the organ under its weight: that shape is its rest here",
        "cranial": "where the head is, for motions",
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
