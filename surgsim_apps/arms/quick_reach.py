"""Reach of two arms at many placements of their ports at once, from tables of what each reaches.

Each placement is checked as in an evaluation, but with few ways to each point and the organ's distance on a grid.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from surgsim_apps.arms.capability import Capability, DistanceField
from surgsim_apps.arms.clearance import TIP_ZONE, WORKING_ZONE, Obstacles, arm_distances, outside_ball
from surgsim_apps.arms.joint_search import Wanted, search_joints
from surgsim_apps.arms.kinematics import Chain
from surgsim_apps.arms.ports import Ports
from surgsim_apps.arms.reach import ARM_DISTANCE, Sites, isotropy, scaled_singular_values, trocar_load
from surgsim_apps.arms.through_cycle import extreme_signals, moved_organ
from surgsim_env.instruments import SIDES
from surgsim_env.scene import Anatomy, Port

# Ways to each point that are tried, and spacing of samples along an arm's shapes [m].
TRIED, SAMPLE_SPACING = 5, 0.004
# Height of a line of sight over the surface [m].
SIGHT_GAP = 0.002
# Clearances count up to this [m].
CLEARANCE_MOST = 0.02
# Greatest sideways force on a trocar over that at the tip, where the wall bears it, and least distance of a joint from
# its limits over its range: chosen.
LEVER_MOST, LIMIT_SHARE = 3.0, 0.01


@dataclass(frozen=True, eq=False)
class PlacementFigures:
    """Figures of p placements at n points.

    Fields:
        left, right, both: masks of the points in reach, at every position of the organ       (p, n)
        clearance: median over the points that both reach of the least distance of the arms from organ, wall and each
            other, up to CLEARANCE_MOST; 0 without one [m]                                    (p,)
        dexterity: median over these points of the less isotropic arm's isotropy; 0 without one     (p,)
    """

    left: NDArray[np.bool_]
    right: NDArray[np.bool_]
    both: NDArray[np.bool_]
    clearance: FloatArray
    dexterity: FloatArray

    @property
    def share(self) -> FloatArray:
        """Share of the points that both reach, (p,)."""
        return self.both.mean(axis=1)


@dataclass(frozen=True, eq=False)
class _Ways:
    """k ways of an arm to each of m points.

    Fields:
        usable: mask                                                (m, k)
        chain: of the arm in the world, m k sets
        gap: least distance from organ and wall [m]                 (m k,)
    """

    usable: NDArray[np.bool_]
    chain: Chain
    gap: FloatArray


class QuickReach:
    """Reach of two arms at placements of their ports.

    Fields:
        sites: the points, with the organ at rest
        tables: of each arm, by side
    """

    def __init__(self, anatomy: Anatomy, tables: Mapping[str, Capability], around: Obstacles, sites: Sites) -> None:
        """Take a scene, each arm's table by side, the obstacles and points of the organ."""
        self.sites, self.tables, self._around = sites, tables, around
        margin = WORKING_ZONE + max(table.kinematics.arm.shape_radius.max() for table in tables.values())
        triangles = anatomy.mesh.boundary_triangles
        # A breath is taken at rest and at the tops of its motions.
        self._positions = [
            (place, DistanceField(nodes, triangles, margin))
            for place, nodes in moved_organ(anatomy, sites, extreme_signals(anatomy.scene.motions))
        ]

    def evaluate(self, ports: Sequence[Ports]) -> PlacementFigures:
        """Figures of placements."""
        shape = len(ports), len(self.sites.points)
        masks = np.ones((3, *shape), dtype=bool)
        gaps, isotropies = np.full(shape, np.inf), np.full(shape, np.inf)
        for sites, field in self._positions:
            arms = [self._ways(side, [getattr(each, side).port for each in ports], sites, field) for side in SIDES]
            apart, pair = self._pairs(arms, np.tile(sites.points, (len(ports), 1)))
            both = apart >= ARM_DISTANCE
            masks &= np.stack([*(ways.usable.any(axis=1) for ways in arms), both]).reshape(3, *shape)
            rows = np.flatnonzero(both)
            for side, ways, way in zip(SIDES, arms, pair, strict=True):
                chosen, kinematics = rows * ways.usable.shape[1] + way[rows], self.tables[side].kinematics
                values = isotropy(scaled_singular_values(kinematics, ways.chain.only(chosen)))
                np.minimum.at(isotropies.reshape(-1), rows, values)
                np.minimum.at(gaps.reshape(-1), rows, np.minimum(ways.gap[chosen], apart[rows]))
        left, right, both = masks
        clearance = _medians(np.minimum(gaps, CLEARANCE_MOST), both)
        return PlacementFigures(left, right, both, clearance, _medians(isotropies, both))

    def alone(self, side: str, ports: Sequence[Port]) -> NDArray[np.bool_]:
        """Mask of the points in reach of one arm at ports, at every position of the organ, (p, n)."""
        masks = [self._ways(side, ports, *position).usable.any(axis=1) for position in self._positions]
        return np.logical_and.reduce(masks).reshape(len(ports), -1)

    def seen_from(self, point: FloatArray) -> float:
        """Share of the points that face a point (3,) [m] with no organ between, at rest."""
        sites, field = self._positions[0]
        away = point - sites.points
        length = np.linalg.norm(away, axis=1)
        # From just above the surface on.
        share = np.linspace(0.0, 1.0, int(length.max() / SAMPLE_SPACING) + 2)[1:, None]
        places = sites.points[:, None] + SIGHT_GAP * sites.normals[:, None] + share * away[:, None]
        facing = np.einsum("ni,ni->n", away, sites.normals) > 0.0
        return float((facing & (field.at(places) > 0.0).all(axis=1)).mean())

    def _ways(self, side: str, ports: Sequence[Port], sites: Sites, field: DistanceField) -> _Ways:
        """Ways of one arm at ports to all points."""
        table, count = self.tables[side], len(sites.points)
        kinematics = table.kinematics
        trocars, turns = np.array([port.point for port in ports]), np.array([port.rotation for port in ports])
        # Rows of a matrix times the frame's axes as columns: components in the port's frame.
        tips = ((sites.tips(table.ball) - trocars[:, None]) @ turns).reshape(-1, 3)
        starts = table.starts(tips, (sites.normals @ turns).reshape(-1, 3), TRIED)
        tried = starts.shape[1]
        found = search_joints(kinematics, Wanted(np.repeat(tips, tried, axis=0)), starts.reshape(len(tips) * tried, -1))
        trocar = np.repeat(trocars, count * tried, axis=0)
        chain = kinematics.at(found.joints).moved(np.repeat(turns, count * tried, axis=0), trocar)
        margin = np.minimum(found.joints - kinematics.lower, kinematics.upper - found.joints)
        usable = found.met & (margin >= LIMIT_SHARE * (kinematics.upper - kinematics.lower)).all(axis=1)
        if not kinematics.arm.remote_centre_fixed:
            load = trocar_load(kinematics, chain, -np.tile(np.repeat(sites.normals, tried, axis=0), (len(ports), 1)))
            usable &= ~(load > LEVER_MOST)
        touch, gap = (_organ_gap(table, chain, field, zone) for zone in (TIP_ZONE, WORKING_ZONE))
        inner = np.tile(np.repeat(sites.inner, tried), len(ports))
        wall = self._around.wall_gap(kinematics, chain.shape_ends, trocar[:, None])
        usable &= ((touch >= 0.0) | inner) & (wall >= 0.0) & self._around.clears_others(kinematics, chain.shape_ends)
        return _Ways(usable.reshape(-1, tried), chain, np.minimum(np.where(inner, np.inf, gap), wall))

    def _pairs(self, arms: Sequence[_Ways], points: FloatArray) -> tuple[FloatArray, NDArray[np.intp]]:
        """Distance of the arms at each point in the first pair of ways that keeps ARM_DISTANCE, and the pair.

        -inf without such a pair, (m,) and (2, m).
        """
        apart, pair = np.full(len(points), -np.inf), np.zeros((2, len(points)), dtype=np.intp)
        for ways in product(*(range(arm.usable.shape[1]) for arm in arms)):
            mask = arms[0].usable[:, ways[0]] & arms[1].usable[:, ways[1]] & ~np.isfinite(apart)
            rows = np.flatnonzero(mask)
            if not rows.size:
                continue
            left, right = (
                (self.tables[side].kinematics, arm.chain.only(rows * arm.usable.shape[1] + way))
                for side, arm, way in zip(SIDES, arms, ways, strict=True)
            )
            distance = np.minimum(*arm_distances(left, right, points[rows], CLEARANCE_MOST))
            kept = distance >= ARM_DISTANCE
            apart[rows[kept]], pair[:, rows[kept]] = distance[kept], np.array(ways)[:, None]
        return apart, pair


def _organ_gap(table: Capability, chain: Chain, field: DistanceField, zone: float) -> FloatArray:
    """Least distance of an arm's shapes from the organ, at samples beyond a zone about the tip [m], (n,)."""
    parts, left = outside_ball(chain.shape_ends, chain.tip[:, None], table.ball + zone)
    least = np.full(len(chain.tip), np.inf)
    for shape, radius in enumerate(table.kinematics.arm.shape_radius):
        for part in range(parts.shape[2]):
            rows = np.flatnonzero(left[:, shape, part])
            start, end = np.moveaxis(parts[rows, shape, part], 1, 0)
            longest = float(np.linalg.norm(end - start, axis=1).max(initial=0.0))
            share = np.linspace(0.0, 1.0, int(longest / SAMPLE_SPACING) + 2)[:, None, None]
            least[rows] = np.minimum(least[rows], field.at(start + share * (end - start)).min(axis=0) - radius)
    return least


def _medians(values: FloatArray, mask: NDArray[np.bool_]) -> FloatArray:
    """Median of the chosen values in each row, 0 without one."""
    chosen = (row[kept] for row, kept in zip(values, mask, strict=True))
    return np.array([float(np.median(row)) if row.size else 0.0 for row in chosen])
