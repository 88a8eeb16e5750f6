"""Agents for SurgSim/Slide-v0: what they remember of a slide, scripted ways over the face, and a scripted map.

Lengths are in tip radii, places from the chart's lower corner.
"""

import math
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from surgsim_env.palpation import LESIONS_MOST, MAP_SIDE, LesionEstimate, LesionEstimator, TouchMap
from surgsim_env.tasks import SlideTask

# Numbers of a declared lesion: presence, place (2), radius.
LESION_NUMBERS = 4

# Set point of the scripts' force over the soft limit, and distance between the rows of a sweep [tip radii].
PRESS, ROW_SPACING = 0.5, 1.8
# Ranges of both for random slides, and number of their random places.
PRESSES, ROW_SPACINGS, RANDOM_PLACES = (0.35, 0.7), (1.3, 2.6), 60
# A place of the way counts as reached this near [tip radii]; it is left out after so many control steps without
# progress.
REACHED, PATIENCE = 0.5, 10
# Deviation of a site's log stiffness about the fit by the surface; the gradient of the log stiffness per centre of
# pressure [1 / (tip radius taxel)], and its deviation [1 / tip radius]: chosen on the training split of `liver_family`.
READING_NOISE, GRADIENT_GAIN, GRADIENT_NOISE = 0.12, 1.0, 1.0
# Least normal force on a patch with a centre, over the soft limit.
TAXELS_LEAST = 1e-3
# Readings needed for a fit by the surface.
READINGS_LEAST = 30
# Speed at which the tip slows down before a place: the distance left is covered in this time [control steps].
SLOWING = 4.0
# Least depth of a reading [tip radii], and least force over the soft limit.
DEPTH_LEAST, FORCE_LEAST = 0.15, 0.1
# Lesions of the prior: mean radius [tip radii]. The chosen families hide lesions of 1.2 to 1.6.
LESION_RADIUS = 1.4
# Control steps between two maps.
MAP_STEPS = 10


class SlideMemory:
    """Readings of a slide on the sites of a map: a spatial memory of fixed size.

    Fields:
        map: of the sites; all on the chart are pressable where the observation has no `face_map`
        place: of the tip now [tip radii]                                                                  (2,)
        site: of the reading now; -1 for a tip that hardly touches
        reading: the last: 1, log stiffness, normal force, depth, force (3) over the soft limit and surface normal (3)
            on the face's axes, thickness, forces on the taxels likewise                                         (n,)
        sums: of the readings at each site                                                                (n, n_site)
        steps: control steps so far
    """

    def __init__(self, slices: dict[str, slice], observation: NDArray[np.floating]) -> None:
        """Begin an episode with its first observation."""
        self._slices = slices
        cell, share = (self._read(observation, name) for name in ("map_cell", "chart_share"))
        square = TouchMap(share * cell * (MAP_SIDE - 1), float(cell[0]), np.ones(MAP_SIDE * MAP_SIDE, dtype=np.bool_))
        face = (np.abs(square.places) <= 1.0).all(axis=1)
        if "face_map" in slices:
            face &= self._read(observation, "face_map") > 0.5
        self.map = TouchMap(square.extent, square.cell, face)
        self.reading = np.zeros(11 + len(self._taxels(observation)))
        self.sums = np.zeros((len(self.reading), MAP_SIDE * MAP_SIDE))
        self.steps = 0
        self.add(observation)

    def _read(self, observation: NDArray[np.floating], name: str) -> FloatArray:
        return np.asarray(observation[self._slices[name]], dtype=np.float64)

    def _taxels(self, observation: NDArray[np.floating]) -> FloatArray:
        return self._read(observation, "taxels") if "taxels" in self._slices else np.zeros(0)

    def add(self, observation: NDArray[np.floating]) -> None:
        """Add the reading of a control step."""
        self.steps += 1
        on_chart = self._read(observation, "place")
        self.place = 0.5 * (on_chart + 1.0) * self.map.extent
        force, normal = (self._read(observation, name) for name in ("contact_force", "surface_normal"))
        depth, push = float(self._read(observation, "tip_depth")[0]), float(force @ normal)
        self.site = int(self.map.nearest(on_chart)) if depth >= DEPTH_LEAST and push >= FORCE_LEAST else -1
        if self.site >= 0:
            # Hertz (1881): the force on a half space grows with depth^1.5.
            numbers = [1.0, math.log(push) - 1.5 * math.log(depth), push, depth]
            rest = (force, normal, self._read(observation, "thickness"), self._taxels(observation))
            self.reading = np.concatenate([numbers, *rest])
            self.sums[:, self.site] += self.reading

    @property
    def visited(self) -> NDArray[np.intp]:
        """Sites with a reading."""
        return np.flatnonzero(self.sums[0])

    @property
    def means(self) -> FloatArray:
        """Mean readings of the visited sites, without their number, (n - 1, n_visited)."""
        sums = self.sums[:, self.visited]
        return sums[1:] / sums[0]


