"""`surgsim arms`: two arms evaluated on an organ, with a report."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console

from surgsim_apps.arms.ports import Ports, default_ports, read_ports
from surgsim_apps.arms.study import RESULT_NAMES, ArmSetup, run_study
from surgsim_apps.cli.values import AnyPath, MaybePath, MaybeText, SceneName, Text, shown_as, shown_path
from surgsim_apps.reports.output_folder import output_folder
from surgsim_env.instruments import load_arm
from surgsim_env.scene import (
    Anatomy,
    ArmDescription,
    load_anatomy,
    make_scene,
    read_description,
    read_toml,
    with_motion,
)

FEWEST_POINTS, MOST_POINTS = 10, 100_000
# Tables of a ports file; any other file of --compare is an arm.
PORT_TABLES = {"left", "right", "endoscope"}


@dataclass(frozen=True)
class Arms:
    """Evaluate two arms on a patient's organ: reach of each and of both at once, clearances, forces, dexterity.

    Writes report.html (self-contained), points.csv and heat maps (PNG). See docs/arms_report.md.
    """

    left: Text
    """The left arm: a shipped arm's name (psm_grasper, psm_retractor, ...) or a TOML file (docs/arms.md)."""
    right: Text
    """The right arm, likewise."""
    ports: MaybePath = None
    """TOML file with tables [left], [right] and [endoscope], each with `point` [m] and `into` or `target`; default:
    ports as in laparoscopy (docs/arms_report.md)."""
    scene: SceneName = "liver"
    """A shipped scene (see `surgsim scenes`) or a scene file of your own (TOML)."""
    compare: Annotated[tuple[str, ...], shown_as("FILE|ARM ...")] = ()
    """Other ports files, or arms for both sides, for a ranking."""
    points: int = 500
    """Number of points of the organ."""
    seed: int = 0
    """Seed of the points."""
    search: Annotated[int | None, shown_as("SECONDS")] = None
    """Search for better ports on the body wall for at most so long, and report them beside the given ones."""
    motion: MaybeText = None
    """Breathing of the patient: none, calm or free; default: the scene's. Adds reach, paths and clearance through the
    cycle to the report."""
    out: AnyPath = Path("runs/arms")
    """Folder for the results."""

    @property
    def command_line(self) -> str:
        """The command for the same report, without --out; files outside the working folder by name alone."""
        words = ["surgsim", "arms", "--scene", shown_path(self.scene), "--left", shown_path(self.left)]
        words += ["--right", shown_path(self.right)]
        if self.ports is not None:
            words += ["--ports", shown_path(self.ports)]
        if self.compare:
            words += ["--compare", *map(shown_path, self.compare)]
        if self.search is not None:
            words += ["--search", str(self.search)]
        counts = ["--points", self.points, "--seed", self.seed]
        if self.motion is not None:
            counts += ["--motion", self.motion]
        return shlex.join([*words, *map(str, counts)])

    def run(self, console: Console) -> int:
        """Evaluate and write report.html, points.csv, and the heat maps.

        Raises:
            ValueError: an impossible option, in one line.
        """
        for name, least in (("points", FEWEST_POINTS), ("seed", 0), ("search", 1)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"--{name} is {value}; it must be a whole number of at least {least}")
        if self.points > MOST_POINTS:
            raise ValueError(f"--points is {self.points}; it must be at most {MOST_POINTS}")
        anatomy = load_anatomy(with_motion(make_scene(self.scene), self.motion))
        setups = [_setup(self, anatomy, compared) for compared in (None, *self.compare)]
        with output_folder(self.out, RESULT_NAMES) as files:
            written = run_study(
                setups,
                anatomy,
                files,
                console,
                points=self.points,
                seed=self.seed,
                command=self.command_line,
                search_seconds=self.search,
            )
        console.print(f"written: {files.path}/{{{','.join(written)}}}", highlight=False, soft_wrap=True)
        return 0


def _setup(command: Arms, anatomy: Anatomy, compared: str | None) -> ArmSetup:
    """The arms at their ports, or with a file of --compare: at its ports, or its arm on both sides."""
    own = "default ports" if command.ports is None else command.ports.name
    left, right, ports = _read("--left", command.left), _read("--right", command.right), command.ports
    if compared is None:
        name, what = own, f"{left.name} left, {right.name} right, as given"
    elif _is_ports_file(compared):
        name, what = Path(compared).name, f"ports, with {left.name} left, {right.name} right"
        ports = Path(compared)
    else:
        name, what = Path(compared).name, f"arm on both sides, at the ports of {own}"
        left = right = _read("--compare", compared)
    placed, radius = _checked_ports(ports, anatomy), anatomy.scene.instrument.tip_radius
    # A wrong model is refused before the first evaluation, which takes a minute.
    for description, place in ((left, placed.left), (right, placed.right)):
        load_arm(description, place.port, tip_radius=radius)
    return ArmSetup(name, what, left, right, placed)


def _is_ports_file(source: str) -> bool:
    return source.endswith(".toml") and bool(PORT_TABLES & read_toml(Path(source), "--compare").keys())


def _read(option: str, source: str) -> ArmDescription:
    try:
        return read_description(source)
    except ValueError as error:
        raise ValueError(f"{option}: {error}") from None


def _checked_ports(path: Path | None, anatomy: Anatomy) -> Ports:
    if path is None:
        return default_ports(anatomy)
    ports = read_ports(path)
    try:
        ports.check_outside(anatomy)
    except ValueError as error:
        raise ValueError(f"ports file {path.name}: {error}") from None
    return ports
