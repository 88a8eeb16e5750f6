"""Search for the ports of two arms and the endoscope on a body wall, and for the places of the arms' bases.

Ports of each arm alone are sampled; the pairs with the most points in common begin a differential evolution (Storn &
Price 1997) of two angles and a roll for each arm. The endoscope follows.
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import differential_evolution
from scipy.stats import qmc

from msdm_core.mesh import FloatArray, IntArray
from surgsim_apps.arms.capability import Capability
from surgsim_apps.arms.kinematics import cross, dot
from surgsim_apps.arms.ports import EndoscopePort, PortPlace, Ports, vector
from surgsim_apps.arms.quick_reach import CLEARANCE_MOST, PlacementFigures, QuickReach
from surgsim_apps.arms.results import Placement, PortsFound
from surgsim_env.instruments import SIDES
from surgsim_env.scene import Anatomy, tangent_axes
from surgsim_env.step_progress import StepProgress

# Greatest angle of a port from the line of sight [rad], and least distances of ports from each other (6 to 10 cm:
# aischannel 2019) and from the organ [m].
ANGLE_MOST, PORTS_APART, ORGAN_APART = math.radians(60.0), 0.06, 0.03
# Least cosine between the line from the left to the right port and the given one: the left arm stays left.
LINE_COSINE = 0.5
# Ports of each arm alone that are sampled, and these at once.
ALONE, ALONE_AT_ONCE = 256, 32
# Placements of a generation, most of them with one port, and greatest number of generations without a better one.
GENERATION, PORT_USES_MOST, PATIENCE = 32, 4, 20
# Worth of a placement: share of the points that both reach, plus these times the mean share of each arm, the clearance
# over CLEARANCE_MOST, and the dexterity.
WORTHS = 0.1, 0.02, 0.02
# Least gain in worth that counts as a better placement.
WORTH_LEAST = 0.002
# Ranges of the two angles and the roll of an arm [rad].
BOUNDS = [(-ANGLE_MOST, ANGLE_MOST), (-ANGLE_MOST, ANGLE_MOST), (-math.pi, math.pi)]
# Directions of the endoscope's port along each angle.
SCOPE_DIRECTIONS = 15


class PortSearch:
    """Placements of ports on a body wall, by directions from the endoscope's target.

    Fields:
        ports: to begin with
        quick: reach of the arms
    """

    def __init__(
        self, anatomy: Anatomy, quick: QuickReach, ports: Ports, tables: Mapping[str, Sequence[Capability]]
    ) -> None:
        """Take a scene, the reach of its arms, ports to begin with (`on_one_wall`), and each arm's bases by side."""
        self.quick, self._organ = quick, anatomy.mesh.points
        self._given, self._tables = quick.tables, tables
        self.ports = ports
        self._skin = None if ports.wall.skin is None else ports.wall.skin.read()
        line = np.array(ports.right.point) - np.array(ports.left.point)
        self._line = line / np.linalg.norm(line)
        self._target = np.array(ports.endoscope.target)
        self._out = np.array(ports.endoscope.point) - self._target
        self._out /= np.linalg.norm(self._out)
        self._aside = np.stack(tangent_axes(-self._out))

    def run(self, seconds: float, seed: int, progress: StepProgress) -> PortsFound:
        """Search for so long, or until PATIENCE generations bring nothing better."""
        tried: list[Placement] = []
        worths: list[float] = []
        end = time.monotonic() + seconds

        def losses(columns: FloatArray) -> FloatArray:
            placed = {row: ports for row, values in enumerate(columns.T) if (ports := self.placed(values)) is not None}
            result = np.ones(columns.shape[1])
            if placed:
                figures = self.quick.evaluate([*placed.values()])
                result[[*placed]] = -_worth(figures)
                tried.extend(_placements([*placed.values()], figures))
                worths.extend(_worth(figures).tolist())
            return result

        best_worth, waited = -math.inf, 0

        def over(*_: object, **__: object) -> bool:
            nonlocal best_worth, waited
            advance(GENERATION)
            best = max(worths, default=-math.inf)
            better = best >= best_worth + WORTH_LEAST
            best_worth, waited = best if better else best_worth, 0 if better else waited + 1
            return time.monotonic() > end or waited >= PATIENCE

        self.quick.tables = self._given
        (given,) = _placements([self.ports], self.quick.evaluate([self.ports]))
        with progress.step(f"searching ports for at most {seconds:g} s") as advance:
            begin: Any = self._begin(seed, 0.5 * seconds)
            differential_evolution(
                losses, BOUNDS * 2, init=begin, vectorized=True, updating="deferred", tol=0.0, maxiter=10**6,
                polish=False, callback=over, rng=seed,
            )  # fmt: skip
        best = tried[int(np.argmax(worths))]
        swapped = [replace(self.ports, **{side: getattr(best.ports, side)}) for side in SIDES]
        gains: dict[str, float] = dict(zip(SIDES, self.quick.evaluate(swapped).share.tolist(), strict=True))
        with progress.step("trying places of the bases"):
            gains["bases"] = self._with_best_bases(self.ports).share
            best = self._with_best_bases(best.ports)
        seen = replace(best, ports=replace(best.ports, endoscope=self._endoscope(best.ports)))
        moved = [side for side in SIDES if self.quick.tables[side] is not self._given[side]]
        arms = {side: self.quick.tables[side].kinematics.arm.description for side in moved}
        return PortsFound(given, seen, _front([given, best, *tried]), gains, len(tried), arms)

    def _with_best_bases(self, ports: Ports) -> Placement:
        """The placement of ports with the bases of the greatest worth, whose tables `quick` keeps.

        Bases stay where others are better by less than WORTH_LEAST.
        """
        choices: list[dict[str, Capability]]
        choices = [dict(zip(SIDES, pair, strict=True)) for pair in product(*(self._tables[side] for side in SIDES))]
        figures = []
        for self.quick.tables in choices:
            figures.append(self.quick.evaluate([ports]))
        worths = np.array([_worth(each)[0] for each in figures])
        # The first are the bases in their places.
        index = int(worths.argmax()) if worths.max() >= worths[0] + WORTH_LEAST else 0
        self.quick.tables = choices[index]
        return _placements([ports], figures[index])[0]

    def _begin(self, seed: int, seconds: float) -> FloatArray:
        """The given ports, and pairs of sampled ones with the most points that each arm of the pair reaches alone.

        Returns:
            Numbers of the first generation (GENERATION, 6).
        """
        end, low, high = time.monotonic() + seconds, *np.transpose(BOUNDS)
        values, points, masks = [], [], []
        for number, side in enumerate(SIDES):
            sampled = low + (high - low) * qmc.Sobol(3, rng=np.random.default_rng([seed, number])).random(ALONE)
            kept = {index: place for index, row in enumerate(sampled) if (place := self._place(row)) is not None}
            chosen, reached = [*kept], []
            for first in range(0, len(chosen), ALONE_AT_ONCE):
                reached.append(
                    self.quick.alone(side, [kept[row].port for row in chosen[first : first + ALONE_AT_ONCE]])
                )
                if time.monotonic() > end - (1 - number) * 0.5 * seconds:
                    break
            masks.append(np.concatenate(reached).astype(float))
            values.append(sampled[chosen[: len(masks[-1])]])
            points.append(np.array([kept[row].point for row in chosen[: len(masks[-1])]]))
        left, right = masks
        worth = left @ right.T + WORTHS[0] * 0.5 * (left.sum(axis=1)[:, None] + right.sum(axis=1))
        worth[~self._apart(points[0][:, None], points[1])] = -1.0
        begin, uses = [np.clip(self._values(self.ports), np.tile(low, 2), np.tile(high, 2))], np.zeros((2, ALONE), int)
        for flat in np.argsort(-worth, axis=None, kind="stable"):
            pair = np.unravel_index(flat, worth.shape)
            if len(begin) == GENERATION:
                break
            if (uses[(0, 1), pair] < PORT_USES_MOST).all():
                uses[(0, 1), pair] += 1
                begin.append(np.concatenate([values[0][pair[0]], values[1][pair[1]]]))
        return np.array(begin)

    def _apart(self, left: FloatArray, right: FloatArray) -> NDArray[np.bool_]:
        """Mask of trocars (..., 3) [m] far enough from each other, and on their sides."""
        line = right - left
        apart = np.linalg.norm(line, axis=-1)
        return (apart >= PORTS_APART) & (line @ self._line >= LINE_COSINE * apart)

    def _direction(self, angles: FloatArray) -> FloatArray:
        """Unit vector from the target at two angles [rad] about the line of sight (3,)."""
        direction = self._out + np.tan(angles) @ self._aside
        return direction / np.linalg.norm(direction)

    def _values(self, ports: Ports) -> FloatArray:
        """The search's numbers of ports: two angles [rad] and a roll [rad] of each arm (6,)."""
        values = []
        for side in SIDES:
            place = getattr(ports, side)
            away = np.array(place.point) - self._target
            values += [*np.arctan2(self._aside @ away, max(float(away @ self._out), 1e-9)), place.roll]
        return np.array(values)

    def placed(self, values: FloatArray) -> Ports | None:
        """Ports of the search's numbers; None where they miss the wall or come too near to each other or the organ."""
        left, right = map(self._place, values.reshape(2, 3))
        if left is None or right is None or not self._apart(np.array(left.point), np.array(right.point)):
            return None
        return replace(self.ports, left=left, right=right)

    def _place(self, values: FloatArray) -> PortPlace | None:
        """A port by two angles and a roll [rad]; None where it misses the wall or comes too near to the organ."""
        point = self._on_wall(self._direction(values[:2]))
        return None if point is None else PortPlace(vector(point), target=vector(self._target), roll=float(values[2]))

    def _on_wall(self, direction: FloatArray) -> FloatArray | None:
        """The furthest point of the wall [m] (3,) on a ray from the target; None without one far from the organ."""
        wall = self.ports.wall
        if self._skin is not None:
            reach = _ray_hit(self._target, direction, self._skin)
        elif wall.plate:
            middle = 0.5 * (np.array(self.ports.left.point) + np.array(self.ports.right.point))
            slope = float(direction @ self.ports.wall_normal)
            reach = float((middle - self._target) @ self.ports.wall_normal) / slope if slope > 0.0 else -math.inf
        else:
            offset = self._target - self.ports.dome_centre
            along = float(offset @ direction)
            squared = along**2 - float(offset @ offset) + wall.radius**2
            reach = math.sqrt(squared) - along if squared > 0.0 else -math.inf
        point = self._target + reach * direction
        far = reach > 0.0 and np.linalg.norm(self._organ - point, axis=1).min() >= ORGAN_APART
        return point if far else None

    def _endoscope(self, ports: Ports) -> EndoscopePort:
        """The port on the wall from which most points are seen, nearest to the middle of the instruments' ports.

        It keeps PORTS_APART from both.
        """
        middle = 0.5 * (np.array(ports.left.point) + np.array(ports.right.point))
        best, chosen = (-1.0, 0.0), ports.endoscope
        for angles in product(np.linspace(-ANGLE_MOST, ANGLE_MOST, SCOPE_DIRECTIONS), repeat=2):
            point = self._on_wall(self._direction(np.array(angles)))
            if point is None or min(math.dist(point, getattr(ports, side).point) for side in SIDES) < PORTS_APART:
                continue
            # Shares in twentieths: the middle counts where they are alike.
            key = round(20.0 * self.quick.seen_from(point)), -math.dist(point, middle)
            if key > best:
                best, chosen = key, EndoscopePort(vector(point), vector(self._target))
        return chosen


