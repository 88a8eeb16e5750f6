"""Tables of what an arm reaches in the frame of its port, and of an organ's distance.

Both are made once for many placements. After Zacharias, Borst & Hirzinger 2007, "Capturing robot workspace structure:
representing robot capabilities".
"""

from dataclasses import replace

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree

from msdm_core.mesh import FloatArray, IntArray
from surgsim_apps.arms.clearance import segment_triangle_distance
from surgsim_apps.arms.joint_search import approach_directions, from_directions, from_starts, spread_starts
from surgsim_apps.arms.kinematics import BatchKinematics
from surgsim_apps.arms.ports import vector
from surgsim_apps.arms.reach import tip_ball
from surgsim_env.instruments import load_arm, solve_pose
from surgsim_env.scene import ArmDescription, Port

# Grid of the tip's places: spacing, least and greatest distance from the trocar [m], least cosine from the port's axis.
SPACING, NEAREST, FURTHEST, CONE = 0.06, 0.03, 0.30, 0.3
# Ways to each place that are kept.
WAYS = 12
# Shift of an arm's base along its table [m].
BASE_SHIFT = 0.1
# Spacing of the organ's distances [m], and number of spacings within which they are exact.
FIELD_SPACING, NEAR_SPACINGS = 0.005, 4


class Capability:
    """Joint values of an arm at places of its tip, in the frame of its port.

    Fields:
        kinematics: of the arm at a port at the origin
        ball: radius of its tip [m]
    """

    def __init__(self, description: ArmDescription, tip_radius: float) -> None:
        """Search joint values at a grid of places, from starts and along directions; keep WAYS that point apart."""
        self.kinematics = BatchKinematics(load_arm(description, Port(), tip_radius=tip_radius))
        self.ball = tip_ball(self.kinematics)
        steps = np.arange(-FURTHEST, FURTHEST + 0.5 * SPACING, SPACING)
        grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        away = np.linalg.norm(grid, axis=1)
        grid = grid[(away <= FURTHEST) & (away >= NEAREST) & (-grid[:, 2] >= CONE * away)]
        found = from_starts(self.kinematics, grid, spread_starts(self.kinematics))
        reached = np.flatnonzero(found.met.any(axis=1))
        places, found = grid[reached], found.only(reached)
        back = -places / np.linalg.norm(places, axis=1)[:, None]
        directions = approach_directions(back, np.broadcast_to([1.0, 0.0, 0.0], back.shape), np.array([0.0, 1.0, 0.0]))
        found = found.add(from_directions(self.kinematics, places, directions, found, found.met))
        rows, chosen = np.arange(len(places)), [found.met.argmax(axis=1)]
        cosine = np.full(found.met.shape, -np.inf)
        for _ in range(WAYS - 1):
            cosine = np.maximum(cosine, np.einsum("nki,ni->nk", found.pointing, found.pointing[rows, chosen[-1]]))
            furthest = np.where(found.met, cosine, np.inf).argmin(axis=1)
            if (cosine[rows, furthest] > 1.0 - 1e-6).all():
                break
            chosen.append(furthest)
        ways = rows[:, None], np.stack(chosen, axis=1)
        self._places = KDTree(places)
        self._joints, self._pointing = found.joints[ways], found.pointing[ways]

    def starts(self, tips: FloatArray, normals: FloatArray, count: int) -> FloatArray:
        """Joint values to search from: those of the nearest place, up to `count` ways most along the inward normals.

        Args:
            tips: places (n, 3) [m].
            normals: (n, 3).
            count: of ways.

        Returns:
            (n, k, n_joint) [rad or m].
        """
        nearest = np.asarray(self._places.query(tips)[1])
        order = np.argsort(np.einsum("nki,ni->nk", self._pointing[nearest], normals), axis=1)[:, :count]
        return self._joints[nearest[:, None], order]


def shifted_bases(description: ArmDescription) -> list[ArmDescription]:
    """An arm with its base BASE_SHIFT beside its place along x and y of its model's frame, each with a home.

    Empty where the mechanism holds the shaft in the trocar.
    """
    arm, trocar = load_arm(description), description.trocar
    if arm.remote_centre_fixed:
        return []
    tip, shifted = arm.tip_pose(arm.home).position, []
    for x, y in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
        shift = BASE_SHIFT * np.array([x, y, 0.0])
        arm.trocar = shift @ Port(into=trocar.into).rotation
        home = solve_pose(arm, tip + arm.trocar)
        if home.reached:
            moved = replace(trocar, point=vector(np.array(trocar.point) + shift))
            joints = dict(zip(arm.joints, home.joints.tolist(), strict=True))
            shifted.append(replace(description, trocar=moved, home=joints))
    return shifted


class DistanceField:
    """Signed distance from a closed surface on a grid, negative inside; inf beyond a margin around it."""

    def __init__(self, points: FloatArray, triangles: IntArray, margin: float) -> None:
        """Take a surface's points (n, 3) [m], outward triangles (m, 3), and the margin [m]."""
        corners = points[triangles]
        while np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1).mean() > FIELD_SPACING:
            corners = quartered(corners)
        centres, normals = corners.mean(axis=1), np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._low = points.min(axis=0) - margin
        shape = np.ceil((points.max(axis=0) + margin - self._low) / FIELD_SPACING).astype(int) + 1
        grid = self._low + FIELD_SPACING * np.moveaxis(np.indices(shape), 0, -1)
        distance, nearest = map(np.asarray, KDTree(centres).query(grid, workers=-1))
        # Near the surface the way to a triangle's centre is longer than that to the triangle.
        near = distance < NEAR_SPACINGS * FIELD_SPACING
        distance[near] = segment_triangle_distance(np.stack([grid[near]] * 2, axis=1), corners[nearest[near]])
        outside = np.einsum("...i,...i->...", grid - centres[nearest], normals[nearest]) > 0.0
        self._values = np.where(outside, distance, -distance)

    def at(self, points: FloatArray) -> FloatArray:
        """Distances of points (..., 3) [m], trilinear, (...)."""
        places = np.moveaxis((points - self._low) / FIELD_SPACING, -1, 0)
        return map_coordinates(self._values, places, order=1, cval=np.inf)


def quartered(corners: FloatArray) -> FloatArray:
    """Each triangle (n, 3, 3) cut into four congruent ones."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
    parts = [np.stack(three, axis=1) for three in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.stack(parts, axis=1).reshape(-1, 3, 3)