def pressure_centres(taxels: FloatArray) -> FloatArray:
    """Centres of the normal force on square patches of taxels (3 m, n), along both axes, in taxels, (n, 2)."""
    push = np.maximum(taxels[2::3], 0.0)
    side = math.isqrt(len(push))
    rows, columns = np.divmod(np.arange(len(push)), side)
    places = np.stack([columns, rows]) - 0.5 * (side - 1)
    return (places @ push / np.maximum(push.sum(axis=0), TAXELS_LEAST)).T


def less_surface(means: FloatArray, values: FloatArray) -> FloatArray:
    """Values at the visited sites (n, k) less their least-squares fit by slope and thickness of the known surface.

    Args:
        means: of the readings at these sites (`SlideMemory.means`).
        values: (n, k).
    """
    across, along, outward, thickness = means[6:10]
    columns = [np.ones(len(values)), across, along, outward, 1.0 / np.maximum(thickness, 1.0)]
    # As many readings as unknowns would be fitted exactly.
    table = np.stack(columns[: 1 if len(values) < READINGS_LEAST else None], axis=1)
    return values - table @ np.linalg.lstsq(table, values, rcond=None)[0]


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
    reach = [
        np.linalg.norm(away[np.abs((angle - at + math.pi) % (2 * math.pi) - math.pi) < 0.4], axis=1) for at in sectors
    ]
    border = np.array([lengths.max(initial=0.0) for lengths in reach])
    turns = max(1, math.ceil(border.max() / spacing))
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


# ---- agents ----------------------------------------------------------------------------------------------------------


class SlideSweep:
    """Slides along a boustrophedon with one set point of the force, and maps by a Gaussian process.

    The process (`LesionEstimator`) reads the log of the force over depth^1.5, less a least-squares fit by the thickness
    and the slope of the known surface.
    """

    reads_taxels: ClassVar[bool] = False

    def reset(self, rng: np.random.Generator, facts: Any) -> None:
        """Begin an episode."""
        self.slices, self.memory = facts.observation_slices, None
        self.declared, self.press = np.full(LESIONS_MOST * LESION_NUMBERS, -1.0), PRESS

    def places(self, memory: SlideMemory) -> FloatArray:
        """Places to slide through [tip radii], (n, 2)."""
        return sweep(memory.map, ROW_SPACING)

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """The next action."""
        if self.memory is None:
            self.memory = SlideMemory(self.slices, observation)
            self.way = Way(self.places(self.memory))
        else:
            self.memory.add(observation)
        if self.memory.steps % MAP_STEPS == 0:
            self.declared = self.declare(self.memory)
        slide = np.clip(self.way.velocity(self.memory.place), -1.0, 1.0)
        # At the end of the way the tip lifts: a rest on the tissue doses it.
        press = -1.0 if self.way.goal is None else self.press
        return np.concatenate([slide, [press], self.declared]).astype(np.float32)

    def declare(self, memory: SlideMemory) -> FloatArray:
        """The declared map as numbers of an action."""
        points = self.estimated_lesions(memory).points
        return lesion_numbers(points, np.full(len(points), LESION_RADIUS), memory.map.extent)

    def estimated_lesions(self, memory: SlideMemory) -> LesionEstimate:
        """Lesions by the Gaussian process, lengths in tip radii."""
        estimator = LesionEstimator(
            memory.map.extent,
            lesion_radius=LESION_RADIUS,
            noise=READING_NOISE,
            gradient_noise=GRADIENT_NOISE * self.reads_taxels,
        )
        means = memory.means
        gradients = GRADIENT_GAIN * less_surface(means, pressure_centres(means[10:])) if self.reads_taxels else None
        return estimator.estimate(memory.map.sites[memory.visited], less_surface(means, means[:1].T)[:, 0], gradients)


