"""Evaluation of two arms on a patient's anatomy, and a study of several setups with its files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from rich.console import Console

from msdm_core.mesh import FloatArray
from surgsim_apps.arms.arms_in_patient import ArmsInPatient
from surgsim_apps.arms.capability import Capability, quartered, shifted_bases
from surgsim_apps.arms.clearance import Obstacles
from surgsim_apps.arms.kinematics import BatchKinematics
from surgsim_apps.arms.pictures import ArmMaps, camera_view
from surgsim_apps.arms.points_file import write_placements, write_points
from surgsim_apps.arms.port_moves import best_move
from surgsim_apps.arms.port_search import PortSearch, on_one_wall
from surgsim_apps.arms.ports import Ports, default_ports, read_ports
from surgsim_apps.arms.quantities import QUANTITIES
from surgsim_apps.arms.quick_reach import QuickReach
from surgsim_apps.arms.ranking import rank
from surgsim_apps.arms.reach import (
    Sites,
    evaluate_both,
    evaluate_reach,
    tip_ball,
)
from surgsim_apps.arms.report import write_report
from surgsim_apps.arms.results import ArmsEvaluation
from surgsim_apps.arms.through_cycle import evaluate_cycle
from surgsim_apps.arms.with_errors import evaluate_errors
from surgsim_apps.arms.wording import verdict
from surgsim_apps.reports.output_folder import AnyFolder
from surgsim_env.instruments import SIDES, load_arm
from surgsim_env.scene import Anatomy, ArmDescription, Scene, as_toml, load_anatomy, make_scene
from surgsim_env.step_progress import StepProgress

# Candidates for each point.
PLACES_PER_POINT = 12
# Points of a search for ports, and for moves of a port.
SEARCH_POINTS = 48
REPORT_NAME, POINTS_NAME = "report.html", "points.csv"
FOUND_NAME, PLACEMENTS_NAME = "ports.toml", "placements.csv"
# All possible files of a study.
RESULT_NAMES = (
    *(REPORT_NAME, POINTS_NAME, FOUND_NAME, PLACEMENTS_NAME, "map_reach.png"),
    *(f"{side}.toml" for side in SIDES),
    *(f"map_{quantity.field}.png" for quantity in QUANTITIES),
)


def evaluate_arms(
    scene: str | Path | Scene | Anatomy,
    left: str | Path | ArmDescription,
    right: str | Path | ArmDescription,
    ports: str | Path | Ports | None = None,
    *,
    seed: int = 0,
    count: int = 500,
    faced: Ports | None = None,
    progress: StepProgress | None = None,
    tables: Mapping[str, Capability] | None = None,
    turning: bool = False,
) -> ArmsEvaluation:
    """Evaluate two arms on a scene's organ at rest; the same arguments give the same result to the bit.

    A scene with motions is evaluated through their cycle too: `ArmsEvaluation.cycle`.

    Args:
        scene: a scene's name, its TOML file, or the loaded scene or anatomy.
        left: a shipped arm's name, a TOML file or a description.
        right: likewise.
        ports: a ports file, or the result of `read_ports`; by default `default_ports`.
        seed: draws the first point of the surface.
        count: number of points of the surface.
        faced: other ports that the points face, for a comparison.
        progress: shows the steps.
        tables: what each arm reaches, by side, to try moves of the ports.
        turning: True for a scene of the arms in the patient.

    Raises:
        ValueError: a wrong scene, arm or port, in one line with the way out.
    """
    progress = progress or StepProgress()
    if not isinstance(scene, Anatomy):
        scene = load_anatomy(scene if isinstance(scene, Scene) else make_scene(scene))
    anatomy = scene
    if ports is None:
        where = default_ports(anatomy)
    else:
        where = ports if isinstance(ports, Ports) else read_ports(ports)
    where.check_outside(anatomy)
    radius = anatomy.scene.instrument.tip_radius
    arms = tuple(
        load_arm(source, place.port, tip_radius=radius) for source, place in ((left, where.left), (right, where.right))
    )
    sites = find_sites(anatomy, where, count, seed, faced)
    obstacles, reaches, around, with_errors = Obstacles.of(anatomy, where), [], [], {}
    for side, arm in zip(SIDES, arms, strict=True):
        with progress.step(f"the {side} arm at {len(sites.points)} points"):
            kinematics = BatchKinematics(arm)
            around.append(replace(obstacles, ball=tip_ball(kinematics)))
            reaches.append(evaluate_reach(kinematics, sites, around[-1]))
            if effect := evaluate_errors(reaches[-1], sites, around[-1], seed):
                with_errors[side] = effect
    with progress.step("both arms at once"):
        both = evaluate_both(reaches[0], reaches[1], sites.points)
    cycle = None
    if anatomy.scene.motions:
        cycle = evaluate_cycle((reaches[0], reaches[1]), both, sites, (around[0], around[1]), anatomy, progress)
    surface, triangles = anatomy.outer_surface
    evaluation = ArmsEvaluation(
        points=sites.points,
        normals=sites.normals,
        inner=sites.inner,
        left=reaches[0].report,
        right=reaches[1].report,
        both=both.reachable,
        arm_distance_inside=both.inside,
        arm_distance_outside=both.outside,
        scene=anatomy.scene.name,
        surface_points=surface,
        surface_triangles=triangles,
        ports=where.frames,
        with_errors=with_errors,
        cycle=cycle,
    )
    if tables is not None and not both.reachable[~sites.inner].all():
        with progress.step("moving the ports"):
            outer = np.flatnonzero(~sites.inner)
            quick = QuickReach(anatomy, tables, obstacles, sites.only(outer[:SEARCH_POINTS]))
            move = best_move(quick, where, both.reachable[outer], camera_view(evaluation))
        evaluation = replace(evaluation, move=move, moves_tried=True)
    if turning:
        given = None if faced == where else faced
        shown = ArmsInPatient.at_middle(evaluation, arms, both, where, given)
        evaluation = replace(evaluation, turning=shown.scene())
    return evaluation


def find_sites(anatomy: Anatomy, ports: Ports, count: int, seed: int, faced: Ports | None = None) -> Sites:
    """Points of the surface that face the ports, or others, then the inner targets with normals to the endoscope."""
    towards = faced or ports
    trocars = np.array([towards.left.point, towards.right.point])
    points, normals = facing_points(anatomy, trocars, count, seed)
    inner: FloatArray = np.array([target.point for target in ports.targets], dtype=np.float64).reshape(-1, 3)
    out = np.array(ports.endoscope.point) - inner
    out /= np.maximum(np.linalg.norm(out, axis=1), 1e-12)[:, None]
    return Sites(
        np.concatenate([points, inner]),
        np.concatenate([normals, out]),
        np.arange(len(points) + len(inner)) >= len(points),
    )


def facing_points(anatomy: Anatomy, ports: ArrayLike, count: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Points on the organ's surface [m] and unit outward normals there, each (count, 3).

    A triangle faces the ports if the middle of the ports (n_port, 3) [m] lies on its outer side; anchored triangles are
    left out. Triangles are quartered until there are many small ones; their centroids are thinned by farthest-point
    sampling, the first point drawn from the seed.

    Raises:
        ValueError: no triangle faces the ports.
    """
    corners = anatomy.mesh.points[anatomy.mesh.boundary_triangles]
    held = np.isin(anatomy.mesh.boundary_triangles, anatomy.anchors).all(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    middle = np.asarray(ports, dtype=np.float64).mean(axis=0)
    facing = ~held & (((middle - corners.mean(axis=1)) * normals).sum(axis=1) > 0.0)
    if not facing.any():
        raise ValueError("no free part of the organ's surface faces the ports: move the ports")
    corners, normals = corners[facing], normals[facing]
    while len(corners) < PLACES_PER_POINT * count:
        corners, normals = quartered(corners), np.repeat(normals, 4, axis=0)
    centres = corners.mean(axis=1)
    # Ranked by distance from the ports: a mirrored organ has mirrored points, in the same order.
    ranked = np.argsort(np.linalg.norm(centres - middle, axis=1), kind="stable")
    chosen = _spread(centres, count, int(ranked[np.random.default_rng(seed).integers(len(centres))]))
    return centres[chosen], normals[chosen]


def _spread(points: FloatArray, count: int, first: int) -> np.ndarray:
    """Indices of points, each the furthest from those before it, (count,)."""
    chosen = [first]
    nearest = ((points - points[first]) ** 2).sum(axis=1)
    for _ in range(count - 1):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
    return np.array(chosen)


@dataclass(frozen=True)
class ArmSetup:
    """Two arms at their ports.

    Fields:
        name, what: of its row in a ranking
        left, right: descriptions of the arms
        ports: theirs and the endoscope's
    """

    name: str
    what: str
    left: ArmDescription
    right: ArmDescription
    ports: Ports


def run_study(
    setups: Sequence[ArmSetup],
    anatomy: Anatomy,
    folder: AnyFolder,
    console: Console,
    *,
    points: int,
    seed: int,
    command: str,
    search_seconds: float | None = None,
) -> list[str]:
    """Evaluate the setups, rank them if there are several, and write report, points and heat maps.

    Args:
        setups: the reported one, then those of the comparison. The points of all face the ports of the first.
        anatomy: of the organ.
        folder: for the files.
        console: for progress and results.
        points: number of points of the organ.
        seed: of the points.
        command: the command line, for the report.
        search_seconds: time for a search of better ports, which are reported in place of the first setup's.

    Returns:
        The names of the files.
    """
    evaluations, given, found = [], setups[0], None
    with StepProgress(console) as progress:
        with progress.step("tables of what each arm reaches"):
            choices = make_tables(given, anatomy.scene.instrument.tip_radius, shifted=search_seconds is not None)
        tables: Mapping[str, Capability] = {side: row[0] for side, row in choices.items()}
        if search_seconds is not None:
            sites = find_sites(anatomy, given.ports, SEARCH_POINTS, seed)
            ports = on_one_wall(given.ports)
            quick = QuickReach(anatomy, tables, Obstacles.of(anatomy, ports), sites)
            found = PortSearch(anatomy, quick, ports, choices).run(search_seconds, seed, progress)
            tables = quick.tables
            what = f"ports found, {given.left.name} left, {given.right.name} right"
            setups = [replace(given, name=FOUND_NAME, what=what, ports=found.best.ports, **found.arms), *setups]
        for setup in setups:
            progress.say(f"{setup.name}: {setup.what}")
            evaluations.append(
                evaluate_arms(
                    anatomy,
                    setup.left,
                    setup.right,
                    setup.ports,
                    seed=seed,
                    count=points,
                    faced=given.ports,
                    progress=progress,
                    tables=tables if setup is setups[0] else None,
                    turning=setup is setups[0],
                )
            )
        first = replace(evaluations[0], search=found)
        maps = ArmMaps(first).write_all(folder, progress)
    ranking = (
        rank([(setup.name, setup.what, each) for setup, each in zip(setups, evaluations, strict=True)])
        if evaluations[1:]
        else []
    )
    write_points(first, folder / POINTS_NAME)
    write_report(first, folder / REPORT_NAME, maps=maps, command=command, ranking=ranking)
    console.print(verdict(first), highlight=False)
    names = [REPORT_NAME, POINTS_NAME, *(drawing.name for drawing in maps)]
    if found is not None:
        write_placements(found, folder / PLACEMENTS_NAME)
        (folder / FOUND_NAME).write_text(as_toml(found.best.ports), encoding="utf-8", newline="\n")
        names += [FOUND_NAME, PLACEMENTS_NAME]
        for side, arm in found.arms.items():
            names.append(f"{side}.toml")
            moved = replace(arm, model=str((arm.folder / arm.model).resolve()))
            (folder / names[-1]).write_text(as_toml(moved), encoding="utf-8", newline="\n")
    return names


def make_tables(setup: ArmSetup, tip_radius: float, *, shifted: bool) -> dict[str, list[Capability]]:
    """Tables of both arms, of equal arms the same ones, with those of their `shifted_bases`."""

    def tables(arm: ArmDescription) -> list[Capability]:
        return [Capability(each, tip_radius) for each in (arm, *(shifted_bases(arm) if shifted else ()))]

    left = tables(setup.left)
    return {"left": left, "right": left if setup.right == setup.left else tables(setup.right)}
