"""Two arms on a patient's anatomy: what they reach, how well, and what they run into."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from surgsim_env.anatomy import Anatomy, load_anatomy
from surgsim_env.arms.arm import load_arm
from surgsim_env.arms.description import ArmDescription
from surgsim_env.evaluation.arm_results import ArmReach, ArmsEvaluation
from surgsim_env.evaluation.arm_summary import plain_ports, summarise
from surgsim_env.evaluation.both_arms import evaluate_both
from surgsim_env.evaluation.clearance import SurfaceDistance
from surgsim_env.evaluation.collisions import Surroundings
from surgsim_env.evaluation.kinematics import BatchKinematics
from surgsim_env.evaluation.ports import InnerTarget, PortPlace, Ports, default_ports, read_ports
from surgsim_env.evaluation.reach import Reach, Sites, evaluate_reach, tip_ball
from surgsim_env.evaluation.surface_points import facing_points
from surgsim_env.scenes import Scene, make_scene

# Called with what is being done and the share of the whole that is done.
Progress = Callable[[str, float], None]


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
        scene: a scene's name, its TOML file, or what these give.
        left: a shipped arm's name or the TOML file of one's own.
        right: likewise.
        ports: a ports file, or what `read_ports` gave; `default_ports` where none is given.
        targets: inner targets; those of the ports file where none are given.
        seed: draws where the points of the surface begin.
        count: how many points of the surface.
        progress: told what is being done and the share of it that is done.
        pictures: whether to draw the arms in the patient; without OpenGL there are none, and `progress` is told why.

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
    drawn = _pictures(anatomy, where, reaches, sites, tell) if pictures else {}
    tell("done", 1.0)
    return ArmsEvaluation(
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
        pictures=drawn,
    )


def _reaches(
    anatomy: Anatomy, arms: list[BatchKinematics], sites: Sites, ports: Ports, tell: Progress
) -> tuple[Reach, Reach]:
    """What the left and the right arm reach."""
    organ = SurfaceDistance(anatomy.mesh.points, anatomy.mesh.boundary_triangles)
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


def _pictures(
    anatomy: Anatomy, ports: Ports, reaches: tuple[Reach, Reach], sites: Sites, tell: Progress
) -> dict[str, NDArray[np.uint8]]:
    """Pictures by caption, none where there is no OpenGL."""
    # Drawing loads OpenGL: only where pictures are asked for.
    from surgsim_env.evaluation.arm_pictures import draw_arms
    from surgsim_env.rendering.gl import NoGLError

    tell("pictures", 0.95)
    mesh, points = anatomy.mesh, sites.points[~sites.inner]
    try:
        return draw_arms(mesh.points, mesh.boundary_triangles, ports, *reaches, points)
    except NoGLError as error:
        tell(f"no pictures: {error}", 0.95)
        return {}
