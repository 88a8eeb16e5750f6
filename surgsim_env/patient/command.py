"""What `surgsim organ` does with labels, surfaces and tets, and how `surgsim palpate` begins from a scan."""

import os
import shutil
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from msdm_core.surface_io import SURFACE_SUFFIXES
from surgsim_env.command_values import command_line, unit_of, vector_of
from surgsim_env.organ_report import check_target, print_organ, report_organ
from surgsim_env.palpation.surface_scene import SurfaceOptions
from surgsim_env.patient.label_image import IMAGE_SUFFIXES, is_image, read_label_image
from surgsim_env.patient.label_names import FORM, parse_labels
from surgsim_env.patient.patient_mesh import PatientMesh, mesh_image
from surgsim_env.patient.patient_scene import PatientScene, patient_scene
from surgsim_env.patient.report import MARK, report_page
from surgsim_env.patient.retract_scene import RetractScene, find_retraction, told, with_retraction
from surgsim_env.patient.retract_text import retract_text
from surgsim_env.patient.scene_text import FIRST_LINE, scene_text
from surgsim_env.patient.surface_mesh import mesh_surfaces
from surgsim_env.scenes import Scene, load_scene

if TYPE_CHECKING:
    from surgsim_env.palpation.palpate_command import Request as PalpateRequest

MESHERS = ("lattice", "tetwild")
REPORT_NAME = "report.html"


@dataclass(frozen=True)
class Request:
    """The options of `surgsim organ`, as the command line explains them."""

    files: tuple[Path, ...]
    labels: str | None = None
    region: tuple[str, ...] = ()
    length_unit: str | None = None
    cell_size: float | None = None
    out: Path | None = None
    youngs_modulus: float | None = None
    modulus: tuple[str, ...] = ()
    approach: str | None = None
    mend: bool = False
    mesher: str | None = None

    @property
    def command(self) -> str:
        """The command line that says the same."""
        options = {name: value for name, value in vars(self).items() if name != "files"}
        return command_line(["surgsim", "organ", *map(str, self.files)], options)


def make_organ(request: Request, console: Console) -> None:
    """Make an organ, print what it is like, and with `out` write its mesh, its scene and its report.

    Raises:
        MeshError: a file that cannot become an organ.
        ValueError: options that do not go together, or a place that cannot be written.
    """
    if not request.files:
        raise ValueError(f"give a file: a label image ({', '.join(IMAGE_SUFFIXES)}), surfaces or a mesh of tets")
    unit = unit_of(request.length_unit)
    first = request.files[0]
    if not is_image(first) and first.suffix.lower() not in SURFACE_SUFFIXES:
        unused = ("labels", "region", "cell_size", "modulus", "approach", "mend", "mesher")
        _refuse(request, unused, "a label image or surfaces")
        if len(request.files) > 1:
            raise ValueError(f"{first}: one file of tets is taken, {len(request.files)} are given")
        report_organ(first, unit, request.youngs_modulus, request.out, console)
        return
    if request.out is not None:
        _check_targets(request.out)
    options = SurfaceOptions(approach=vector_of("--approach", request.approach), youngs_modulus=request.youngs_modulus)
    patient = _patient(request)
    folder, name = (request.out.parent, request.out) if request.out else (Path(), Path("patient.vtu"))
    found = patient_scene(patient, name.stem, folder, name.name, options=options, moduli=_moduli(request.modulus))
    turned = _retract_file(name)
    retraction = find_retraction(found, folder, turned.name)
    found = with_retraction(found, retraction, turned.with_suffix(".toml").name)
    _tell(found, console)
    console.print(f"retraction: {told(retraction)}", highlight=False)
    if request.out is not None:
        written = write_patient(found, request.out, request.command, retraction)
        console.print(f"written: {', '.join(map(str, written))}", highlight=False, soft_wrap=True)


def palpable_patient(request: "PalpateRequest", folder: Path, console: Console) -> Scene:
    """The scene of the file that `surgsim palpate` was given, made by the way and written to a folder."""
    file = request.segmentation or request.surface
    assert file is not None
    out = folder / f"{file.name.split('.')[0]}.vtu"
    asked = Request(
        (file,),
        labels=request.labels,
        length_unit=request.length_unit,
        cell_size=request.cell_size,
        out=out,
        youngs_modulus=request.youngs_modulus,
        approach=request.approach,
    )
    _check_targets(out)
    found = patient_scene(_patient(asked), out.stem, folder, out.name, options=request.options, moduli={})
    _tell(found, console)
    write_patient(found, out, request.command)
    return load_scene(out.with_suffix(".toml"))


