"""Agents for SurgSim/Slide-v0: what they remember of a slide, scripted ways over the face, and a scripted map.

Lengths are in tip radii, places from the chart's lower corner.
"""

import math
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from surgsim_env.palpation import MAP_SIDE, LesionEstimate, LesionEstimator, TouchMap
from surgsim_env.tasks import SlideTask

FloatArray = NDArray[np.float64]

# Set point of the scripts' force over the soft limit, and distance between the rows of a sweep [tip radii].
PRESS, ROW_SPACING = 0.5, 1.8
# A place of the way counts as reached this near [tip radii]; after so many control steps without progress it is left out.
REACHED, PATIENCE = 0.5, 10
# Speed at which the tip slows down before a place: the distance left is covered in this time [control steps].
SLOWING = 4.0
# Least depth of a reading [tip radii], and least force over the soft limit.
DEPTH_LEAST, FORCE_LEAST = 0.15, 0.1
# Lesions of the prior: mean radius [tip radii]. The chosen families hide lesions of 1.2 to 1.6.
LESION_RADIUS = 1.4
# Control steps between two maps.
MAP_STEPS = 10


class SlideMemory:
    """Readings of a slide on the sites of a map.

    Fields:
        map: of the sites
        place: of the tip now [tip radii]                                                                   (2,)
        height, thickness: of the known surface at each site [tip radii]; None without                      (n_site,)
        sums: of the readings at each site: number, log stiffness, normal force, depth, centre of pressure
            along both axes, spread of the pressure, shear along both axes                                   (9, n_site)
    """

    def __init__(self, slices: dict[str, slice], observation: NDArray[np.floating]) -> None:
        """Begin an episode with its first observation."""
        self._slices = slices
        cell, share = (self._read(observation, name) for name in ("map_cell", "chart_share"))
        face = self._read(observation, "face_map") > 0.5 if "face_map" in slices else np.ones(MAP_SIDE**2, dtype=bool)
        self.map = TouchMap(share * cell * (MAP_SIDE - 1), float(cell[0]), face)
        self.height, self.thickness = (
            self._read(observation, name) if name in slices else None for name in ("height_map", "thickness_map")
        )
        self.sums = np.zeros((9, MAP_SIDE * MAP_SIDE))
        self.steps = 0
        self.add(observation)

    def _read(self, observation: NDArray[np.floating], name: str) -> FloatArray:
        return np.asarray(observation[self._slices[name]], dtype=np.float64)

    def add(self, observation: NDArray[np.floating]) -> None:
        """Add the reading of a control step."""
        self.steps += 1
        on_chart = self._read(observation, "place")
        self.place = 0.5 * (on_chart + 1.0) * self.map.extent
        site = int(self.map.nearest(on_chart))
        force, normal = (self._read(observation, name) for name in ("contact_force", "surface_normal"))
        depth, push = float(self._read(observation, "tip_depth")[0]), float(force @ normal)
        if site < 0 or depth < DEPTH_LEAST or push < FORCE_LEAST:
            return
        features = np.zeros(9)
        # Hertz (1881): the force on a half space grows with depth^1.5.
        features[:4] = 1.0, math.log(push) - 1.5 * math.log(depth), push, depth
        if "taxels" in self._slices:
            features[4:7] = pressure_moments(self._read(observation, "taxels"))
        features[7:] = force[:2]
        self.sums[:, site] += features

    @property
    def visited(self) -> NDArray[np.intp]:
        """Sites with a reading."""
        return np.flatnonzero(self.sums[0])

    @property
    def means(self) -> FloatArray:
        """Mean readings of the visited sites, without their number, (8, n_visited)."""
        sums = self.sums[:, self.visited]
        return sums[1:] / sums[0]


def pressure_moments(taxels: FloatArray) -> FloatArray:
    """Centre along both axes and mean square distance from it of the pressure on 4 x 4 taxels, in taxels, (3,)."""
    push = np.maximum(taxels.reshape(-1, 3)[:, 2], 0.0)
    side = math.isqrt(len(push))
    rows, columns = np.divmod(np.arange(len(push)), side)
    places = np.stack([columns, rows]) - 0.5 * (side - 1)
    total = max(float(push.sum()), 1e-6)
    centre = places @ push / total
    return np.append(centre, float((np.square(places - centre[:, None]).sum(axis=0) * push).sum()) / total)


# ---- ways over the face ----------------------------------------------------------------------------------------------


def sweep(touch_map: TouchMap, spacing: float, *, flip: bool = False, down: bool = False) -> FloatArray:
    """Boustrophedon: ends of rows `spacing` tip radii apart over the pressable sites, (n, 2).

    `flip` begins each row at its other end, `down` with the last row.
    """
    face = touch_map.pressable.reshape(MAP_SIDE, MAP_SIDE)
    columns, rows = touch_map.axes
    used = np.flatnonzero(face.any(axis=1))
    low, high = rows[used[0]], rows[used[-1]]
    count = max(1, math.ceil((high - low) / spacing))
    ways = []
    for number, middle in enumerate(low + (np.arange(count) + 0.5) * (high - low) / count):
        row = used[np.argmin(np.abs(rows[used] - middle))]
        ends = columns[np.flatnonzero(face[row])[[0, -1]]]
        ways += [(end, middle) for end in (ends if (number % 2 == 0) != flip else ends[::-1])]
    return np.array(ways[::-1] if down else ways)


def spiral(touch_map: TouchMap, spacing: float) -> FloatArray:
    """Spiral inward along the face, rings `spacing` tip radii apart, (n, 2)."""
    sites = touch_map.sites[touch_map.pressable]
    middle = sites.mean(axis=0)
    away = sites - middle
    angle = np.arctan2(away[:, 1], away[:, 0])
    sectors = np.linspace(-math.pi, math.pi, 17)[:-1]
    reach = [np.linalg.norm(away[np.abs((angle - at + math.pi) % (2 * math.pi) - math.pi) < 0.4], axis=1) for at in sectors]
    border = np.array([lengths.max(initial=0.0) for lengths in reach])
    turns = max(1, math.ceil(border.min() / spacing))
    share = 1.0 - (np.arange(16 * turns) + 8.0) / (16 * turns + 8.0)
    directions = np.stack([np.cos(sectors), np.sin(sectors)], axis=1)
    return middle + np.tile(border[:, None] * directions, (turns, 1)) * share[:, None]


class Way:
    """Places to slide through, one after the other."""

    def __init__(self, places: FloatArray) -> None:
        self._left: Iterator[FloatArray] = iter(places)
        self.goal: FloatArray | None = next(self._left, None)
        self._nearest, self._waited = math.inf, 0

    def velocity(self, place: FloatArray) -> FloatArray:
        """Action toward the next place (2,); 0 after the last."""
        while self.goal is not None:
            way = self.goal - place
            length = float(np.linalg.norm(way))
            closer = length < self._nearest - 0.05
            self._nearest, self._waited = min(length, self._nearest), 0 if closer else self._waited + 1
            if length > REACHED and self._waited < PATIENCE:
                return way / max(length, 0.2 * SLOWING)
            self.goal = next(self._left, None)
            self._nearest, self._waited = math.inf, 0
        return np.zeros(2)
