"""Patient's organ from files: mesh and scene, printed summary, files of mesh, scenes and report."""

import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from msdm_core.mesh_files import SURFACE_SUFFIXES, LengthUnit
from surgsim_apps.palpate.hold import SITES as HOLD_SITES
from surgsim_apps.palpate.hold import check_hold
from surgsim_apps.palpate.scene_options import SceneOptions, check_options
from surgsim_apps.palpate.sites import plan_sites
from surgsim_apps.patient.facing import facing_approach
from surgsim_apps.patient.fine_surface import SurfaceFit, surface_file
from surgsim_apps.patient.label_image import LabelImage, is_image, parse_labels, read_label_image
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
from surgsim_apps.patient.patient_scene import PATTERN, PatientScene, approach_of, patient_scene
from surgsim_apps.patient.report import report_page
from surgsim_apps.patient.retract_scene import RetractScene, find_retraction
from surgsim_apps.patient.scene_text import retract_text, scene_text
from surgsim_apps.patient.tet_files import PatientTets, patient_of_tets, read_tets, surfaces_of_tets
from surgsim_apps.patient.touch import check_touch, plan_text, plan_touch
from surgsim_apps.reports.output_folder import OutputFolder, output_folder
from surgsim_env.palpation import healthy_file, write_healthy_map
from surgsim_env.scene import load_scene, make_scene, share_text, warn_of_coarse_cells, with_added_mass
from surgsim_env.step_progress import StepProgress

# Contents of an organ's files.
OrganContents = LabelImage | PatientSurfaces | PatientTets
MESHERS = ("lattice", "tetwild")
REPORT_NAME = "report.html"


def make_patient(
    files: Sequence[Path],
    out: Path,
    *,
    labels: str | None = None,
    cell_data: str | None = None,
    length_unit: LengthUnit | None = None,
    cell_size: float | None = None,
    mesher: str = MESHERS[0],
    mend: bool = False,
    remesh: bool = False,
    options: SceneOptions,
    moduli: Mapping[str, float] | None = None,
    progress: StepProgress,
) -> PatientScene:
    """Meshed organ with its palpation scene.

    Args:
        files: a label image, or one for each tissue, the organ's first; or closed surfaces, the organ's first, then one
            for each region; or one file of tets.
        out: path of the mesh to be written; its stem names the scene.
        labels: tissues of an image's labels or of the tags of tets, as in `parse_labels`; of several images
            one each; default: the only label of each image.
        cell_data: name of the array with the tags of tets.
        length_unit: of surfaces.
        cell_size: of the lattice, the same everywhere [m], from which the tip follows; default: cells follow from the
            tip, fine at the pressed face.
        mesher: one of MESHERS.
        mend: repair holes, self-intersections and cavities.
        remesh: fill the surfaces of tets anew; else the file's tets are kept.
        options: touch and healthy tissue.
        moduli: Young's modulus of regions by name [Pa].
        progress: display of the steps.

    Warns:
        UserWarning: remarks on the files and on the organ, when they arise; they are its notes, too.

    Raises:
        MeshError: a file that cannot become an organ.
        ValueError: arguments that do not go together, or values out of range.
    """
    from msdm_core.mesh_files import FORMATS

    if mesher not in MESHERS:
        raise ValueError(f"--mesher is {mesher!r}; it must be {' or '.join(MESHERS)}")
    check_options(options)
    first, source = files[0], ", ".join(file.name for file in files)
    with progress.step(f"reading {source}"), _noted(files) as notes:
        if is_image(first):
            wrong = [file for file in files if not is_image(file)]
            if wrong:
                raise ValueError(f"{wrong[0]}: is no label image; beside {first} only other label images are taken")
            named = parse_labels(labels, file_count=len(files)) if labels is not None else None
            contents = read_label_image(first, named, others=files[1:])
            _warn(contents.notes)
        elif first.suffix.lower() in FORMATS:
            if len(files) > 1:
                raise ValueError(f"{first}: one file of tets is taken, {len(files)} are given")
            tags = parse_labels(labels, zero_is_outside=False) if labels is not None else ()
            contents = read_tets(first, length_unit, tags, cell_data)
            if remesh:
                contents = surfaces_of_tets(contents)
        else:
            wrong = [file for file in files if file.suffix.lower() not in SURFACE_SUFFIXES]
            if wrong:
                raise ValueError(
                    f"{wrong[0]}: is no surface; beside {first} only {', '.join(SURFACE_SUFFIXES)} are taken"
                )
            if length_unit is None:
                raise ValueError(
                    f'{first}: needs --length-unit: "m", "cm", "mm" or metres per unit; its format states none'
                )
            contents = read_surfaces(files, length_unit, mend=mend)
    volume = image_volume(contents) if isinstance(contents, LabelImage) else contents.volume
    check_touch(volume, options, cell_size)
    approach, angle = approach_of(options, is_scan=is_image(first)), make_scene(PATTERN).palpation.face_angle_deg
    if isinstance(contents, PatientTets):
        touch = replace(
            plan_touch(volume, options, cell_size=contents.face_cell(approach, angle), graded=False),
            known_node_count=contents.mesh.node_count,
        )
    else:
        touch = plan_touch(volume, options, cell_size=cell_size, graded=mesher == MESHERS[0])
    progress.say(plan_text(touch, organ_material(contents.names[0], options.youngs_modulus).material, approach))
    cells = Cells(touch.cell_size, touch.is_given, touch.coarsening, touch.fine_depth, approach, angle)
    if options.approach is None and touch.coarsening > 1 and any(map(is_lesion, contents.names[1:])):
        # The lesions decide the probe's approach, and that the place of the fine cells.
        with progress.step("turning the probe to the lesions"):
            rough = replace(cells, size=touch.coarsening * touch.cell_size, is_given=True, coarsening=1)
            approach = facing_approach(_meshed(contents, source, rough, mesher, mend), approach, angle)
        options, cells = replace(options, approach=approach), replace(cells, approach=approach)
    with progress.step("filling it with tets"):
        mesh = _meshed(contents, source, cells, mesher, mend)
        _warn(mesh.notes)
    with progress.step("fitting its own surface to the tets"):
        mesh = replace(mesh, surface=_own_surface(contents, mesh, mend))
    with progress.step("choosing sites, lesions and the step"):
        organ = patient_scene(mesh, out, touch=touch, options=options, moduli=moduli or {})
        _warn(organ.notes)
        return replace(organ, notes=(*notes, *mesh.notes, *organ.notes))