class SlideSweepTaxels(SlideSweep):
    """As `SlideSweep`; the process also reads the centre of pressure on the taxels, less its fit, as its gradient."""

    reads_taxels = True


class SlideSpiral(SlideSweep):
    """As `SlideSweep`, along a spiral."""

    def places(self, memory: SlideMemory) -> FloatArray:
        """Places to slide through [tip radii], (n, 2)."""
        return spiral(memory.map, ROW_SPACING)


class SlideRandom(SlideSweep):
    """Slides along a random sweep, a spiral or through random places with a random force, and maps nothing.

    For recordings, and as the plainest agent.
    """

    def reset(self, rng: np.random.Generator, facts: Any) -> None:
        """Begin an episode."""
        super().reset(rng, facts)
        self.rng, self.press = rng, float(rng.uniform(*PRESSES))

    def places(self, memory: SlideMemory) -> FloatArray:
        """Places to slide through [tip radii], (n, 2)."""
        rng, kind, spacing = self.rng, self.rng.random(), float(self.rng.uniform(*ROW_SPACINGS))
        if kind < 0.5:
            return sweep(memory.map, spacing, flip=rng.random() < 0.5, down=rng.random() < 0.5)
        if kind < 0.7:
            return spiral(memory.map, spacing)
        return memory.map.sites[rng.choice(np.flatnonzero(memory.map.pressable), size=RANDOM_PLACES)]

    def declare(self, memory: SlideMemory) -> FloatArray:
        """Nothing."""
        return self.declared


class SlideOracle(SlideSweep):
    """Slides from lesion to lesion, the nearest next, and declares each as it is when the tip is over it."""

    sees_truth: ClassVar[bool] = True

    def see(self, task: SlideTask) -> None:
        """Take the truth of the episode, after `reset`."""
        truth, radius = task.true_map, task.charted.tip_radius
        self.lesions = 0.5 * (truth[:, :2] + 1.0) * task.charted.chart.extent / radius
        self.radii = truth[:, 2] / radius
        self.touched: list[int] = []

    def places(self, memory: SlideMemory) -> FloatArray:
        """The lesions, each the nearest to the one before (k, 2)."""
        place, left, ways = memory.place, list(range(len(self.lesions))), []
        while left:
            nearest = min(left, key=lambda lesion: float(np.linalg.norm(self.lesions[lesion] - place)))
            left.remove(nearest)
            place = self.lesions[nearest]
            ways.append(place)
        return np.array(ways).reshape(-1, 2)

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """The next action."""
        action = super().act(observation)
        assert self.memory is not None
        away = np.linalg.norm(self.lesions - self.memory.place, axis=1)
        near = np.flatnonzero(away < REACHED).tolist() if self.memory.site >= 0 else []
        self.touched += [lesion for lesion in near if lesion not in self.touched]
        action[3:] = lesion_numbers(self.lesions[self.touched], self.radii[self.touched], self.memory.map.extent)
        return action

    def declare(self, memory: SlideMemory) -> FloatArray:
        """Nothing by itself."""
        return self.declared


def lesion_numbers(places: FloatArray, radii: FloatArray, extent: FloatArray) -> FloatArray:
    """The declaration of lesions at places (k, 2) with radii (k,), all in tip radii, as numbers of an action."""
    rows = np.full((LESIONS_MOST, LESION_NUMBERS), -1.0)
    count = min(len(places), LESIONS_MOST)
    rows[:count, 0] = 1.0
    rows[:count, 1:3] = np.clip(2.0 * places[:count] / extent - 1.0, -1.0, 1.0)
    rows[:count, 3] = np.clip(radii[:count] - 1.0, -1.0, 1.0)
    return rows.ravel()


SLIDES: dict[str, type[SlideSweep]] = {
    "slide_random": SlideRandom,
    "slide_sweep": SlideSweep,
    "slide_sweep_taxels": SlideSweepTaxels,
    "slide_spiral": SlideSpiral,
    "slide_oracle": SlideOracle,
}
