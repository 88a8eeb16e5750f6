"""A patient's organ from files: mesh and scene made, summary printed, mesh, scenes and report written."""

import os
import shutil
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from msdm_core.kernels.structure_kernels import OrganModel
from msdm_core.material.regions import Material
from msdm_core.mesh.quality import mesh_quality, surface_cell
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.mesh_files.mesh_file import LengthUnit
from msdm_core.mesh_files.surface_io import SURFACE_SUFFIXES
from msdm_core.organ.compile import OrganSpec, compile_organ
from surgsim_env.palpation.surface_scene import SurfaceOptions
from surgsim_env.patient.label_image import FORM, is_image, parse_labels, read_label_image
from surgsim_env.patient.meshers import mesh_image, mesh_surfaces
from surgsim_env.patient.patient_mesh import PatientMesh
from surgsim_env.patient.patient_scene import PatientScene, patient_scene
from surgsim_env.patient.report import MARK, report_page
from surgsim_env.patient.retract_scene import RetractScene, find_retraction, with_retraction
from surgsim_env.patient.scene_text import FIRST_LINE, retract_text, scene_text
from surgsim_env.scene.load import load_scene, make_scene
from surgsim_env.scene.palpable_surface import share_text, warn_of_coarse_cells

MESHERS = ("lattice", "tetwild")
REPORT_NAME = "report.html"


def make_patient(
    files: Sequence[Path],
    out: Path,
    *,
    labels: str | None = None,
    regions: Sequence[str] = (),
    length_unit: LengthUnit | None = None,
    cell_size: float | None = None,
    mesher: str = MESHERS[0],
    mend: bool = False,
    options: SurfaceOptions,
    moduli: Mapping[str, float] | None = None,
) -> PatientScene:
    """Mesh an organ and make its palpation scene; writes nothing.

    Args:
        files: a label image; or closed surfaces, the organ's first, then one for each region.
        out: path of the mesh to be written; its stem names the scene.
        labels: which labels of an image are which tissue, as in `parse_labels`.
        regions: further regions of surfaces, as NAME=FILE.
        length_unit: of surfaces.
        cell_size: of the lattice [m]; default: in proportion to the organ.
        mesher: one of MESHERS.
        mend: whether holes, self-intersections and cavities are repaired.
        options: touch, anchors and healthy tissue.
        moduli: Young's modulus of regions by name [Pa].

    Raises:
        MeshError: a file that cannot become an organ.
        ValueError: arguments that do not go together, or values out of range.
    """
    if mesher not in MESHERS:
        raise ValueError(f"--mesher is {mesher!r}; it must be {' or '.join(MESHERS)}")
    mesh = (
        _image_mesh(files, labels, cell_size=cell_size, mesher=mesher, mend=mend)
        if is_image(files[0])
        else _surface_mesh(files, regions, length_unit, cell_size=cell_size, mesher=mesher, mend=mend)
    )
    return patient_scene(mesh, out.stem, out.parent, out.name, options=options, moduli=moduli or {})


def _image_mesh(
    files: Sequence[Path], labels: str | None, *, cell_size: float | None, mesher: str, mend: bool
) -> PatientMesh:
    first = files[0]
    if len(files) > 1:
        raise ValueError(f"{first}: one image is taken, {len(files)} files are given")
    if labels is None:
        raise ValueError(f"{first}: which labels are the organ? Give {FORM}")
    image = read_label_image(first, parse_labels(labels))
    return mesh_image(image, first.name, cell_size=cell_size, mesher=mesher, mend=mend)


def _surface_mesh(
    files: Sequence[Path],
    regions: Sequence[str],
    length_unit: LengthUnit | None,
    *,
    cell_size: float | None,
    mesher: str,
    mend: bool,
) -> PatientMesh:
    wrong = [file for file in files if file.suffix.lower() not in SURFACE_SUFFIXES]
    if wrong:
        raise ValueError(f"{wrong[0]}: is no surface; beside {files[0]} only {', '.join(SURFACE_SUFFIXES)} are taken")
    if length_unit is None:
        raise ValueError(f'{files[0]}: needs --length-unit: "m", "cm", "mm" or metres per unit; its format states none')
    return mesh_surfaces(files, regions, length_unit, cell_size=cell_size, mesher=mesher, mend=mend)


