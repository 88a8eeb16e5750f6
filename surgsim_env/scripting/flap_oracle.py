"""The script that lifts the edge of an organ of any shape, as its scene's flap says which."""

import math

import numpy as np

from msdm_core.mesh import FloatArray, IntArray
from surgsim_env.scripting.jaw_steps import CloseJaw
from surgsim_env.scripting.steps import MoveTo, Predicate, Step
from surgsim_env.scripting.view import View
from surgsim_env.scripting.wrapped_steps import MayEnd, Until
from surgsim_env.simulation import Simulation
from surgsim_env.tasks.retraction_draw import lifted_box

# Lines are tried so far apart along y, and what is thinner than this at the edge is passed over [m].
STEP, THIN = 0.0005, 0.001

# How deep the middle of the pads goes in over the edge, and how far before it the jaw waits [m].
GRASP_DEPTH, WAITING_GAP = 0.0065, 0.016
# Nothing of the jaw goes nearer to the bed's end than this [m], and its pads reach so far beyond the tip.
BED_GAP, PAD_REACH = 0.001, 0.008
# So much of the open jaw is left free at its narrowest [m].
JAW_PLAY = 0.002
# The jaw is closed when it grips with this [N].
GRIP_FORCE = 0.25
# The edge is lifted so far [m], at this speed [m/s]. A wedge of tissue that is pulled straight up gives way by so much
# outward, and turns by so much, for each metre up [rad/m]: on that way the jaw need not pull it along.
LIFT, LIFTING_SPEED, APPROACH_SPEED = 0.025, 0.006, 0.015
OUTWARD_SHARE, TURN_RATE = 0.25, 30.0
# Where friction has less than this left, the jaw goes no farther [N].
FRICTION_KEPT = 0.06


def flap_steps(
    simulation: Simulation,
    target: FloatArray,
    turning_size: int,
    enough: Predicate,
    *,
    aside: float = 0.0,
    share: float = 1.0,
) -> list[Step]:
    """Grasp the edge of a flap before a target [m] (3,) along the jaw and lift it; the organ as it rests now.

    Args:
        simulation: at rest, the jaw open before the edge.
        target: what shall be seen.
        turning_size: entries of the wrist's turning: none, one hinge about x, or a rotation vector.
        enough: whether the target is seen well enough to lift the edge no farther.
        aside: how far beside the target the edge is grasped, along x [m].
        share: of LIFT, at most.
    """
    scene, rest = simulation.anatomy.scene, simulation.organ_model.node_rest_position
    assert scene.retract is not None and scene.retract.flap is not None
    along = float(target[0]) + aside
    box, surface = lifted_box(scene.retract, rest), simulation.anatomy.mesh.boundary_triangles
    free = surface[~np.isin(surface, simulation.anatomy.anchors).all(axis=1)]
    place, sides = edge_section(simulation.organ_state.node_position, free, along, float(box[0][1]))
    bed = max((float(one.reach(np.array([0.0, 1.0, 0.0]))) for one in scene.supports), default=-math.inf)
    jaw = np.asarray(scene.instrument.tip_direction or (0.0, -1.0, 0.0))
    jaw = jaw / np.linalg.norm(jaw)
    # Across the jaw, which points along the middle of the edge.
    thick = np.ptp(sides, axis=1) * abs(jaw[1])
    grasped = simulation.grasp
    assert grasped is not None
    fits = float(place[thick <= grasped.opening - JAW_PLAY].min(initial=place[0])) + PAD_REACH
    y = max(float(place[0]) - GRASP_DEPTH, bed + BED_GAP + PAD_REACH, fits)
    grasp = np.array([along, y, float(np.interp(y, place[::-1], sides.mean(axis=1)[::-1]))])
    waiting = grasp - jaw * (WAITING_GAP + float(place[0]) - y)
    lift = share * LIFT
    risen = grasp + np.array([0.0, OUTWARD_SHARE * lift, lift])
    return [
        MoveTo(_point(waiting), tolerance=0.001, name="wait before it"),
        MoveTo(_point(grasp), APPROACH_SPEED, 0.001, name="go around the edge"),
        CloseJaw(GRIP_FORCE, name="grasp"),
        MayEnd(
            Until(
                MoveTo(_point(risen), LIFTING_SPEED, 0.001, _turn(TURN_RATE * lift, turning_size), name="lift"),
                lambda view: enough(view) or _about_to_slip(view),
            )
        ),
    ]


def _about_to_slip(view: View) -> bool:
    return view.grasp is not None and view.grasp.friction_left < FRICTION_KEPT


def _turn(angle: float, size: int) -> float | tuple[float, ...]:
    """A turn about x in the instrument's own terms; a hinge lifts the jaw's tip above 0, and here it goes down."""
    return (angle, 0.0, 0.0) if size == 3 else -angle * float(size == 1)


def _point(place: FloatArray) -> tuple[float, float, float]:
    x, y, z = place.tolist()
    return x, y, z


def edge_section(nodes: FloatArray, triangles: IntArray, x: float, inner: float) -> tuple[FloatArray, FloatArray]:
    """Section of an organ across its free edge at a place along it.

    Args:
        nodes: [m], (n_node, 3).
        triangles: of the surface of what is lifted (n, 3).
        x: place along the edge [m].
        inner: how far inward it is wanted, a place along y [m].

    Returns:
        Places along y where there is tissue, the edge first [m] (n,); its lowest and highest point there [m] (n, 2).

    Raises:
        ValueError: nothing is there.
    """
    corners = nodes[triangles]
    corners = corners[(corners[:, :, 0].min(axis=1) <= x) & (corners[:, :, 0].max(axis=1) >= x)]
    ys, sides = [], []
    for y in np.arange(corners[:, :, 1].max(initial=inner), inner, -STEP):
        heights = _heights(corners, x, float(y))
        if len(heights) >= 2 and np.ptp(heights) >= THIN:
            ys.append(float(y))
            sides.append((heights.min(), heights.max()))
    if not ys:
        raise ValueError(f"there is no tissue at x = {x:g} m in retract.flap: set its corners around the edge")
    return np.array(ys), np.array(sides)


def _heights(corners: FloatArray, x: float, y: float) -> FloatArray:
    """Where a vertical line meets triangles [m] (n, 3, 3), heights (m,)."""
    a, b, c = (corners[:, corner] for corner in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    level = np.abs(area) > 1e-15
    a, b, c, area = a[level], b[level], c[level], area[level]
    beta = ((x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (y - a[:, 1])) / area
    gamma = ((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (x - a[:, 0]) * (b[:, 1] - a[:, 1])) / area
    met = (beta >= 0.0) & (gamma >= 0.0) & (beta + gamma <= 1.0)
    height = a[:, 2] + beta * (b[:, 2] - a[:, 2]) + gamma * (c[:, 2] - a[:, 2])
    return height[met]
