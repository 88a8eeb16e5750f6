"""Oracles: scripts with knowledge of the truth, an upper bound for each task."""

import math
from collections.abc import Callable

import gymnasium as gym
import numpy as np

from msdm_core.arithmetic import matmul, norm
from msdm_core.mesh.tet_mesh import FloatArray, IntArray
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.coupling.tracking import SurfaceTracker
from surgsim_env.envs.surgical_env import SurgicalEnv
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.scripting.steps import (
    AwaitEnd,
    CloseJaw,
    Declare,
    Hold,
    MayEnd,
    MoveTo,
    OfArm,
    Predicate,
    PressSupport,
    PressUntil,
    Step,
    Tracked,
    Until,
)
from surgsim_env.tasks.bimanual_retract import BimanualRetractTask
from surgsim_env.tasks.palpate import PalpateTask
from surgsim_env.tasks.retract import RetractTask, lifted_box

# Force of the oracle's press over the soft force limit.
GENTLE_SHARE = 0.4
# Gap between the tip ball and the tissue in sideways motion, and before a press [m].
TRAVEL_GAP = 0.004
# Control steps with enough of the target visible before the fold stops.
SEEN_STEPS = 5
# Width beside the ball's path that counts as under it [m].
CORRIDOR = 0.004

# Grasp of an edge. Depth of the middle of the pads over the edge, and distance of the waiting jaw before the edge
# [m]; smallest gap of the jaw to a support, and reach of its pads beyond the tip [m]; grip force of a closed jaw [N];
# speed of the approach [m/s].
GRASP_DEPTH, WAITING_GAP = 0.0065, 0.016
SUPPORT_GAP, PAD_REACH = 0.001, 0.008
GRIP_FORCE, APPROACH_SPEED = 0.25, 0.015
# Direction from the held to the free edge.
OUTWARD = np.array([0.0, 1.0, 0.0])

# Fold of a lobe. Waypoints of the tip in y and z as shares of the lobe's depth, first up, then over; rotation of the
# edge on each of the two motions [rad]; speed [m/s].
RISEN, FOLDED = (0.88, 0.50), (0.46, 0.84)
TURNS = (math.radians(35.0), math.radians(40.0))
CARRYING_SPEED = 0.015

# Lift of a flap. Height [m] and speed [m/s] of the lift. A wedge of tissue pulled straight up moves outward by
# OUTWARD_SHARE and turns by TURN_RATE [rad/m] for each metre up; the jaw follows, without a pull.
FLAP_LIFT, FLAP_SPEED = 0.025, 0.006
OUTWARD_SHARE, TURN_RATE = 0.25, 30.0
# Clearance in the open jaw at its narrowest [m]; spacing of the section's lines along y, and the thickness below which
# the edge is skipped [m]; smallest friction reserve of the jaw [N].
JAW_PLAY, SECTION_STEP, THIN, FRICTION_KEPT = 0.002, 0.0005, 0.001, 0.06

# Two arms. Offset of the left jaw from the target along x, away from the right arm [m]; shares of the fold and of the
# flap's lift: the right arm needs room, not the endoscope.
BESIDE, FOLD_SHARE, LIFT_SHARE = -0.008, 0.66, 0.7
# Waypoints of the right tip [m]: before the lobe (from the target in x, from the free edge in y, height), at its mouth
# (from the target in x and y, height), over the target (free height).
BEFORE, MOUTH, OVER = (0.010, 0.018, 0.022), (0.002, 0.012, 0.010), 0.0005
# Offset of the touch from the target's middle towards the free edge, under the higher part of the lobe, in radii.
OUTER_SHARE = 0.85
# Force on the target [N], the middle of the range of a touch, and speed [m/s].
PRESSING_FORCE, REACHING_SPEED = 0.6, 0.015


def oracle_script(env: gym.Env, *, tracks: bool = False) -> list[Step]:
    """Script that solves the current episode from the environment's present state; reset the environment first.

    A task of a user's own has an oracle as a method `oracle(simulation)` that returns the steps.

    Args:
        env: for the script.
        tracks: each step follows the moving surface by its markers (`Tracked`); else it goes to its points at rest.

    Raises:
        ValueError: the environment was not reset, or has no known oracle.
    """
    steps = _oracle_steps(env)
    if not tracks:
        return steps
    simulation = env.unwrapped.simulation  # type: ignore[attr-defined]
    tracker = SurfaceTracker(simulation, markers(simulation.anatomy))
    return [
        MayEnd(Tracked(step.step, tracker)) if isinstance(step, MayEnd) else Tracked(step, tracker) for step in steps
    ]