def add_retraction(found: PatientScene, out: Path) -> tuple[PatientScene, RetractScene | str]:
    """The organ with a reference to its retraction scene, and that scene; or the reason why there is none in both."""
    turned = _retract_file(out)
    retraction = find_retraction(found, out.parent, turned.name)
    return with_retraction(found, retraction, turned.with_suffix(".toml").name), retraction


def write_patient(
    found: PatientScene, out: Path, command: str, retraction: RetractScene | str | None = None
) -> list[Path]:
    """Write the mesh, its scene, report.html and the files of a retraction scene; all of them or none.

    Args:
        found: the organ with its scene.
        out: path of the mesh; the other files lie beside it.
        command: the command line that makes the organ, for the report.
        retraction: the retraction scene, or why there is none; None if it was not looked for.

    Returns:
        The paths of the files.
    """
    from msdm_core.mesh_files.mesh_io import write_mesh

    text, scene_file = scene_text(found), out.with_suffix(".toml")
    page = report_page(found, text, scene_file.name, command, retraction)
    targets, turned = [out, scene_file, out.with_name(REPORT_NAME)], _retract_file(out)
    lifted = turned.with_suffix(".toml")
    if isinstance(retraction, RetractScene):
        targets += [turned, lifted]
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".surgsim-part-") as part:
        write_mesh(Path(part, out.name), found.patient.mesh)
        Path(part, scene_file.name).write_text(text, encoding="utf-8", newline="\n")
        # What a page cannot show, such as bytes of a file's name that are not UTF-8, becomes a question mark.
        Path(part, REPORT_NAME).write_text(page, encoding="utf-8", errors="replace", newline="\n")
        load_scene(Path(part, scene_file.name))
        if isinstance(retraction, RetractScene):
            write_mesh(Path(part, turned.name), retraction.anatomy.mesh)
            Path(part, lifted.name).write_text(retract_text(found, retraction), encoding="utf-8", newline="\n")
            load_scene(Path(part, lifted.name))
        _replace(targets, Path(part))
    if not isinstance(retraction, RetractScene) and lifted.exists() and _begins(lifted, FIRST_LINE):
        # Left by an earlier run for an organ that is now replaced.
        turned.unlink(missing_ok=True)
        lifted.unlink()
    return targets


def _retract_file(out: Path) -> Path:
    """Path of the mesh of a retraction scene, beside the organ's."""
    return out.with_name(f"{out.stem}_retract{out.suffix}")


def _replace(targets: Sequence[Path], part: Path) -> None:
    """Move new files from a folder to their targets; if one cannot be moved, all targets are restored."""
    for target in targets:
        if target.exists():
            shutil.copy2(target, part / f"before-{target.name}")
    placed = []
    try:
        for target in targets:
            os.replace(part / target.name, target)
            placed.append(target)
    except BaseException:
        for target in placed:
            before = part / f"before-{target.name}"
            if before.exists():
                os.replace(before, target)
            else:
                target.unlink()
        raise


def check_targets(out: Path) -> None:
    """Refuse, before the work, targets that cannot be written and files that no earlier run has written."""
    check_target(out)
    turned = _retract_file(out)
    scene = turned.with_suffix(".toml")
    if turned.exists() and not scene.exists():
        raise ValueError(
            f"--out {out}: {turned} is there, and not of an earlier run; choose another place or remove it"
        )
    for path, mark in ((out.with_suffix(".toml"), FIRST_LINE), (scene, FIRST_LINE), (out.with_name(REPORT_NAME), MARK)):
        if path.is_dir():
            raise ValueError(f"--out {out}: {path.name} is a folder there; choose another place or remove it")
        if path.exists() and not _begins(path, mark):
            raise ValueError(
                f"--out {out}: {path} is there, and not of an earlier run; choose another place or remove it"
            )


def check_target(out: Path) -> None:
    """Refuse, before the work, a mesh file in an unknown format or in a folder that does not exist."""
    from msdm_core.mesh_files.mesh_io import FORMATS

    if out.suffix.lower() not in FORMATS:
        raise ValueError(f"--out {out}: unknown extension {out.suffix!r}; known: {', '.join(FORMATS)}")
    if not out.parent.is_dir():
        raise ValueError(f"--out {out}: the folder {out.parent} does not exist; create it first")


