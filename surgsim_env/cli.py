"""The command line: `surgsim palpate`, `retract`, `arms`, `organ`, `scenes`, `validate`, `bench`, `haptics`, `view`."""

import contextlib
import io
import re
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from surgsim_env.haptics.options import Haptics
from surgsim_env.live.options import View
from surgsim_env.scenes import list_scenes, make_scene

# Options whose value is a list of numbers, which may begin with a minus.
NUMBER_LISTS = ("--lesion", "--anchors", "--approach", "--around")

# Options that may be left out, shown with what they hold and without tyro's "{None}|" and "(default: None)".
MaybeText = Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint="")]
MaybePath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]
MaybeNumber = Annotated[float | None, tyro.conf.arg(metavar="NUMBER", help_behavior_hint="")]
MaybeCount = Annotated[int | None, tyro.conf.arg(metavar="COUNT", help_behavior_hint="")]


@dataclass(frozen=True)
class Palpate:
    """Press an organ site by site, map its stiffness, and say where lesions were felt.

    Lengths are metres, forces newtons. Writes palpation.csv, stiffness_map.png and summary.json.
    """

    scene: MaybeText = None
    """A shipped scene (see `surgsim scenes`); liver if neither --organ nor --surface is given."""
    organ: MaybePath = None
    """Instead: a scene file of your own (TOML)."""
    surface: MaybePath = None
    """Instead: a closed surface (STL, OBJ, PLY); what it does not say is taken from the scene liver."""
    segmentation: MaybePath = None
    """Instead: a label image of a scan (NIfTI, NRRD, DICOM); makes the organ as `surgsim organ` does, into --out."""
    labels: MaybeText = None
    """Of --segmentation: NAME=LABEL,..., the organ first, such as liver=1,lesion=2."""
    length_unit: MaybeText = None
    """Of --surface: m, cm, mm, or metres per unit as a number."""
    cell_size: MaybeNumber = None
    """Of the lattice that fills --surface or --segmentation [m]; default: in proportion to the organ, and so are tip,
    press depth and spacing (docs/patient.md)."""
    lesion: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """x,y,z,radius,ratio: centre and radius [m], modulus over the healthy one; repeatable; replaces the scene's."""
    anchors: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """x,y,z,radius: a ball [m] that holds the surface in it. Default: the deepest 15 % along the approach."""
    approach: MaybeText = None
    """x,y,z: direction of the probe. Default: the scene's; 0,0,-1 for --surface (from the head where z is up)."""
    around: MaybeText = None
    """x,y,z,radius: press only the sites inside this ball [m]; default: the whole palpable face."""
    press_depth: MaybeNumber = None
    """[m]; default: the scene's."""
    tip_radius: MaybeNumber = None
    """[m]; default: the scene's."""
    spacing: MaybeNumber = None
    """Distance between sites [m]; default: the scene's."""
    youngs_modulus: MaybeNumber = None
    """Of the healthy tissue [Pa]; default: the scene's."""
    out: MaybePath = None
    """Folder for the results; default: the next free runs/palpate-SCENE-NUMBER."""
    seed: int = 0
    """Of the sensor's noise and the pre-operative model's errors."""
    workers: MaybeCount = None
    """Threads; default: one for each core."""


@dataclass(frozen=True)
class Retract:
    """Let a script that knows the truth grasp a lobe, fold it back and expose what it hides; with two arms, touch it.

    Writes trace.csv, trace_control.csv, forces.png, retraction.png (before and after) and summary.json. Exit status 1:
    it did not succeed.
    """

    scene: str = "lobe"
    """A shipped scene (see `surgsim scenes`) or a scene file of your own (TOML)."""
    instrument: MaybeText = None
    """An arm with a jaw, such as psm_retractor, or a TOML file; default: the scene's own."""
    bimanual: bool = False
    """Two arms: the left one lifts the lobe, the right one reaches under it and touches the target."""
    seed: int = 0
    """Of the episode."""
    out: Path = Path("runs/retract")
    """Folder for the results."""


