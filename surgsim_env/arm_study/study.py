"""Evaluation of two arms on a patient's anatomy: reach, dexterity, clearances."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.arm_study.clearance import ClusteredSurface
from surgsim_env.arm_study.collisions import Surroundings
from surgsim_env.arm_study.kinematics import BatchKinematics
from surgsim_env.arm_study.pictures import draw_arms
from surgsim_env.arm_study.ports import InnerTarget, PortPlace, Ports, default_ports, read_ports
from surgsim_env.arm_study.reach import Reach, Sites, evaluate_both, evaluate_reach, tip_ball
from surgsim_env.arm_study.results import ArmReach, ArmsEvaluation
from surgsim_env.arm_study.summary import plain_ports, summarise
from surgsim_env.instruments.arm.arm import Arm, load_arm
from surgsim_env.rendering.gl import NoGLError
from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.arm_description import ArmDescription
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import Scene

# Called with the current work in words and the share of the whole that is done.
Progress = Callable[[str, float], None]
# Places from which each point is chosen.
PLACES_PER_POINT = 12


def evaluate_arms(
    scene: str | Path | Scene | Anatomy,
    left: str | Path | ArmDescription,
    right: str | Path | ArmDescription,
    ports: str | Path | Ports | None = None,
    targets: Sequence[InnerTarget] | None = None,
    *,
    seed: int = 0,
    count: int = 500,
    progress: Progress | None = None,
    pictures: bool = False,
) -> ArmsEvaluation:
    """Evaluate two arms on a scene's organ at rest; the same arguments give the same result to the bit.

    Args:
        scene: a scene's name, its TOML file, or what is loaded from these.
        left: a shipped arm's name or the TOML file of one's own.
        right: likewise.
        ports: a ports file, or the result of `read_ports`; `default_ports` where none is given.
        targets: inner targets; those of the ports file where none are given.
        seed: draws the first point of the surface.
        count: number of points of the surface.
        progress: called with the current work and the share that is done.
        pictures: whether to draw the arms in the patient; without OpenGL there are none, `progress` gets the reason.

    Raises:
        ValueError: one line with what is wrong in scene, arm or ports, and the way out.
    """
    tell = progress or (lambda _what, _share: None)
    tell("reading the scene", 0.0)
    anatomy = scene if isinstance(scene, Anatomy) else load_anatomy(_scene(scene))
    where = _ports(ports, anatomy)
    where.check_outside(anatomy)
    inner = where.targets if targets is None else tuple(targets)
    arms = [_arm(side, place, anatomy) for side, place in ((left, where.left), (right, where.right))]
    sites = _sites(anatomy, where, inner, count, seed)
    reaches = _reaches(anatomy, arms, sites, where, tell)
    tell("both arms at once", 0.85)
    both = evaluate_both(reaches[0], reaches[1], sites.points)
    reports = reaches[0].report, reaches[1].report
    inputs = _inputs(anatomy, reports, where, count)
    found = ArmsEvaluation(
        points=sites.points,
        normals=sites.normals,
        inner=sites.inner,
        left=reports[0],
        right=reports[1],
        both=both.reachable,
        arm_distance_inside=both.inside,
        arm_distance_outside=both.outside,
        summary=summarise(sites, *reports, both, inner, inputs, seed),
        scene=anatomy.scene.name,
        surface_points=anatomy.mesh.points,
        surface_triangles=anatomy.mesh.boundary_triangles,
        pictures={},
        ports=where.frames,
    )
    if pictures:
        found = replace(found, pictures=_pictures(found, (arms[0].arm, arms[1].arm), where, tell))
    tell("done", 1.0)
    return found


def _reaches(
    anatomy: Anatomy, arms: list[BatchKinematics], sites: Sites, ports: Ports, tell: Progress
) -> tuple[Reach, Reach]:
    """Reach of the left and the right arm."""
    organ = ClusteredSurface(anatomy.mesh.points, anatomy.mesh.boundary_triangles)
    found = []
    for index, kinematics in enumerate(arms):
        tell(f"the {('left', 'right')[index]} arm at {len(sites.points)} points", 0.05 + 0.4 * index)
        found.append(evaluate_reach(kinematics, sites, Surroundings(organ, ports, tip_ball(kinematics))))
    return found[0], found[1]


def _inputs(anatomy: Anatomy, reports: tuple[ArmReach, ArmReach], ports: Ports, count: int) -> dict[str, Any]:
    return {
        "scene": anatomy.scene.name,
        "left": reports[0].name,
        "right": reports[1].name,
        "ports": plain_ports(ports),
        "count": count,
    }


def _scene(scene: str | Path | Scene) -> Scene:
    return scene if isinstance(scene, Scene) else make_scene(scene)


def _ports(ports: str | Path | Ports | None, anatomy: Anatomy) -> Ports:
    if ports is None:
        return default_ports(anatomy)
    return ports if isinstance(ports, Ports) else read_ports(ports)


def _arm(source: str | Path | ArmDescription, place: PortPlace, anatomy: Anatomy) -> BatchKinematics:
    """An arm at its port, with the scene's tip."""
    return BatchKinematics(load_arm(source, place.port, tip_radius=anatomy.scene.instrument.tip_radius))


def _sites(anatomy: Anatomy, ports: Ports, targets: Sequence[InnerTarget], count: int, seed: int) -> Sites:
    """Points of the surface, then the inner targets, whose normals point to the endoscope."""
    trocars = np.array([ports.left.point, ports.right.point])
    points, normals = facing_points(anatomy, trocars, count, seed)
    inner: FloatArray = np.array([target.point for target in targets], dtype=np.float64).reshape(-1, 3)
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
    left out. Triangles are quartered until there are many small ones; from their centroids each
    next point is the one furthest from all before it (farthest-point sampling), the first drawn from the seed.

    Raises:
        ValueError: fewer than one point asked for, or no triangle faces the ports.
    """
    if count < 1:
        raise ValueError(f"{count} points of the surface asked for; at least 1 is needed")
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
        corners, normals = _quartered(corners), np.repeat(normals, 4, axis=0)
    centres = corners.mean(axis=1)
    # Ranked by distance from the ports: a mirrored organ has mirrored points, in the same order.
    ranked = np.argsort(np.linalg.norm(centres - middle, axis=1), kind="stable")
    chosen = _spread(centres, count, int(ranked[np.random.default_rng(seed).integers(len(centres))]))
    return centres[chosen], normals[chosen]


def _quartered(corners: FloatArray) -> FloatArray:
    """Each triangle (n, 3, 3) cut into four congruent ones."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
    parts = [np.stack(three, axis=1) for three in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.stack(parts, axis=1).reshape(-1, 3, 3)


def _spread(points: FloatArray, count: int, first: int) -> np.ndarray:
    """Indices of points, each the furthest from those before it, (count,)."""
    chosen = [first]
    nearest = ((points - points[first]) ** 2).sum(axis=1)
    for _ in range(count - 1):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
    return np.array(chosen)


def _pictures(
    evaluation: ArmsEvaluation, arms: tuple[Arm, Arm], ports: Ports, tell: Progress
) -> dict[str, NDArray[np.uint8]]:
    """Pictures by caption, none where there is no OpenGL."""
    tell("pictures", 0.95)
    try:
        return draw_arms(evaluation, arms, ports)
    except NoGLError as error:
        tell(f"no pictures: {error}", 0.95)
        return {}
