"""`surgsim arms`: reads and checks what is asked for, has it evaluated, and writes the report with all its files."""

import hashlib
import json
import platform
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from surgsim_env.anatomy import Anatomy, load_anatomy
from surgsim_env.arms.arm import Arm, load_arm
from surgsim_env.arms.description import ArmDescription, read_description
from surgsim_env.arms.port import Port
from surgsim_env.evaluation.arm_maps import ArmMaps, Picture
from surgsim_env.evaluation.arm_picture import write_given_pictures, write_pictures
from surgsim_env.evaluation.arm_quantities import extreme, number_text, verdict, worst_clearance
from surgsim_env.evaluation.arm_report import write_report
from surgsim_env.evaluation.arm_results import ArmsEvaluation
from surgsim_env.evaluation.arm_table import Candidate, Ranked, rank, write_points
from surgsim_env.evaluation.arms import evaluate_arms
from surgsim_env.evaluation.episode_figures import Episodes, clause, plain_episodes
from surgsim_env.evaluation.episodes import run_episodes
from surgsim_env.evaluation.ports import Ports, default_ports, read_ports
from surgsim_env.out_folder import writable_folder
from surgsim_env.palpation.report import package_version, plain_json
from surgsim_env.scenes import Scene, load_scene, make_scene
from surgsim_env.toml_tables import read_toml

REPORT_NAME, POINTS_NAME, SUMMARY_NAME = "report.html", "points.csv", "summary.json"
FEWEST_POINTS = 10
# A file of --compare with one of these tables is a ports file, any other an arm.
PORT_TABLES = {"left", "right", "endoscope"}


@dataclass(frozen=True)
class Request:
    """What the command line asks for; see `surgsim arms --help`."""

    scene: str
    left: str
    right: str
    ports: Path | None
    compare: tuple[str, ...]
    points: int
    episodes: int
    seed: int
    out: Path


@dataclass(frozen=True)
class Setup:
    """Two arms at their ports.

    Fields:
        name, what: as a ranking shows them
        left, right: the arms, placed
        ports: theirs and the endoscope's
    """

    name: str
    what: str
    left: Arm
    right: Arm
    ports: Ports


def report_arms(request: Request, console: Console) -> ArmsEvaluation:
    """Evaluate and write report.html, points.csv, the heat maps and summary.json; returns the evaluation.

    Raises:
        ValueError: one line about what is asked for and cannot be.
    """
    for name, least in (("points", FEWEST_POINTS), ("episodes", 0), ("seed", 0)):
        if getattr(request, name) < least:
            raise ValueError(f"--{name} is {getattr(request, name)}; it must be a whole number of at least {least}")
    anatomy = load_anatomy(_scene(request.scene))
    setups = [_setup(request, anatomy), *(_compared(one, request, anatomy) for one in request.compare)]
    # Before the work: a place that cannot be written is better known now than after it.
    folder = writable_folder(request.out, (REPORT_NAME, POINTS_NAME, SUMMARY_NAME))
    found = []
    for number, setup in enumerate(setups):
        one = evaluate(setup, anatomy, request, console, pictures=number == 0)
        found.append(replace(one, ports=_by_name(setup.ports)))
    first = found[0]
    ranking = rank([Candidate(s.name, s.what, one) for s, one in zip(setups, found, strict=True)]) if found[1:] else []
    episodes = scripted_episodes(setups[0], request, console) if request.episodes else None
    said = " ".join(filter(None, (verdict(first), clause(episodes, first.scene))))
    summary = {**_summary(first, request, ranking), **plain_json(plain_episodes(episodes), digits=12), "verdict": said}
    first = replace(first, summary=summary)
    (folder / SUMMARY_NAME).write_text(
        json.dumps(summary, indent=2, sort_keys=True, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8"
    )
    write_points(first, folder / POINTS_NAME)
    pictures = write_pictures(first, (setups[0].left, setups[0].right), folder)
    ends = _write_ends(episodes, folder)
    maps = ArmMaps(first).write_all(folder)
    write_report(
        first,
        folder / REPORT_NAME,
        pictures=pictures,
        maps=maps,
        command=command_text(request),
        ranking=ranking,
        episodes=episodes,
        episode_pictures=ends,
    )
    console.print(said, highlight=False)
    if ranking:
        _print_ranking(ranking, console)
    names = ",".join((REPORT_NAME, POINTS_NAME, SUMMARY_NAME, *(one.name for one in (*pictures, *maps, *ends))))
    console.print(f"written: {folder}/{{{names}}}", highlight=False, soft_wrap=True)
    return first


def evaluate(setup: Setup, anatomy: Anatomy, request: Request, console: Console, *, pictures: bool) -> ArmsEvaluation:
    """One setup on the organ, with a progress bar."""
    left, right = setup.left.description, setup.right.description
    with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console) as bar:
        task = bar.add_task(setup.name, total=1.0)

        def tell(what: str, share: float) -> None:
            bar.update(task, description=f"{setup.name}: {what}", completed=share)

        return evaluate_arms(
            anatomy, left, right, setup.ports, seed=request.seed, count=request.points, progress=tell, pictures=pictures
        )