@contextmanager
def _noted(files: Sequence[Path]) -> Iterator[list[str]]:
    """Texts of the warnings within, for the report, without the folders of files; they are shown when they arise."""
    notes, show = list[str](), warnings.showwarning

    def note(message: Warning | str, *place: Any) -> None:
        text = str(message)
        for file in files:
            text = text.replace(str(file), file.name)
        notes.append(text)
        show(message, *place)

    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = note
        yield notes


def _warn(notes: Iterable[str]) -> None:
    for note in notes:
        warnings.warn(note, stacklevel=3)


def with_hold(organ: PatientScene, progress: StepProgress) -> PatientScene:
    """The organ with a check of its hold by a few healthy presses; faults are added to the notes."""
    sites, normals, _ = plan_sites(organ.anatomy)
    with progress.step("pressing what holds it", min(HOLD_SITES, len(sites))) as advance:
        quick = with_added_mass(organ.anatomy, lambda anatomy: [anatomy.organ()])
        hold = check_hold(quick, sites, normals, progress=lambda: advance(1))
    faults = ("no press of the healthy organ reached its depth",) if hold is None else hold.faults
    _warn(faults)
    return replace(organ, hold=hold, notes=(*organ.notes, *faults))


def _meshed(contents: OrganContents, source: str, cells: Cells, mesher: str, mend: bool) -> PatientMesh:
    if isinstance(contents, PatientTets):
        return patient_of_tets(contents, cells.size)
    if isinstance(contents, PatientSurfaces):
        return mesh_surfaces(contents, cells=cells, mesher=mesher)
    return mesh_image(contents, source, cells=cells, mesher=mesher, mend=mend)


def _own_surface(contents: OrganContents, mesh: PatientMesh, mend: bool) -> SurfaceFit | None:
    """Surface for pictures; None for tets of a file, whose boundary is the organ's surface."""
    if isinstance(contents, PatientTets):
        return None
    if isinstance(contents, PatientSurfaces):
        return file_surface(contents, mesh)
    return image_surface(contents, mesh, mend=mend)


def add_retraction(organ: PatientScene, out: Path) -> tuple[PatientScene, RetractScene | str]:
    """The organ with a reference to its retraction scene, and that scene; or the reason for none in both."""
    file = _retract_file(out)
    retraction = find_retraction(organ, file)
    if isinstance(retraction, str):
        scene = replace(organ.scene, retract_refusal=retraction)
    else:
        scene = replace(organ.scene, retract_scene=file.with_suffix(".toml").name)
    return replace(organ, anatomy=replace(organ.anatomy, scene=scene)), retraction