def markers(anatomy: Anatomy) -> IntArray:
    """Nodes for tracking of the surface: of the palpable face, or the held nodes of a lifted lobe."""
    if anatomy.scene.retract is None:
        return np.unique(anatomy.face.triangles)
    return anatomy.anchors if len(anatomy.anchors) else anatomy.foundation_nodes


def _oracle_steps(env: gym.Env) -> list[Step]:
    inner = env.unwrapped
    if isinstance(inner, SurgicalEnv):
        if hasattr(inner.task, "oracle"):
            return list(inner.task.oracle(inner.simulation))
        for kind in type(inner.task).__mro__:
            if kind in ORACLES:
                if inner.task.drawn is None:
                    raise ValueError("an oracle solves an episode, and none has begun: call env.reset(seed=...)")
                return ORACLES[kind](inner.task, inner.simulation)
    known = ", ".join(kind.__name__ for kind in ORACLES)
    raise ValueError(
        f"no oracle is known for {type(inner).__name__}; there is one for {known}: give the task a method "
        "oracle(simulation) that returns the steps"
    )


def palpate_oracle(task: PalpateTask, simulation: Simulation) -> list[Step]:
    """Rise, move over the lesion, press gently along the surface's normal, hold and declare."""
    lesion, anatomy = task.lesion, simulation.anatomy
    assert lesion is not None and lesion.centre is not None
    scene, approach = anatomy.scene, anatomy.face.approach
    site, normal = anatomy.face.project(lesion.centre)
    start = simulation.instrument.tip_position
    above = site + normal * (scene.instrument.tip_radius + TRAVEL_GAP)
    height = _travel_height(anatomy, start, above)
    force = GENTLE_SHARE * scene.limits.soft_force
    return [
        MoveTo(_at_height(start, approach, height), timeout=10.0, name="rise"),
        MoveTo(_at_height(above, approach, height), timeout=20.0, name="go over"),
        MoveTo(_point(above), timeout=10.0, name="come down"),
        PressUntil(force, 2.0 * scene.palpation.press_depth, direction=_point(-normal), name="press"),
        Hold(0.1, name="hold"),
        Declare(name="declare"),
    ]


def retract_oracle(task: RetractTask, simulation: Simulation) -> list[Step]:
    """Grasp the free edge beside the target, fold the lobe back and wait for success."""
    assert task.target is not None
    return [
        *retraction_steps(simulation, task.target.centre, task.turning_size, lambda _: task.goal_count >= SEEN_STEPS),
        AwaitEnd(10.0, name="keep it open"),
    ]


def bimanual_oracle(task: BimanualRetractTask, simulation: Simulation) -> list[Step]:
    """Fold the lobe back with the left arm, regardless of visibility; reach under it with the right arm and press."""
    assert task.target is not None
    target, radius = task.target.centre, simulation.anatomy.scene.instrument.tip_radius
    edge = float(simulation.organ_model.node_rest_position[:, 1].max())
    x, y, z = target.tolist()
    over = (x, y + OUTER_SHARE * task.table.target_radius, z + radius + OVER)
    right = [
        MoveTo((x + BEFORE[0], edge + BEFORE[1], BEFORE[2]), tolerance=0.001, name="come to its mouth"),
        MoveTo((x + MOUTH[0], y + MOUTH[1], MOUTH[2]), REACHING_SPEED, 0.001, name="reach under"),
        MoveTo(over, REACHING_SPEED, name="stand over the target"),
        PressSupport(PRESSING_FORCE, over, name="touch it"),
    ]
    left = retraction_steps(
        simulation, target, task.turning_size, lambda _: False, aside=BESIDE, fold=FOLD_SHARE, lift=LIFT_SHARE
    )
    return [*(MayEnd(OfArm(step, "left")) for step in left), *(MayEnd(OfArm(step, "right")) for step in right)]


# Oracles of the shipped tasks.
ORACLES: dict[type, Callable[..., list[Step]]] = {
    PalpateTask: palpate_oracle,
    RetractTask: retract_oracle,
    BimanualRetractTask: bimanual_oracle,
}


