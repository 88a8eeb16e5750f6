"""`surgsim organ`: an organ with its scene from a scan's labels, closed surfaces or a tetrahedral mesh."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from surgsim_apps.cli.values import (
    MaybeLength,
    MaybeNumber,
    MaybePath,
    MaybeText,
    Paths,
    command_text,
    unit_of,
    vector_of,
)
from surgsim_env.step_progress import StepProgress


@dataclass(frozen=True)
class Organ:
    """Build an organ from a scan's labels, closed surfaces or a tetrahedral mesh, report on it, and write it.

    With --out patient.vtu it also writes patient.toml, a scene for every command and environment of palpation, the map
    of its healthy stiffness, and report.html. See docs/patient.md.
    """

    files: tyro.conf.Positional[Paths]
    """A label image (nii, nii.gz, nrrd, mha, dcm), or several of one grid, the organ first; or closed surfaces (STL,
    OBJ, PLY), the organ first, then a file for each region in it, named after the region; or one file of tets (vtu,
    vtk, msh, mesh)."""
    labels: MaybeText = None
    """NAME=LABEL,...: the labels of an image by number or by their names in the file, or the region tags of tets, the
    organ first, such as liver=1,lesion=2; of several images one each, in their order. Default: the only label of each
    image, named after its file."""
    cell_data: MaybeText = None
    """Name of the cell data with the tags of tets, for files with several."""
    length_unit: MaybeText = None
    """Unit of the file: m, cm, mm, or metres per unit as a number; required if the format states none."""
    cell_size: MaybeLength = None
    """Cell size of the organ's lattice, the same everywhere; the tip follows from it. Default: cells follow from
    the tip, fine at the pressed face and coarse elsewhere."""
    tip_radius: MaybeLength = None
    """Radius of the ball tip; default: 5 mm, or 6 mm for organs above 500 ml, suitable for a trocar of 12 mm."""
    press_depth: MaybeLength = None
    """Depth of a press; default: 7/12 of the tip's radius."""
    out: MaybePath = None
    """File for the mesh, a .vtu."""
    youngs_modulus: MaybeNumber = None
    """Young's modulus of the healthy tissue at equilibrium [Pa]; default: by the organ's name, else the liver's."""
    modulus: tyro.conf.UseAppendAction[Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=PASCAL")]] = ()
    """Young's modulus of a region; default: by its name."""
    approach: MaybeText = None
    """x,y,z: direction of the probe; default: from the front and above in a scan, 0,0,-1 for surfaces."""
    mend: bool = False
    """Close holes, resolve self-intersections and fill cavities, and report it."""
    remesh: bool = False
    """Fill the surfaces of a file of tets anew, with cells suited to the tip; else its tets are kept."""
    mesher: MaybeText = None
    """lattice (default), or tetwild for conforming region surfaces (extra `tetwild`)."""

    healthy_map: bool = True
    """Map of the healthy organ, pressed at every site, for SurgSim/PalpateSites-v0; without it the first `gym.make`
    presses these sites."""

    @property
    def command_line(self) -> str:
        """The command line with these options."""
        options = {name: value for name, value in vars(self).items() if name not in ("files", "healthy_map")}
        if not self.healthy_map:
            options["no_healthy_map"] = True
        return command_text(["surgsim", "organ", *map(str, self.files)], options)

    def run(self, console: Console) -> int:
        """Make an organ, print a summary of it, and with `out` write its mesh, its scenes and its report.

        Raises:
            MeshError: a file unusable as an organ.
            ValueError: conflicting options, or a read-only place.
        """
        from msdm_core.mesh_files import FORMATS, SURFACE_SUFFIXES
        from surgsim_apps.palpate.scene_options import SceneOptions
        from surgsim_apps.patient import make_patient as patient
        from surgsim_apps.patient.label_image import IMAGE_SUFFIXES, is_image
        from surgsim_apps.patient.retract_scene import retraction_text

        if not self.files:
            raise ValueError(f"give a file: a label image ({', '.join(IMAGE_SUFFIXES)}), surfaces or a mesh of tets")
        unit, first = unit_of(self.length_unit), self.files[0]
        if is_image(first):
            _refuse(self, ("length_unit",), "surfaces or tets; an image has its own")
            _refuse(self, ("remesh", "cell_data"), "a file of tets")
        elif first.suffix.lower() in SURFACE_SUFFIXES:
            _refuse(self, ("labels",), "a label image or tets; regions of surfaces have a file each")
            _refuse(self, ("remesh", "cell_data"), "a file of tets")
        elif first.suffix.lower() in FORMATS:
            _refuse(self, ("mend",), "a label image or surfaces")
            if not self.remesh:
                _refuse(self, ("cell_size", "mesher"), "a label image, surfaces, or tets with --remesh")
        else:
            raise ValueError(
                f"{first}: unknown extension {first.suffix!r}; give labels of a scan ({', '.join(IMAGE_SUFFIXES)}), a "
                f"closed surface ({', '.join(SURFACE_SUFFIXES)}) or tets ({', '.join(FORMATS)}): save a surface as "
                "STL, a solid of a CAD program too, and tets of another program as vtu (meshio convert IN OUT.vtu)"
            )
        if self.out is not None:
            patient.check_target(self.out)
        out = self.out or Path("patient.vtu")
        with StepProgress(console) as progress:
            organ = patient.make_patient(
                self.files,
                out,
                labels=self.labels,
                cell_data=self.cell_data,
                length_unit=unit,
                cell_size=self.cell_size,
                mesher=patient.MESHERS[0] if self.mesher is None else self.mesher,
                mend=self.mend,
                remesh=self.remesh,
                options=SceneOptions(
                    approach=vector_of("--approach", self.approach),
                    tip_radius=self.tip_radius,
                    press_depth=self.press_depth,
                    youngs_modulus=self.youngs_modulus,
                ),
                moduli=_moduli(self.modulus),
                progress=progress,
            )
            organ = patient.with_hold(organ, progress)
            with progress.step("seeking an edge to lift"):
                organ, retraction = patient.add_retraction(organ, out)
            patient.print_patient(organ, console)
            console.print(f"retraction: {retraction_text(retraction)}", highlight=False)
            if self.out is not None:
                written = patient.write_patient(
                    organ, self.out, self.command_line, retraction, healthy_map=self.healthy_map, progress=progress
                )
                console.print(f"written: {', '.join(map(str, written))}", highlight=False, soft_wrap=True)
        return 0


def _refuse(command: Organ, names: Sequence[str], what: str) -> None:
    for name in names:
        if getattr(command, name) not in (None, ()) and getattr(command, name) is not False:
            raise ValueError(f"--{name.replace('_', '-')} goes with {what}")


def _moduli(texts: Sequence[str]) -> Mapping[str, float]:
    moduli = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            moduli[name.strip()] = float(value)
        except ValueError:
            raise ValueError(f"--modulus is {text!r}; the form is NAME=PASCAL, such as lesion=40000") from None
    return moduli
