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

from msdm_core.length_unit import LengthUnit
from msdm_core.regions import Lesion
from surgsim_env.anatomy import Anatomy, load_anatomy
from surgsim_env.haptics.options import Haptics
from surgsim_env.live.options import View
from surgsim_env.out_folder import writable_folder
from surgsim_env.scenes import Ball, Scene, list_scenes, load_scene, make_scene

# Options whose value is a list of numbers, which may begin with a minus.
NUMBER_LISTS = ("--lesion", "--anchors", "--approach", "--around")

# Of the lattice that fills a surface, where nothing else is said [m].
CELL_SIZE = 0.010


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
    length_unit: MaybeText = None
    """Of --surface: m, cm, mm, or metres per unit as a number."""
    cell_size: float | None = None
    """Of the lattice that fills --surface [m]; default: 0.010."""
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
    """Build an organ from a closed surface or a tetrahedral mesh, report on it, and write it."""

    file: tyro.conf.Positional[Path]
    """Closed surface (STL, OBJ, PLY) or tets (vtu, vtk, msh, mesh)."""
    length_unit: MaybeText = None
    """m, cm, mm, or metres per unit as a number; required where the format has none."""
    cell_size: float = CELL_SIZE
    """Of the lattice that fills a surface [m]."""
    out: MaybePath = None
    """Where the mesh is written (vtu, vtk, msh, mesh)."""
    youngs_modulus: MaybeNumber = None
    """[Pa]; default: the liver's."""


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
        _palpate(command, console)
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
        from surgsim_env.organ_report import report_organ

        unit = None if command.length_unit is None else _unit(command.length_unit)
        report_organ(command.file, unit, command.cell_size, command.youngs_modulus, command.out, console)
    else:
        table = Table()
        table.add_column("scene")
        table.add_column("what it is")
        for name in list_scenes():
            table.add_row(name, make_scene(name).description)
        console.print(table)
    return 0


def _palpate(command: Palpate, console: Console) -> None:
    from surgsim_env.palpation.figures import write_stiffness_map
    from surgsim_env.palpation.job import MODEL_MODULUS_ERROR, run_palpation
    from surgsim_env.palpation.report import (
        CSV_NAME,
        PICTURE_NAME,
        SUMMARY_NAME,
        print_report,
        write_csv,
        write_summary,
    )
    from surgsim_env.palpation.surface_scene import load_stable_anatomy

    scene = _scene(command, console)
    anatomy = load_anatomy(scene)
    lesions = _lesions(command, anatomy)
    anatomy = load_stable_anatomy(scene, lesions, modulus_factor_largest=1.0 + MODEL_MODULUS_ERROR)
    if command.seed < 0:
        raise ValueError(f"--seed is {command.seed}; it must be a whole number of at least 0")
    around = None
    if command.around is not None:
        x, y, z, radius = _numbers("--around", command.around, "x,y,z,radius")
        if not 0.0 < radius < float("inf"):
            raise ValueError(f"--around {command.around}: the radius is {radius:g} m; it must be finite and above 0")
        around = Ball((x, y, z), radius)
    # Before the work: a place that cannot be written is better known now than after it.
    folder = writable_folder(command.out or _free_folder(scene.name), (CSV_NAME, SUMMARY_NAME, PICTURE_NAME))
    found = run_palpation(
        anatomy, lesions=lesions, around=around, seed=command.seed, workers=command.workers, console=console
    )
    write_csv(found, folder / CSV_NAME)
    write_summary(found, folder / SUMMARY_NAME, vars(command))
    write_stiffness_map(found, folder / PICTURE_NAME)
    print_report(found, console)
    console.print(f"written: {folder}/{{{CSV_NAME},{SUMMARY_NAME},{PICTURE_NAME}}}", highlight=False, soft_wrap=True)


def _scene(command: Palpate, console: Console) -> Scene:
    from surgsim_env.palpation.surface_scene import SurfaceOptions, surface_scene, with_options

    if sum(source is not None for source in (command.scene, command.organ, command.surface)) > 1:
        raise ValueError("give only one of --scene, --organ and --surface")
    approach = None
    if command.approach is not None:
        x, y, z = _numbers("--approach", command.approach, "x,y,z")
        approach = (x, y, z)
    balls = (_numbers("--anchors", text, "x,y,z,radius") for text in command.anchors)
    options = SurfaceOptions(
        approach=approach,
        anchors=tuple((x, y, z, radius) for x, y, z, radius in balls),
        press_depth=command.press_depth,
        tip_radius=command.tip_radius,
        spacing=command.spacing,
        youngs_modulus=command.youngs_modulus,
    )
    if command.surface is None:
        for option in ("anchors", "cell_size", "length_unit"):
            if getattr(command, option):
                name = option.replace("_", "-")
                raise ValueError(f"--{name} goes with --surface; a scene states its own mesh and anchors")
        scene = load_scene(command.organ) if command.organ else make_scene(command.scene or "liver")
        return with_options(scene, options)
    if command.length_unit is None:
        raise ValueError('--surface needs --length-unit: "m", "cm", "mm" or metres per unit; its format states none')
    unit = _unit(command.length_unit)
    cell_size = CELL_SIZE if command.cell_size is None else command.cell_size
    scene = surface_scene(command.surface, length_unit=unit, cell_size=cell_size, options=options)
    x, y, z = scene.instrument.approach
    held = "the anchors given" if command.anchors else "its bed, the deepest 15 % along the approach"
    material, depth, tip = scene.material, scene.palpation.press_depth, scene.instrument.tip_radius
    console.print(
        f"{command.surface.name}: pressed along {x:.3g}, {y:.3g}, {z:.3g} of the file's axes (--approach), "
        f"held by {held}; E {material.youngs_modulus:g} Pa, nu {material.poisson_ratio:g}, tip {tip * 1e3:g} mm, "
        f"depth {depth * 1e3:g} mm, capsule and damping as in the scene liver",
        highlight=False,
    )
    return scene


def _lesions(command: Palpate, anatomy: Anatomy) -> list[Lesion]:
    if not command.lesion:
        return anatomy.demonstration_lesions()
    lesions = []
    for number, text in enumerate(command.lesion, start=1):
        x, y, z, radius, ratio = _numbers("--lesion", text, "x,y,z,radius,ratio")
        if not ratio > 0.0:
            raise ValueError(f"--lesion {text}: the modulus ratio is {ratio:g}; it must be above 0")
        lesions.append(anatomy.lesion_at((x, y, z), radius, ratio, f"lesion {number}"))
    return lesions


def _numbers(option: str, text: str, form: str) -> tuple[float, ...]:
    """The numbers of a list such as 0,0,-1; ValueError with the form it should have."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != len(form.split(",")):
        raise ValueError(f"{option} is {text!r}; the form is {form}, numbers with commas and no blanks between them")
    return numbers


def _unit(text: str) -> LengthUnit:
    try:
        return float(text)
    except ValueError:
        return text


def _free_folder(scene: str) -> Path:
    number = 1
    while (folder := Path("runs") / f"palpate-{scene}-{number}").exists():
        number += 1
    return folder


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
