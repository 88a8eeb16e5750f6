"""The script that retracts a lobe: grasp its free edge over the target, fold it back, keep it there."""

import math
from collections.abc import Sequence

import numpy as np

from msdm_core.mesh import FloatArray
from msdm_core.support import Support
from surgsim_env.scripting.flap_oracle import flap_steps
from surgsim_env.scripting.jaw_steps import CloseJaw
from surgsim_env.scripting.steps import MoveTo, Predicate, Step
from surgsim_env.scripting.wrapped_steps import MayEnd, Until
from surgsim_env.simulation import Simulation

# How deep the middle of the pads goes in over the edge [m], and where the jaw waits before it [m].
GRASP_DEPTH = 0.0065
# Nothing of the jaw goes nearer to a support than this [m], and its pads reach so far beyond the tip.
SUPPORT_GAP, PAD_REACH = 0.001, 0.008
WAITING_GAP = 0.016
# From the held edge to the free one.
OUTWARD = np.array([0.0, 1.0, 0.0])
# The jaw is closed when it grips with this [N].
GRIP_FORCE = 0.25
# Ways of the tip, as shares of the lobe's depth: up first, then over; where it goes in y and z.
RISEN = (0.88, 0.50)
FOLDED = (0.46, 0.84)
# How far the edge turns on each of the two ways [rad].
TURNS = (math.radians(35.0), math.radians(40.0))
# The tip comes near at this speed [m/s], and carries tissue at that.
APPROACH_SPEED, CARRYING_SPEED = 0.015, 0.015


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
    """Grasp the free edge beside a target [m] (3,) and fold it back; the lobe as it rests now.

    Args:
        simulation: at rest, the jaw open on the free side.
        target: what shall be seen.
        enough: whether the target is seen well enough to carry the lobe no farther.
        turning_size: entries of the wrist's turning: none, one hinge about x, or a rotation vector.
        aside: how far beside the target the edge is grasped, along x [m].
        fold: share of the second way, on which the lifted edge is folded back.
        lift: of a flap, which is not folded, the share of its one way.
    """
    table = simulation.anatomy.scene.retract
    if table is not None and table.flap is not None:
        return flap_steps(simulation, target, turning_size, enough, aside=aside, share=lift)
    rest, nodes = simulation.organ_model.node_rest_position, simulation.organ_state.node_position
    depth = float(rest[:, 1].max())
    edge = rest[:, 1] > depth - 1e-6
    along = float(target[0]) + aside
    near = edge & (np.abs(rest[:, 0] - along) <= GRASP_DEPTH)
    _, border, height = nodes[near].mean(axis=0).tolist()
    bed = _reach_of_supports(simulation.anatomy.scene.supports, border)
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


def _reach_of_supports(supports: Sequence[Support], border: float) -> float:
    """How far along y the supports reach that end before a place [m]."""
    reaches = (support.reach(OUTWARD) for support in supports if support.kind != "plane")
    return max((reach for reach in reaches if reach < border), default=-math.inf)


def _turn(angle: float, size: int) -> float | tuple[float, ...]:
    """A turn about x in the instrument's own terms; a hinge lifts the jaw's tip above 0, and here it goes down."""
    return (angle, 0.0, 0.0) if size == 3 else -angle * float(size == 1)
