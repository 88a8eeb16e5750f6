"""Moves of one port along the body wall, and how much they add to the points that both arms reach."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from surgsim_apps.arms.clearance import ClusteredSurface, Obstacles
from surgsim_apps.arms.kinematics import BatchKinematics
from surgsim_apps.arms.ports import Ports
from surgsim_apps.arms.reach import Found, Sites, evaluate_both, find_reach, tip_ball
from surgsim_apps.arms.results import PortMove
from surgsim_apps.reports.surface_drawing import OrthographicView
from surgsim_env.instruments import SIDES, load_arm
from surgsim_env.scene import Anatomy, ArmDescription

# Length of the moves [m], points of the sample that each is tried at, and of the one that confirms the best: chosen.
STEP, SAMPLE, SAMPLE_CONFIRMING = 0.02, 32, 128
# Least gain of a move that is worth a new port, as a share of the points: chosen.
GAIN_LEAST = 0.01


@dataclass(frozen=True, eq=False)
class PortSearch:
    """Two arms whose ports move, at the same points of an organ.

    Fields:
        arms: by side
        anatomy: of the organ
        organ: its surface for distances
        sites: the points
    """

    arms: Mapping[str, str | Path | ArmDescription]
    anatomy: Anatomy
    organ: ClusteredSurface
    sites: Sites

    def reach_from_port(self, side: str, ports: Ports, rows: NDArray[np.integer], *, thorough: bool = False) -> Found:
        """Joint values of one arm at its port for some of the points.

        Raises:
            ValueError: a port inside the organ.
        """
        ports.check_outside(self.anatomy)
        radius = self.anatomy.scene.instrument.tip_radius
        kinematics = BatchKinematics(load_arm(self.arms[side], getattr(ports, side).port, tip_radius=radius))
        around = Obstacles(self.organ, ports, tip_ball(kinematics))
        return find_reach(kinematics, self.sites.only(rows), around, thorough=thorough)

    def both_reach(
        self, side: str, ports: Ports, found: Mapping[str, Found], rows: NDArray[np.integer]
    ) -> NDArray[np.bool_]:
        """Mask of some of the points in reach of both at once: one arm at its port, the other as found before."""

        def together(among: NDArray[np.integer], thorough: bool) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
            arms = {name: arm.only(among) for name, arm in found.items()}
            arms[side] = self.reach_from_port(side, ports, among, thorough=thorough)
            reached = evaluate_both(arms["left"], arms["right"], self.sites.points[among]).reachable
            return reached, arms["left"].reachable & arms["right"].reachable & ~reached

        reached, close = together(rows, thorough=False)
        if close.any():
            reached[close] = together(rows[close], thorough=True)[0]
        return reached

    def best_move(
        self, ports: Ports, found: Mapping[str, Found], both: NDArray[np.bool_], view: OrthographicView
    ) -> PortMove | None:
        """The move of one port that adds most to the surface's points that both arms reach at once.

        Each move is tried at a sample, the best is confirmed at a larger one. The other arm stays as it was found.

        Args:
            ports: before the move.
            found: joint values of each arm there.
            both: mask of the points in reach of both (n_point,).
            view: along the endoscope.

        Returns:
            The move; None if none adds GAIN_LEAST.
        """
        surface = np.flatnonzero(~self.sites.inner)
        rows, weight = _sample(surface, both, SAMPLE)
        least = float(both[surface].mean()) + GAIN_LEAST
        best = None
        for side, words, shift in port_shifts(ports, view):
            try:
                moved = moved_port(ports, side, shift)
                estimate = float(weight @ self.both_reach(side, moved, found, rows))
            except ValueError:
                continue  # inside the organ, or too far from the other port
            if estimate > (best[0] if best else least):
                best = estimate, side, words, shift
        if best is None:
            return None
        _, side, words, shift = best
        rows, weight = _sample(surface, both, SAMPLE_CONFIRMING)
        after = float(weight @ self.both_reach(side, moved_port(ports, side, shift), found, rows))
        return PortMove(side, words, shift, least - GAIN_LEAST, after) if after >= least else None


def _sample(
    surface: NDArray[np.integer], both: NDArray[np.bool_], count: int
) -> tuple[NDArray[np.integer], FloatArray]:
    """Points of the surface, up to half of them not yet reached by both, and the share that each stands for."""
    missing, had = surface[~both[surface]], surface[both[surface]]
    first = missing[: max(count // 2, count - len(had))]
    rows = np.concatenate([first, had[: count - len(first)]])
    counts = np.where(both[rows], len(had) / max(len(rows) - len(first), 1), len(missing) / max(len(first), 1))
    return rows, counts / len(surface)


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