def write_patient(
    organ: PatientScene,
    out: Path,
    command: str,
    retraction: RetractScene | str | None = None,
    *,
    healthy_map: bool,
    progress: StepProgress,
) -> list[Path]:
    """Write the mesh, its scene, its surface, report.html, the retraction's files and the healthy map; all or none.

    Args:
        organ: the organ with its scene.
        out: path of the mesh; the other files lie beside it.
        command: the command line that makes the organ, for the report.
        retraction: the retraction scene, or the reason for none; None without a search.
        healthy_map: press the healthy organ for the map of `SurgSim/PalpateSites-v0`.
        progress: display of the steps.

    Returns:
        The paths of the files.

    Warns:
        UserWarning: the organ refuses a healthy map.
    """
    turned = _retract_file(out)
    healthy = healthy_file(out.with_suffix(".toml")).name
    # Files of an earlier run may be of another organ.
    optional = [turned, turned.with_suffix(".toml"), surface_file(out), surface_file(turned)]
    with output_folder(out.parent, [healthy, *(path.name for path in optional)]) as files:
        with progress.step("drawing the report"):
            names = _write_organ(organ, files, out.name, command, retraction)
        if healthy_map and organ.scene.lesion is not None:
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
    organ: PatientScene, files: OutputFolder, name: str, command: str, retraction: RetractScene | str | None
) -> list[str]:
    """Write all but the healthy map, named after the mesh; returns the names of the files."""
    from msdm_core.mesh_files import write_mesh

    scene_file = Path(name).with_suffix(".toml").name
    text = scene_text(organ)
    write_mesh(files / name, organ.patient.mesh)
    (files / scene_file).write_text(text, encoding="utf-8", newline="\n")
    written = [name, scene_file, REPORT_NAME]
    own = organ.patient.surface
    if own is not None:
        written.append(surface_file(Path(name)).name)
        own.write(files / written[-1])
    # The report's pictures show the surface that lies beside the scene.
    placed = replace(organ, anatomy=replace(organ.anatomy, scene=load_scene(files / scene_file)))
    page = report_page(placed, text, scene_file, command, retraction)
    # Bytes of a file's name that are not UTF-8 become question marks.
    (files / REPORT_NAME).write_text(page, encoding="utf-8", errors="replace", newline="\n")
    if isinstance(retraction, RetractScene):
        turned = _retract_file(Path(name)).name
        lifted = Path(turned).with_suffix(".toml").name
        write_mesh(files / turned, retraction.anatomy.mesh)
        (files / lifted).write_text(retract_text(organ, retraction), encoding="utf-8", newline="\n")
        load_scene(files / lifted)
        written += [turned, lifted]
        if own is not None:
            written.append(surface_file(Path(turned)).name)
            own.turned(retraction.origin, retraction.rim.frame).write(files / written[-1])
    return written


def _retract_file(out: Path) -> Path:
    """Path of a retraction scene's mesh, beside the organ's."""
    return out.with_name(f"{out.stem}_retract{out.suffix}")


def check_target(out: Path) -> None:
    """Refuse, before the work, a mesh file in an unknown format or a folder that cannot be written."""
    from msdm_core.mesh_files import WRITTEN_SUFFIX

    if out.suffix.lower() != WRITTEN_SUFFIX:
        raise ValueError(f"--out {out}: unknown extension {out.suffix!r}; meshes are written as {WRITTEN_SUFFIX}")
    if out.is_dir():
        raise ValueError(f"--out {out}: is a folder; give the name of a file")
    folder = next(parent for parent in out.absolute().parents if parent.exists())
    if not (folder.is_dir() and os.access(folder, os.W_OK)):
        raise ValueError(f"--out {out}: {folder} is no folder that you may write to; choose another place")


def print_patient(organ: PatientScene, console: Console) -> None:
    """Print a summary of a patient's organ."""
    patient, scene, cell = organ.patient, organ.scene, organ.anatomy.palpable_cell
    title = ", ".join(patient.sources)
    touch = (scene.instrument.tip_radius, scene.palpation.press_depth)
    rows = {
        "nodes": f"{patient.mesh.node_count}",
        "tets": f"{patient.mesh.tet_count}",
        "volume": f"{patient.volumes[0].mesh * 1e6:.1f} ml (error {patient.volume_error:+.2%})",
    }
    if patient.surface is not None:
        rows["drawn surface"] = patient.surface.text
    if organ.hold is not None:
        rows["held"] = organ.hold.text
    for volume in patient.volumes[1:]:
        modulus = organ.regions[volume.name].material.youngs_modulus
        rows[volume.name] = f"{volume.mesh * 1e6:.2f} ml (error {volume.error:+.2%}), E {modulus:g} Pa"
    rows["cell / contact radius"] = share_text(cell, *touch)
    table = Table(title=title, show_header=False)
    for name, value in rows.items():
        table.add_row(name, value)
    console.print(table)
    warn_of_coarse_cells(title, cell, *touch)