def scripted_episodes(setup: Setup, request: Request, console: Console) -> Episodes:
    """Episodes of the oracle script with the command's arms, with a progress bar."""
    with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console) as bar:
        task = bar.add_task("episodes", total=1.0)
        return run_episodes(
            (request.left, request.right),
            (setup.left, setup.right),
            range(request.seed, request.seed + request.episodes),
            lambda what, share: bar.update(task, description=what, completed=share),
        )


def command_text(request: Request) -> str:
    """The command that makes the same report, but for --out; files outside the working folder by their names alone."""
    words = ["surgsim", "arms", "--scene", _shown(request.scene), "--left", _shown(request.left)]
    words += ["--right", _shown(request.right)]
    if request.ports is not None:
        words += ["--ports", _shown(request.ports)]
    if request.compare:
        words += ["--compare", *map(_shown, request.compare)]
    return shlex.join(
        [*words, "--points", str(request.points), "--episodes", str(request.episodes), "--seed", str(request.seed)]
    )


def _scene(name: str) -> Scene:
    return load_scene(Path(name)) if name.endswith(".toml") else make_scene(name)


def _setup(request: Request, anatomy: Anatomy) -> Setup:
    ports = _checked_ports(request.ports, anatomy)
    left, right = _read("--left", request.left), _read("--right", request.right)
    return _placed(_ports_name(request), f"{left.name} left, {right.name} right, as given", left, right, ports, anatomy)


def _compared(source: str, request: Request, anatomy: Anatomy) -> Setup:
    """What a file of --compare stands for: other ports for the same arms, or an arm on both sides at the same ports."""
    path = Path(source)
    if _is_ports_file(source):
        left, right = _read("--left", request.left), _read("--right", request.right)
        ports = _checked_ports(path, anatomy)
        return _placed(path.name, f"ports, with {left.name} left, {right.name} right", left, right, ports, anatomy)
    arm = _read("--compare", source)
    ports = _checked_ports(request.ports, anatomy)
    return _placed(path.name, f"arm on both sides, at the ports of {_ports_name(request)}", arm, arm, ports, anatomy)


def _is_ports_file(source: str) -> bool:
    return source.endswith(".toml") and bool(PORT_TABLES & read_toml(Path(source), "--compare").keys())


def _placed(name: str, what: str, left: ArmDescription, right: ArmDescription, ports: Ports, anatomy: Anatomy) -> Setup:
    radius = anatomy.scene.instrument.tip_radius
    left_arm = load_arm(left, ports.left.port, tip_radius=radius)
    return Setup(name, what, left_arm, load_arm(right, ports.right.port, tip_radius=radius), ports)


def _read(option: str, source: str) -> ArmDescription:
    try:
        return read_description(source)
    except ValueError as error:
        raise ValueError(f"{option}: {error}") from None


def _write_ends(episodes: Episodes | None, folder: Path) -> list[Picture]:
    """Pictures of how episodes ended."""
    told = "Drawn with OpenGL: the lobe and both arms in the overview and through the endoscope; "
    told += "the target is green, arrows are the tissue's force on each tool."
    given = {} if episodes is None else episodes.pictures
    written = write_given_pictures(given, folder, name="episode")
    return [replace(one, description=told) for one in written]