def on_one_wall(ports: Ports) -> Ports:
    """Ports with their dome fixed, wherever others lie on it."""
    if not ports.has_dome or ports.wall.centre is not None:
        return ports
    return replace(ports, wall=replace(ports.wall, centre=vector(ports.dome_centre)))


def _placements(ports: Sequence[Ports], figures: PlacementFigures) -> list[Placement]:
    columns = figures.share, figures.clearance, figures.dexterity
    return [Placement(each, *map(float, row)) for each, row in zip(ports, np.transpose(columns), strict=True)]


def _worth(figures: PlacementFigures) -> FloatArray:
    alone = 0.5 * (figures.left.mean(axis=1) + figures.right.mean(axis=1))
    parts = alone, figures.clearance / CLEARANCE_MOST, figures.dexterity
    return figures.share + sum(worth * part for worth, part in zip(WORTHS, parts, strict=True))


def _front(tried: Sequence[Placement]) -> tuple[Placement, ...]:
    """The Pareto front, in whole per cent, millimetres and hundredths; of equal placements the first."""
    figures = np.array([[each.share * 100.0, each.clearance * 1e3, each.dexterity * 100.0] for each in tried]).round()
    front = []
    for row in np.lexsort(-figures.T[::-1]):
        better = (figures >= figures[row]).all(axis=1) & (figures > figures[row]).any(axis=1)
        if not better.any() and not any((figures[row] == figures[kept]).all() for kept in front):
            front.append(row)
    return tuple(tried[row] for row in front)


def _ray_hit(start: FloatArray, direction: FloatArray, surface: tuple[FloatArray, IntArray]) -> float:
    """Length of a ray to its furthest crossing of a surface [m], -inf without one (Moeller & Trumbore 1997)."""
    a, b, c = np.moveaxis(surface[0][surface[1]], 1, 0)
    first, second = b - a, c - a
    side = cross(np.broadcast_to(direction, second.shape), second)
    scale = dot(first, side)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = dot(start - a, side) / scale
        turned = cross(start - a, first)
        v, length = dot(turned, direction) / scale, dot(turned, second) / scale
        hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (length > 0.0)
    return float(length[hit].max(initial=-math.inf))
