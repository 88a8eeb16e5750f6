"""Kinds of points by the arms that reach them, with their colours in every picture, table and scene of a report."""

from typing import NamedTuple

import numpy as np

from msdm_core.mesh import IntArray
from surgsim_apps.arms.results import ArmsEvaluation
from surgsim_apps.reports.surface_drawing import INK


class ReachKind(NamedTuple):
    """Name and colour of a kind of points."""

    name: str
    colour: str


# Distinct for all kinds of colour blindness: Okabe & Ito's colours.
REACH_KINDS = (
    ReachKind("both at once", "#009e73"),
    ReachKind("left arm only", "#0072b2"),
    ReachKind("right arm only", "#e69f00"),
    ReachKind("each, but not both at once", "#cc79a7"),
    ReachKind("neither", "#bdbdbd"),
)
# Of a port, and of its arm.
PORT_COLOURS = {"left": REACH_KINDS[1].colour, "right": REACH_KINDS[2].colour, "endoscope": INK}


def reach_kinds(evaluation: ArmsEvaluation) -> IntArray:
    """Index into REACH_KINDS of each point, (n_point,)."""
    left, right = evaluation.left.reachable, evaluation.right.reachable
    return np.select([evaluation.both, left & right, left, right], [0, 3, 1, 2], 4).astype(np.int32)