def _ports_name(request: Request) -> str:
    return "default ports" if request.ports is None else request.ports.name


def _checked_ports(path: Path | None, anatomy: Anatomy) -> Ports:
    if path is None:
        return default_ports(anatomy)
    ports = read_ports(path)
    try:
        ports.check_outside(anatomy)
    except ValueError as error:
        raise ValueError(f"ports file {path.name}: {error}") from None
    return ports


def _ports_input(path: Path | None, evaluation: ArmsEvaluation) -> dict[str, Any]:
    if path is None:
        return dict(_table(_table(dict(evaluation.summary), "inputs"), "ports"))
    return {"file": _shown(path), **read_toml(path, "ports")}


def _by_name(ports: Ports) -> dict[str, Port]:
    """The frames of all three ports; the endoscope's looks at its target."""
    scope = ports.endoscope
    x, y, z = (there - here for here, there in zip(scope.point, scope.target, strict=True))
    return {"left": ports.left.port, "right": ports.right.port, "endoscope": Port(scope.point, (x, y, z))}


def _shown(source: str | Path) -> str:
    """A path without what depends on the machine: relative to the working folder, or its name alone."""
    path = Path(source)
    if not path.is_absolute():
        return path.as_posix()
    return path.relative_to(Path.cwd()).as_posix() if path.is_relative_to(Path.cwd()) else path.name


def _summary(evaluation: ArmsEvaluation, request: Request, ranking: Sequence[Ranked]) -> dict[str, Any]:
    """What the evaluation says of itself, completed by inputs with their checksums, versions, shares and extremes."""
    clearance, what = worst_clearance(evaluation)
    force = extreme(evaluation, "tip_force")
    inputs: dict[str, Any] = {
        "scene": _shown(request.scene) if not request.scene.endswith(".toml") else _file_input(Path(request.scene)),
        "points": request.points,
        "episodes": request.episodes,
        "left": _arm_input(request.left),
        "right": _arm_input(request.right),
        "ports": _ports_input(request.ports, evaluation),
        "compare": [_compared_input(one) for one in request.compare],
    }
    own = {
        "versions": {
            "surgsim": package_version(),
            "python": platform.python_version(),
            **{name: version(name) for name in ("numpy", "scipy", "mujoco", "matplotlib")},
        },
        "seed": request.seed,
        "worst_clearance": {"value_m": clearance.value, "arm": clearance.side, "from": what, "point": clearance.point},
        "smallest_tip_force": {"value_N": force.value, "arm": force.side, "point": force.point},
        "compared": [vars(one) for one in ranking],
    }
    given = dict(evaluation.summary)
    merged = {**given, **own, "inputs": {**_table(given, "inputs"), **inputs}}
    merged["versions"] = {**_table(given, "versions"), **own["versions"]}
    return plain_json(merged, digits=12)


def _table(summary: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    value = summary.get(name)
    return value if isinstance(value, Mapping) else {}


def _compared_input(source: str) -> dict[str, str]:
    return _file_input(Path(source)) if _is_ports_file(source) else _arm_input(source)


def _file_input(path: Path) -> dict[str, str]:
    return {"file": _shown(path), path.name: _checksum(path)}


def _checksum(path: Path) -> str:
    return f"sha256 {hashlib.sha256(path.read_bytes()).hexdigest()}"


def _arm_input(source: str) -> dict[str, str]:
    """An arm's name with the checksums of its files: they say what ran, wherever the files were."""
    description = read_description(source)
    files = (description.folder / f"{description.name}.toml", description.folder / description.model)
    sums = {file.name: _checksum(file) for file in files}
    return {"arm": _shown(source), **sums}


def _print_ranking(ranking: Sequence[Ranked], console: Console) -> None:
    for one in ranking:
        figures = (
            f"both {100.0 * one.both:.0f} %, median clearance {number_text(one.clearance, 1e3, 1, 'mm')}, "
            f"smallest tip force {number_text(one.force, 1.0, 2, 'N')}"
        )
        console.print(f"{one.place}. {one.name}: {figures}; {one.reasons}", highlight=False)
