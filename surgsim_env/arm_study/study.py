"""Evaluation of two arms on a patient's anatomy: reach, dexterity, clearances, and their summary."""

import json
import math
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.arm_study.clearance import MEETING_ZONE, TIP_ZONE, ClusteredSurface, Surroundings
from surgsim_env.arm_study.joint_search import APPROACH_ANGLE, DIRECTION_COUNT, REACHED
from surgsim_env.arm_study.kinematics import BatchKinematics
from surgsim_env.arm_study.pictures import draw_arms
from surgsim_env.arm_study.ports import InnerTarget, Ports, default_ports, read_ports
from surgsim_env.arm_study.reach import (
    ARM_DISTANCE,
    CHARACTERISTIC_LENGTH,
    BothArms,
    Sites,
    evaluate_both,
    evaluate_reach,
    tip_ball,
)
from surgsim_env.arm_study.results import QUANTITIES, REASONS, SIDES, ArmReach, ArmsEvaluation, spread
from surgsim_env.instruments.arm.arm import load_arm
from surgsim_env.palpation.job import package_version
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
    if not isinstance(scene, Anatomy):
        scene = load_anatomy(scene if isinstance(scene, Scene) else make_scene(scene))
    anatomy, mesh = scene, scene.mesh
    if ports is None:
        where = default_ports(anatomy)
    else:
        where = ports if isinstance(ports, Ports) else read_ports(ports)
    where.check_outside(anatomy)
    inner = where.targets if targets is None else tuple(targets)
    radius = anatomy.scene.instrument.tip_radius
    arms = tuple(
        load_arm(source, place.port, tip_radius=radius) for source, place in ((left, where.left), (right, where.right))
    )
    sites = _sites(anatomy, where, inner, count, seed)
    organ, reaches = ClusteredSurface(mesh.points, mesh.boundary_triangles), []
    for index, arm in enumerate(arms):
        tell(f"the {SIDES[index]} arm at {len(sites.points)} points", 0.05 + 0.4 * index)
        kinematics = BatchKinematics(arm)
        reaches.append(evaluate_reach(kinematics, sites, Surroundings(organ, where, tip_ball(kinematics))))
    tell("both arms at once", 0.85)
    both = evaluate_both(reaches[0], reaches[1], sites.points)
    reports = reaches[0].report, reaches[1].report
    inputs = {
        "scene": anatomy.scene.name,
        **{side: report.name for side, report in zip(SIDES, reports, strict=True)},
        # As JSON has them: lists for tuples.
        "ports": json.loads(json.dumps(asdict(where))),
        "count": count,
    }
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
        surface_points=mesh.points,
        surface_triangles=mesh.boundary_triangles,
        pictures={},
        ports=where.frames,
    )
    if pictures:
        tell("pictures", 0.95)
        try:
            found = replace(found, pictures=draw_arms(found, (arms[0], arms[1]), where))
        except NoGLError as error:
            tell(f"no pictures: {error}", 0.95)
    tell("done", 1.0)
    return found


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


def summarise(
    sites: Sites,
    left: ArmReach,
    right: ArmReach,
    both: BothArms,
    targets: Sequence[InnerTarget],
    inputs: Mapping[str, Any],
    seed: int,
) -> dict[str, Any]:
    """Shares, extremes, targets, versions, seed and inputs; SI units; the same run gives the same text."""
    outer = ~sites.inner
    return {
        "points": int(outer.sum()),
        "reachable": {
            "left": _share(left.reachable[outer]),
            "right": _share(right.reachable[outer]),
            "either": _share((left.reachable | right.reachable)[outer]),
            "both": _share(both.reachable[outer]),
        },
        "left": _arm_summary(left, outer),
        "right": _arm_summary(right, outer),
        "arm_distance_inside": _extremes(both.inside[outer]),
        "arm_distance_outside": _extremes(both.outside[outer]),
        "targets": _targets(sites, left, right, both, targets),
        "rules": {
            "reached_within": REACHED,
            "approach_directions": DIRECTION_COUNT,
            "approach_angle": APPROACH_ANGLE,
            "characteristic_length": CHARACTERISTIC_LENGTH,
            "tip_zone": TIP_ZONE,
            "meeting_zone": MEETING_ZONE,
            "arm_distance": ARM_DISTANCE,
        },
        "versions": {
            "surgsim": package_version(),
            "python": platform.python_version(),
            **{name: version(name) for name in ("numpy", "scipy", "mujoco", "matplotlib")},
        },
        "seed": seed,
        "inputs": dict(inputs),
    }


def _arm_summary(arm: ArmReach, outer: np.ndarray) -> dict[str, Any]:
    counts = {reason: int((arm.reason[outer] == index).sum()) for index, reason in enumerate(REASONS)}
    return {
        "arm": arm.name,
        "reasons": counts,
        **{one.field: _extremes(getattr(arm, one.field)[outer]) for one in QUANTITIES if one.field != "position_error"},
    }


def _targets(
    sites: Sites, left: ArmReach, right: ArmReach, both: BothArms, targets: Sequence[InnerTarget]
) -> list[dict[str, Any]]:
    rows = np.flatnonzero(sites.inner)
    return [
        {
            "name": target.name,
            "point": list(target.point),
            "left": REASONS[left.reason[row]],
            "right": REASONS[right.reason[row]],
            "both": bool(both.reachable[row]),
        }
        for row, target in zip(rows, targets, strict=True)
    ]


def _extremes(values: FloatArray) -> dict[str, float | None]:
    """Least, median and greatest of the finite values; None where there are none."""
    return {name: None if math.isnan(value) else value for name, value in spread(values)._asdict().items()}


def _share(flags: np.ndarray) -> float | None:
    return float(flags.mean()) if flags.size else None