@dataclass(frozen=True)
class Arms:
    """Evaluate two arms on a patient's organ: what each reaches and both at once, clearances, forces, dexterity.

    Writes report.html (self-contained), points.csv, heat maps (PNG) and summary.json. docs/arms_report.md tells more.
    """

    left: str
    """The left arm: a shipped arm's name (psm_grasper, psm_retractor, ...) or a TOML file (docs/arms.md)."""
    right: str
    """The right arm, likewise."""
    ports: Path | None = None
    """TOML file with tables [left], [right] and [endoscope], each with `point` [m] and `into` or `target`; without one
    the ports stand as laparoscopy places them (docs/evaluation.md)."""
    scene: str = "liver"
    """A shipped scene (see `surgsim scenes`) or a scene file of your own (TOML)."""
    compare: tuple[str, ...] = ()
    """Other ports files, or arms to use on both sides: ranked in one table with the reasons."""
    points: int = 500
    """How many points of the organ are tried."""
    episodes: int = 3
    """How many episodes a script runs with the arms: it lifts a lobe and touches what lies under it; 0: none."""
    seed: int = 0
    """Of the points and of where the search for joints starts."""
    out: Path = Path("runs/arms")
    """Folder for the results."""


@dataclass(frozen=True)
class Organ:
    """Build an organ from a scan's labels, closed surfaces or a tetrahedral mesh, report on it, and write it.

    With --out patient.vtu of labels or surfaces also patient.toml, a scene for every command and environment of
    palpation, and report.html. docs/patient.md tells more.
    """

    files: tyro.conf.Positional[tuple[Path, ...]]
    """A label image (nii, nii.gz, nrrd, dcm); or closed surfaces (STL, OBJ, PLY), the organ first, then a file for each
    region in it, named after its file; or one file of tets (vtu, vtk, msh, mesh)."""
    labels: MaybeText = None
    """Of an image: NAME=LABEL,..., the organ first, such as liver=1,lesion=2."""
    region: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=FILE: one more region from a closed surface; repeatable."""
    length_unit: MaybeText = None
    """m, cm, mm, or metres per unit as a number; required where the format has none."""
    cell_size: MaybeNumber = None
    """Of the lattice that fills it [m]; default: in proportion to the organ."""
    out: MaybePath = None
    """Where the mesh is written (vtu, vtk, msh, mesh)."""
    youngs_modulus: MaybeNumber = None
    """Of the healthy tissue [Pa]; default: by the organ's name, else the liver's."""
    modulus: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=PASCAL: Young's modulus of a region; repeatable; default: by its name."""
    approach: MaybeText = None
    """x,y,z: direction of the probe; default: from the front and above in a scan, 0,0,-1 for surfaces."""
    mend: bool = False
    """Close holes, resolve self-intersections, fill cavities; says what it did."""
    mesher: MaybeText = None
    """lattice (default), or tetwild: conforming region surfaces (extra `tetwild`)."""


@dataclass(frozen=True)
class Scenes:
    """List the shipped scenes."""


@dataclass(frozen=True)
class Validate:
    """Hold the tissue against closed forms and finite elements, print the table, and write it with its plots.

    Exit status 0: every row is met or a known shortfall (surgsim_env/validation/known_shortfalls.toml); 1 otherwise.
    """

    quick: bool = False
    """Only the cases that take seconds."""
    out: MaybePath = None
    """Folder for validation.md and images/. Default: docs/ of a checkout; runs/validation elsewhere or with --quick."""


@dataclass(frozen=True)
class Bench:
    """Time the tissue, the environments and the start, beside MuJoCo flex and Newton; print and write the figures.

    Prints `name value unit` lines and writes benchmarks.md. What is not installed is said to be absent.
    """

    quick: bool = False
    """Smaller blocks and fewer repetitions: minutes instead of a quarter of an hour."""
    out: MaybePath = None
    """Folder for benchmarks.md. Default: docs/ of a checkout; runs/benchmarks elsewhere or with --quick."""


