"""Moves of one port along the body wall, and how much they add to the points that both arms reach."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from surgsim_apps.arms.ports import Ports
from surgsim_apps.arms.quick_reach import QuickReach
from surgsim_apps.arms.results import PortMove
from surgsim_apps.reports.surface_drawing import OrthographicView
from surgsim_env.instruments import SIDES

# Length of the moves [m], and least gain that is worth a new port, as a share of the points: chosen.
STEP, GAIN_LEAST = 0.02, 0.01


def best_move(quick: QuickReach, ports: Ports, both: NDArray[np.bool_], view: OrthographicView) -> PortMove | None:
    """The move of one port that adds most to the points that both arms reach at once.

    Args:
        quick: reach of both arms.
        ports: before the move.
        both: mask of the surface's points in reach of both there, by the evaluation.
        view: along the endoscope.

    Returns:
        The move; None if none adds GAIN_LEAST.
    """
    shifts = list(port_shifts(ports, view))
    shares = quick.evaluate([ports, *(moved_port(ports, side, shift) for side, _, shift in shifts)]).share
    gains = shares[1:] - shares[0]
    if gains.max() < GAIN_LEAST:
        return None
    side, words, shift = shifts[gains.argmax()]
    before = float(both.mean())
    return PortMove(side, words, shift, before, min(before + float(gains.max()), 1.0))


def moved_port(ports: Ports, side: str, shift: FloatArray) -> Ports:
    """Ports with that of one side moved [m]; it keeps its target, or its direction."""
    place = getattr(ports, side)
    x, y, z = (np.array(place.point) + shift).tolist()
    return replace(ports, **{side: replace(place, point=(x, y, z))})


def port_shifts(ports: Ports, view: OrthographicView) -> Iterator[tuple[str, str, FloatArray]]:
    """Moves to try: side, words and vector [m] along the body wall, named as the endoscope's picture shows them."""
    normal = ports.wall_normal
    axes = [
        (view.right, "to the right", "to the left"),
        (view.up, "up", "down"),
        (view.towards, "towards the camera", "away from the camera"),
    ]
    # The axis nearest to the wall's normal leads away from the wall.
    axes.sort(key=lambda axis: abs(float(axis[0] @ normal)))
    for axis, ahead, back in axes[:2]:
        along = axis - (axis @ normal) * normal
        along /= np.linalg.norm(along)
        for side in SIDES:
            for sign, words in ((1.0, ahead), (-1.0, back)):
                yield side, f"{STEP * 100:g} cm {words}", sign * STEP * along