def _travel_height(anatomy: Anatomy, start: FloatArray, end: FloatArray) -> float:
    """Height against the approach [m] for the tip ball to pass over all tissue between two places."""
    upward, radius = -anatomy.face.approach, anatomy.scene.instrument.tip_radius
    points = anatomy.mesh.points[anatomy.mesh.boundary_nodes]
    span = _level(end - start, upward)
    level = _level(points - start, upward)
    share = np.clip(matmul(level, span) / max(float(matmul(span, span)), 1e-12), 0.0, 1.0)
    near = norm(level - share[:, None] * span, axis=1) <= radius + CORRIDOR
    tissue = float(matmul(points[near], upward).max(initial=-np.inf)) + radius + TRAVEL_GAP
    return max(tissue, float(matmul(start, upward)), float(matmul(end, upward)))


def _level(vectors: FloatArray, upward: FloatArray) -> FloatArray:
    """Vectors without their share along a unit direction."""
    return vectors - matmul(vectors, upward)[..., None] * upward


def _at_height(place: FloatArray, approach: FloatArray, height: float) -> tuple[float, float, float]:
    return _point(place - approach * (height + float(matmul(place, approach))))


def flap_steps(
    simulation: Simulation,
    target: FloatArray,
    turning_size: int,
    enough: Predicate,
    *,
    aside: float = 0.0,
    share: float = 1.0,
) -> list[Step]:
    """Grasp the edge of a flap before a target along the jaw and lift it.

    Args:
        simulation: at rest, the jaw open before the edge.
        target: centre of the disc to expose [m], shape (3,).
        turning_size: entries of the wrist's turning: none, one hinge about x, or a rotation vector.
        enough: predicate of sufficient visibility, the end of the lift.
        aside: offset of the grasp from the target along x [m].
        share: largest lift over FLAP_LIFT.
    """
    scene, rest = simulation.anatomy.scene, simulation.organ_model.node_rest_position
    assert scene.retract is not None and scene.retract.flap is not None
    along = float(target[0]) + aside
    box, surface = lifted_box(scene.retract, rest), simulation.anatomy.mesh.boundary_triangles
    free = surface[~np.isin(surface, simulation.anatomy.anchors).all(axis=1)]
    place, sides = edge_section(simulation.organ_state.node_position, free, along, float(box[0][1]))
    bed = max((float(support.reach(OUTWARD)) for support in scene.supports), default=-math.inf)
    jaw = np.asarray(scene.instrument.tip_direction or (0.0, -1.0, 0.0))
    jaw = jaw / norm(jaw)
    # Thickness across the jaw, which points along the middle of the edge.
    thick = np.ptp(sides, axis=1) * abs(jaw[1])
    jaw_state = simulation.grasp
    assert jaw_state is not None
    fits = float(place[thick <= jaw_state.opening - JAW_PLAY].min(initial=place[0])) + PAD_REACH
    y = max(float(place[0]) - GRASP_DEPTH, bed + SUPPORT_GAP + PAD_REACH, fits)
    grasp = np.array([along, y, float(np.interp(y, place[::-1], sides.mean(axis=1)[::-1]))])
    waiting = grasp - jaw * (WAITING_GAP + float(place[0]) - y)
    lift = share * FLAP_LIFT
    risen = grasp + np.array([0.0, OUTWARD_SHARE * lift, lift])
    return [
        MoveTo(_point(waiting), tolerance=0.001, name="wait before it"),
        MoveTo(_point(grasp), APPROACH_SPEED, 0.001, name="go around the edge"),
        CloseJaw(GRIP_FORCE, name="grasp"),
        MayEnd(
            Until(
                MoveTo(_point(risen), FLAP_SPEED, 0.001, _turn(TURN_RATE * lift, turning_size), name="lift"),
                lambda view: enough(view) or (view.grasp is not None and view.grasp.friction_left < FRICTION_KEPT),
            )
        ),
    ]


def _turn(angle: float, size: int) -> float | tuple[float, ...]:
    """Turn about x in the instrument's own terms, with the opposite sign of a hinge's angle."""
    return (angle, 0.0, 0.0) if size == 3 else -angle * float(size == 1)


def _point(place: FloatArray) -> tuple[float, float, float]:
    x, y, z = place.tolist()
    return x, y, z