Command = (
    Annotated[Palpate, tyro.conf.subcommand("palpate")]
    | Annotated[Retract, tyro.conf.subcommand("retract")]
    | Annotated[Organ, tyro.conf.subcommand("organ")]
    | Annotated[Scenes, tyro.conf.subcommand("scenes")]
    | Annotated[Arms, tyro.conf.subcommand("arms")]
    | Annotated[Validate, tyro.conf.subcommand("validate")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Haptics, tyro.conf.subcommand("haptics")]
    | Annotated[View, tyro.conf.subcommand("view")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; exit status 0, 1 (a row not met, no success), 2 (bad input, one line), 130 (Ctrl-C)."""
    given = _joined(list(sys.argv[1:] if arguments is None else arguments))
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            command = tyro.cli(
                Command, prog="surgsim", args=given, description=__doc__, config=(tyro.conf.OmitArgPrefixes,)
            )
    except SystemExit as ended:
        if ended.code:
            print(f"surgsim: error: {_first_part(said.getvalue())} (see surgsim --help)", file=sys.stderr)
        return 2 if ended.code else 0
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            return _run(command)
    except KeyboardInterrupt:
        print("surgsim: stopped", file=sys.stderr)
        return 130
    # MeshError and OrganError are ValueErrors: bad input, said in one line without a traceback.
    except (ValueError, OSError) as error:
        print(f"surgsim: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2


def _run(command: Palpate | Retract | Arms | Organ | Scenes | Validate | Bench | Haptics | View) -> int:
    console = Console()
    if isinstance(command, Palpate):
        from surgsim_env.palpation import palpate_command

        palpate_command.palpate(palpate_command.Request(**vars(command)), console)
    elif isinstance(command, Retract):
        from surgsim_env.scripting.retract_command import Request as Retraction
        from surgsim_env.scripting.retract_command import retract

        return 0 if retract(Retraction(**vars(command)), console) else 1
    elif isinstance(command, Arms):
        from surgsim_env.evaluation.arms_command import Request, report_arms

        report_arms(Request(**vars(command)), console)
    elif isinstance(command, Validate):
        from surgsim_env.validation.command import validate

        return validate(quick=command.quick, folder=command.out, console=console)
    elif isinstance(command, Bench):
        from surgsim_env.bench.command import bench

        return bench(quick=command.quick, folder=command.out, console=console)
    elif isinstance(command, Haptics):
        from surgsim_env.haptics.command import run_haptics

        run_haptics(command, console)
    elif isinstance(command, View):
        from surgsim_env.live.command import view

        return view(command, console)
    elif isinstance(command, Organ):
        from surgsim_env.patient import command as patient

        patient.make_organ(patient.Request(**vars(command)), console)
    else:
        table = Table()
        table.add_column("scene")
        table.add_column("what it is")
        for name in list_scenes():
            table.add_row(name, make_scene(name).description)
        console.print(table)
    return 0


def _joined(arguments: list[str]) -> list[str]:
    """`--lesion -0.1,0,...` as `--lesion=-0.1,0,...`: older tyro takes a minus for an option."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] in NUMBER_LISTS and re.match(r"-[\d.]", argument):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def _first_part(box: str) -> str:
    """What a box of tyro's says above its first rule, in one line."""
    lines = [line.strip("│ ") for line in box.splitlines() if line.startswith("│")]
    rules = [number for number, line in enumerate(lines) if line and set(line) == {"─"}]
    return " ".join(lines[: rules[0]] if rules else lines) or " ".join(box.split())


def _show_warning(message: Warning | str, *_: object) -> None:
    print(f"surgsim: warning: {' '.join(str(message).split())}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