def _begins(path: Path, mark: str) -> bool:
    with path.open(encoding="utf-8", errors="replace") as stream:
        return stream.read(len(mark)) == mark


def convert_tets(
    file: Path, length_unit: LengthUnit | None, youngs_modulus: float | None, out: Path | None, console: Console
) -> None:
    """Print a summary of an organ made from a file of tets, with the shipped liver's tissue and touch, and write it.

    Raises:
        MeshError: the file cannot become an organ.
        ValueError: the length unit is missing or unknown.
    """
    from msdm_core.mesh_files.mesh_io import read_mesh, write_mesh

    if out is not None:
        check_target(out)
    mesh = read_mesh(file, length_unit=length_unit)
    liver = make_scene("liver")
    material = liver.material
    if youngs_modulus is not None:
        material = replace(material, youngs_modulus=youngs_modulus)
    organ = compile_organ(OrganSpec(mesh=mesh, materials=material, damping=liver.damping))
    cell = surface_cell(mesh, mesh.boundary_triangles)
    touch = (liver.instrument.tip_radius, liver.palpation.press_depth)
    _print_organ(file.name, mesh, organ, material=material, volume_error=None, cell=cell, touch=touch, console=console)
    if out is not None:
        write_mesh(out, mesh)
        console.print(f"written: {out}", highlight=False, soft_wrap=True)


def print_patient(found: PatientScene, console: Console) -> None:
    """Print a summary of a patient's organ, and warn of what was dropped, repaired or is unusual."""
    patient, scene = found.patient, found.scene
    rows = {}
    for one in patient.volumes[1:]:
        modulus = found.regions[one.name].material.youngs_modulus
        rows[one.name] = f"{one.mesh * 1e6:.2f} ml (error {one.error:+.2%}), E {modulus:g} Pa"
    _print_organ(
        ", ".join(patient.sources),
        patient.mesh,
        found.anatomy.organ(found.anatomy.demonstration_lesions()),
        material=scene.material,
        volume_error=patient.volume_error,
        cell=found.anatomy.palpable_cell,
        touch=(scene.instrument.tip_radius, scene.palpation.press_depth),
        more=rows,
        console=console,
    )
    for note in (*patient.notes, *found.notes):
        warnings.warn(note, UserWarning, stacklevel=2)


def _print_organ(
    title: str,
    mesh: TetMesh,
    organ: OrganModel,
    *,
    material: Material,
    volume_error: float | None,
    cell: float,
    touch: tuple[float, float],
    console: Console,
    more: Mapping[str, str] | None = None,
) -> None:
    """Print a table of an organ; warns if its cells would be felt.

    Args:
        title: of the table.
        mesh: of the organ.
        organ: compiled on it.
        material: of its healthy tissue.
        volume_error: of the mesh against its source; None if the source has no volume.
        cell: edge of the cells at its surface [m].
        touch: tip radius and press depth [m].
        console: to print to.
        more: further rows.
    """
    quality = mesh_quality(mesh)
    fit = "no surface to compare with" if volume_error is None else f"{volume_error:+.2%}"
    x, y, z = (mesh.points.max(axis=0) - mesh.points.min(axis=0)) * 1e3
    step = f"{organ.stable_step * 1e3:.3f} ms"
    rows = {
        "extent": f"{x:.1f} x {y:.1f} x {z:.1f} mm",
        "nodes": f"{mesh.node_count}",
        "tets": f"{mesh.tet_count}, {mesh.reoriented_count} reoriented",
        "springs": f"{len(organ.spring_nodes)}",
        "volume": f"{quality.volume * 1e6:.1f} ml (error {fit})",
        **(more or {}),
        "mass": f"{organ.node_mass.sum():.4f} kg at {material.density:g} kg/m^3",
        "dihedral angles": f"{quality.dihedral_smallest_deg:.1f} to {quality.dihedral_largest_deg:.1f} degrees",
        "radius ratio": f"from {quality.radius_ratio_smallest:.3f} (1 is regular)",
        "cell / contact radius": share_text(cell, *touch),
        "stable step": f"{step} at E {material.youngs_modulus:g} Pa, nu {material.poisson_ratio:g}",
    }
    table = Table(title=title, show_header=False)
    for name, value in rows.items():
        table.add_row(name, value)
    console.print(table)
    warn_of_coarse_cells(title, cell, *touch)