def edge_section(nodes: FloatArray, triangles: IntArray, x: float, inner: float) -> tuple[FloatArray, FloatArray]:
    """Section of an organ across its free edge.

    Args:
        nodes: [m], (n_node, 3).
        triangles: of the surface of the lifted part (n, 3).
        x: place along the edge [m].
        inner: innermost place of the section along y [m].

    Returns:
        Places along y with tissue, the edge first [m] (n,); its lowest and highest point there [m] (n, 2).

    Raises:
        ValueError: no tissue there.
    """
    corners = nodes[triangles]
    corners = corners[(corners[:, :, 0].min(axis=1) <= x) & (corners[:, :, 0].max(axis=1) >= x)]
    ys, sides = [], []
    for y in np.arange(corners[:, :, 1].max(initial=inner), inner, -SECTION_STEP):
        heights = _heights(corners, x, float(y))
        if len(heights) >= 2 and np.ptp(heights) >= THIN:
            ys.append(float(y))
            sides.append((heights.min(), heights.max()))
    if not ys:
        raise ValueError(f"there is no tissue at x = {x:g} m in retract.flap: set its corners around the edge")
    return np.array(ys), np.array(sides)


def _heights(corners: FloatArray, x: float, y: float) -> FloatArray:
    """Heights of a vertical line's intersections with triangles [m] (n, 3, 3), shape (m,)."""
    a, b, c = (corners[:, corner] for corner in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    level = np.abs(area) > 1e-15
    a, b, c, area = a[level], b[level], c[level], area[level]
    beta = ((x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (y - a[:, 1])) / area
    gamma = ((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (x - a[:, 0]) * (b[:, 1] - a[:, 1])) / area
    inside = (beta >= 0.0) & (gamma >= 0.0) & (beta + gamma <= 1.0)
    height = a[:, 2] + beta * (b[:, 2] - a[:, 2]) + gamma * (c[:, 2] - a[:, 2])
    return height[inside]


def retraction_steps(
    simulation: Simulation,
    target: FloatArray,
    turning_size: int,
    enough: Predicate,
    *,
    aside: float = 0.0,
    fold: float = 1.0,
    lift: float = 1.0,
) -> list[Step]:
    """Grasp the free edge of a lobe beside a target and fold it back, or lift a flap.

    Args:
        simulation: at rest, the jaw open on the free side.
        target: centre of the disc to expose [m], shape (3,).
        enough: predicate of sufficient visibility, the end of the fold.
        turning_size: entries of the wrist's turning: none, one hinge about x, or a rotation vector.
        aside: offset of the grasp from the target along x [m].
        fold: share of the second motion, the fold of the lifted edge.
        lift: share of a flap's lift, in place of the fold.
    """
    table = simulation.anatomy.scene.retract
    if table is not None and table.flap is not None:
        return flap_steps(simulation, target, turning_size, enough, aside=aside, share=lift)
    rest, nodes = simulation.organ_model.node_rest_position, simulation.organ_state.node_position
    depth = float(rest[:, 1].max())
    along = float(target[0]) + aside
    near = np.abs(rest[:, 0] - along) <= GRASP_DEPTH
    border = float(nodes[near & (rest[:, 1] > depth - 1e-6), 1].mean())
    # The edge hangs lower than the tissue between the pads.
    height = float(nodes[near & (rest[:, 1] >= depth - 2.0 * GRASP_DEPTH), 2].mean())
    # Largest reach along y of the supports that end before the edge [m].
    supports = simulation.anatomy.scene.supports
    reaches = (support.reach(OUTWARD) for support in supports if support.kind != "plane")
    bed = max((reach for reach in reaches if reach < border), default=-math.inf)
    grasp = (along, max(border - GRASP_DEPTH, bed + SUPPORT_GAP + PAD_REACH), height)
    waiting = (along, border + WAITING_GAP, height)
    turns = [_turn(angle, turning_size) for angle in (TURNS[0], fold * TURNS[1])]
    shares = np.array([RISEN, np.array(RISEN) + fold * np.subtract(FOLDED, RISEN)])
    risen, folded = ((along, y * depth, height + z * depth) for y, z in shares.tolist())
    return [
        MoveTo(waiting, tolerance=0.001, name="wait before it"),
        MoveTo(grasp, APPROACH_SPEED, name="go around the edge"),
        CloseJaw(GRIP_FORCE, name="grasp"),
        MayEnd(Until(MoveTo(risen, CARRYING_SPEED, 0.002, turns[0], name="lift"), enough)),
        MayEnd(Until(MoveTo(folded, CARRYING_SPEED, 0.001, turns[1], name="fold"), enough)),
    ]