def write_patient(
    found: PatientScene, out: Path, command: str, retraction: RetractScene | str | None = None
) -> list[Path]:
    """Write the mesh, its scene and report.html, those of a retraction too, all or none; returns their paths."""
    from msdm_core.mesh_io import write_mesh

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
        # An earlier run's, of another organ than is there now.
        turned.unlink(missing_ok=True)
        lifted.unlink()
    return targets


def _retract_file(out: Path) -> Path:
    """Where the mesh that a retraction takes is written, beside the organ's."""
    return out.with_name(f"{out.stem}_retract{out.suffix}")


def _replace(targets: Sequence[Path], part: Path) -> None:
    """Put new files of a folder in their places; where one cannot be, all places are as before."""
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


def _patient(request: Request) -> PatientMesh:
    first, mesher = request.files[0], request.mesher or MESHERS[0]
    if mesher not in MESHERS:
        raise ValueError(f"--mesher is {mesher!r}; it must be {' or '.join(MESHERS)}")
    if is_image(first):
        _refuse(request, ("region", "length_unit"), "surfaces; an image has its own")
        if len(request.files) > 1:
            raise ValueError(f"{first}: one image is taken, {len(request.files)} files are given")
        if request.labels is None:
            raise ValueError(f"{first}: which labels are the organ? Give {FORM}")
        image = read_label_image(first, parse_labels(request.labels))
        return mesh_image(image, first.name, cell_size=request.cell_size, mesher=mesher, mend=request.mend)
    _refuse(request, ("labels",), "a label image; regions of surfaces have a file each")
    wrong = [file for file in request.files if file.suffix.lower() not in SURFACE_SUFFIXES]
    if wrong:
        raise ValueError(f"{wrong[0]}: is no surface; beside {first} only {', '.join(SURFACE_SUFFIXES)} are taken")
    unit = unit_of(request.length_unit)
    if unit is None:
        raise ValueError(f'{first}: needs --length-unit: "m", "cm", "mm" or metres per unit; its format states none')
    return mesh_surfaces(
        request.files, request.region, unit, cell_size=request.cell_size, mesher=mesher, mend=request.mend
    )


def _refuse(request: Request, names: Sequence[str], what: str) -> None:
    for name in names:
        if getattr(request, name) not in (None, ()) and getattr(request, name) is not False:
            raise ValueError(f"--{name.replace('_', '-')} goes with {what}")


def _moduli(texts: Sequence[str]) -> Mapping[str, float]:
    moduli = {}
    for text in texts:
        name, found, value = text.partition("=")
        try:
            moduli[name.strip()] = float(value)
        except ValueError:
            found = ""
        if not found:
            raise ValueError(f"--modulus is {text!r}; the form is NAME=PASCAL, such as lesion=40000")
    return moduli


def _check_targets(out: Path) -> None:
    """Refuse places that cannot be written, and files that are not an earlier run's, before the work."""
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


def _begins(path: Path, mark: str) -> bool:
    with path.open(encoding="utf-8", errors="replace") as stream:
        return stream.read(len(mark)) == mark


def _tell(found: PatientScene, console: Console) -> None:
    """Print what the organ is like, and warn of what was dropped or is odd."""
    patient, scene = found.patient, found.scene
    touch = (scene.instrument.tip_radius, scene.palpation.press_depth)
    rows = {}
    for one in patient.volumes[1:]:
        modulus = found.regions[one.name].material.youngs_modulus
        rows[one.name] = f"{one.mesh * 1e6:.2f} ml (error {one.error:+.2%}), E {modulus:g} Pa"
    print_organ(
        ", ".join(patient.sources),
        patient.mesh,
        found.anatomy.organ(found.anatomy.demonstration_lesions()),
        material=scene.material,
        volume_error=patient.volume_error,
        cell=found.anatomy.palpable_cell,
        touch=touch,
        more=rows,
        console=console,
    )
    for note in (*patient.notes, *found.notes):
        warnings.warn(note, UserWarning, stacklevel=2)
