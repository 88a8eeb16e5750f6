"""Reach of an arm, its dexterity at points in reach, reasons for the others; reach of both arms at once."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray, IntArray
from surgsim_apps.arms.clearance import Obstacles, arm_distances
from surgsim_apps.arms.joint_search import (
    REACHED,
    Candidates,
    across,
    approach_directions,
    directions_met,
    from_directions,
    from_neighbours,
    from_starts,
    spread_starts,
)
from surgsim_apps.arms.kinematics import BatchKinematics, Chain, cross, dot
from surgsim_apps.arms.results import ArmReach

# Candidates in a batch of clearances.
CANDIDATES_AT_ONCE = 20_000
# Smallest distance between arms in reach at once [m].
ARM_DISTANCE = 0.005
# Candidates of each arm for other pairs, when the reported joints come too close.
WAYS = 6
# One radian of rotation of the tip counts as this travel [m].
CHARACTERISTIC_LENGTH = 0.1


@dataclass(frozen=True)
class Sites:
    """Targets of the arms: points and outward normals (n, 3) [m], and a mask of those inside the organ (n,)."""

    points: FloatArray
    normals: FloatArray
    inner: NDArray[np.bool_]

    def only(self, rows: NDArray) -> "Sites":
        """Some of them."""
        return Sites(self.points[rows], self.normals[rows], self.inner[rows])

    def tips(self, ball: float) -> FloatArray:
        """Places of a tip with its ball [m] on the surface; an inner target itself, (n, 3)."""
        return self.points + np.where(self.inner, 0.0, ball)[:, None] * self.normals


@dataclass(frozen=True)
class Reach:
    """Joint values of an arm for n points.

    Fields:
        kinematics: of the arm
        candidates: k for each point
        usable: mask of those past every test               (n, k)
        report: its figures
    """

    kinematics: BatchKinematics
    candidates: Candidates
    usable: NDArray[np.bool_]
    report: ArmReach


def tip_ball(kinematics: BatchKinematics) -> float:
    """Radius of the ball centred at the tip [m], 0 without one."""
    arm = kinematics.arm
    name = arm.description.tip.ball
    if name is None:
        return 0.0
    geom = arm.model.geom(name)
    same_body = geom.bodyid[0] == arm.model.site_bodyid[arm.tip_site]
    centred = np.linalg.norm(geom.pos - arm.model.site_pos[arm.tip_site]) < 1e-6
    return float(geom.size[0]) if same_body and centred else 0.0


def evaluate_reach(kinematics: BatchKinematics, sites: Sites, around: Obstacles) -> Reach:
    """Reach and dexterity of one arm at every site.

    A point is reached if a candidate from any start, direction or neighbour puts the tip within 1 mm of it, keeps
    limits and trocar and clears organ and wall. The reported joints are those of the usable candidate furthest from
    the joint limits.
    """
    search, candidates = _begin(kinematics, sites, around)
    candidates, clear = search.all_around(candidates, search.clear(candidates, candidates.met))
    usable = _every(clear)
    report = _report(search, candidates, usable, _reasons(search, candidates, clear))
    return Reach(kinematics, candidates, usable, report)


def _begin(kinematics: BatchKinematics, sites: Sites, around: Obstacles) -> tuple["_Search", Candidates]:
    """A search, and candidates from spread starts and from neighbours."""
    ports = around.ports
    directions = approach_directions(
        sites.normals,
        np.array(ports.endoscope.point) - sites.points,
        np.array(ports.right.point) - np.array(ports.left.point),
    )
    search = _Search(kinematics, sites, around, sites.tips(around.ball), directions)
    candidates = from_starts(kinematics, search.tips, spread_starts(kinematics))
    return search, from_neighbours(kinematics, search.tips, candidates)


def _widest(kinematics: BatchKinematics, candidates: Candidates, usable: NDArray[np.bool_]) -> IntArray:
    """Index of the usable candidate of each point that is furthest from joint limits, (n,)."""
    return np.where(usable, limit_margin(kinematics, candidates.joints), -np.inf).argmax(axis=1).astype(np.int32)


@dataclass(frozen=True)
class _Search:
    """An arm, its targets and obstacles; positions of its tip (n, 3) [m] and approach directions (n, 32, 3)."""

    kinematics: BatchKinematics
    sites: Sites
    around: Obstacles
    tips: FloatArray
    directions: FloatArray

    def all_around(self, candidates: Candidates, clear: NDArray[np.bool_]) -> tuple[Candidates, NDArray[np.bool_]]:
        """Further candidates from every direction, in two rounds: begun at any at the point, then at usable ones."""
        for begin in (candidates.met, None):
            if begin is None:
                # Without a usable one, the second round too begins at any candidate at the point.
                usable = _every(clear)
                begin = np.where(np.any(usable, axis=1, keepdims=True), usable, candidates.met)
            lacking: NDArray[np.bool_] = ~np.all(
                directions_met(candidates.pointing, _every(clear), self.directions), axis=1
            )
            candidates, clear = self.with_directions(candidates, clear, begin, lacking)
        return candidates, clear

    def with_directions(
        self, candidates: Candidates, clear: NDArray[np.bool_], begin: NDArray[np.bool_], wanted: NDArray[np.bool_]
    ) -> tuple[Candidates, NDArray[np.bool_]]:
        """Further candidates of wanted points (n,) from every direction, begun at a mask of those there are (n, k)."""
        rows = np.flatnonzero(wanted & np.any(candidates.met, axis=1))
        added = _empty_like(candidates, self.directions.shape[1])
        if rows.size:
            part = from_directions(
                self.kinematics, self.tips[rows], self.directions[rows], candidates.only(rows), begin[rows]
            )
            for name in vars(added):
                getattr(added, name)[rows] = getattr(part, name)
        return candidates.add(added), np.concatenate([clear, self.clear(added, added.met)], axis=2)

    def clear(self, candidates: Candidates, tried: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Masks of tried candidates (n, k): all, and those clear of the organ, the wall and others, (4, n, k)."""
        result = np.zeros((4, *tried.shape), dtype=bool)
        result[0] = tried
        points, places = np.nonzero(tried)
        for low in range(0, len(points), CANDIDATES_AT_ONCE):
            point, place = points[low : low + CANDIDATES_AT_ONCE], places[low : low + CANDIDATES_AT_ONCE]
            chain = self.kinematics.at(candidates.joints[point, place])
            off_organ = self.around.clears_organ(self.kinematics, chain)
            result[1, point, place] = off_organ | self.sites.inner[point]
            result[2, point, place] = self.around.wall_clearance(self.kinematics, chain) >= 0.0
            result[3, point, place] = self.around.clears_others(self.kinematics, chain.shape_ends)
        return result


def _every(clear: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask of candidates past every test, (n, k)."""
    return np.logical_and.reduce(clear, axis=0)


def _empty_like(candidates: Candidates, count: int) -> Candidates:
    """Candidates far from every point."""
    points, _, joints = candidates.joints.shape
    errors = np.full((points, count), np.inf)
    return Candidates(np.zeros((points, count, joints)), errors, errors.copy(), np.zeros((points, count, 3)))


def _reasons(search: _Search, candidates: Candidates, clear: NDArray[np.bool_]) -> IntArray:
    """Index into REASONS of each point: the first test without a passing candidate, (n,)."""
    kinematics, tips = search.kinematics, search.tips
    reason = np.where(np.any(_every(clear[:2]), axis=1), 5, 4)
    reason[np.any(_every(clear[:3]), axis=1)] = 6
    reason[np.any(_every(clear), axis=1)] = 0
    lost = np.flatnonzero(~np.any(clear[0], axis=1))
    if lost.size:
        starts = spread_starts(kinematics)
        best = np.argmin(candidates.position_error[lost] + candidates.trocar_error[lost], axis=1)
        own = np.concatenate(
            [np.broadcast_to(starts, (lost.size, *starts.shape)), candidates.joints[lost, best][:, None]], axis=1
        )
        reason[lost] = 1
        free = from_starts(kinematics, tips[lost], own, limits=False, trocar=False)
        reason[lost[np.any(free.position_error <= REACHED, axis=1)]] = 2
        held = from_starts(kinematics, tips[lost], own, trocar=False)
        reason[lost[np.any(held.position_error <= REACHED, axis=1)]] = 3
    return reason.astype(np.int32)


def _report(search: _Search, candidates: Candidates, usable: NDArray[np.bool_], reason: IntArray) -> ArmReach:
    kinematics, sites, around = search.kinematics, search.sites, search.around
    rows, good = np.arange(len(reason)), reason == 0
    nearest = np.argmin(candidates.position_error + candidates.trocar_error, axis=1)
    best = np.where(good, _widest(kinematics, candidates, usable), nearest)
    joints = candidates.joints[rows, best]
    chain = kinematics.at(joints)
    values = scaled_singular_values(kinematics, chain)
    organ = np.full(len(rows), np.nan)
    outer = np.flatnonzero(good & ~sites.inner)
    if outer.size:
        organ[outer] = around.organ_clearance(kinematics, kinematics.at(joints[outer]))

    def where_reached(quantity: FloatArray) -> FloatArray:
        return np.where(good & np.isfinite(quantity), quantity, np.nan)

    return ArmReach(
        name=kinematics.arm.description.name,
        reason=reason,
        joints=joints,
        position_error=candidates.position_error[rows, best],
        approach_share=where_reached(directions_met(candidates.pointing, usable, search.directions).mean(axis=1)),
        manipulability=where_reached(manipulability(values)),
        isotropy=where_reached(isotropy(values)),
        limit_margin=where_reached(limit_margin(kinematics, joints)),
        tip_force=where_reached(tip_force(kinematics, chain, -sites.normals)),
        trocar_load=where_reached(trocar_load(kinematics, chain, -sites.normals)),
        camera_angle=where_reached(camera_angle(chain, sites.points, np.array(around.ports.endoscope.point))),
        organ_clearance=organ,
        wall_clearance=where_reached(around.wall_clearance(kinematics, chain)),
        trocar_error=where_reached(kinematics.trocar_error(chain)),
    )


@dataclass(frozen=True)
class BothArms:
    """Points in reach of both arms at once.

    Fields:
        reachable: mask of them                                                         (n,)
        inside, outside: the pair's smallest distances inside and outside the body [m]  (n,)
        joints: of the left and the right arm in that pair [rad or m]                   (n, n_joint) each
    """

    reachable: NDArray[np.bool_]
    inside: FloatArray
    outside: FloatArray
    joints: tuple[FloatArray, FloatArray]


def evaluate_both(left: Reach, right: Reach, points: FloatArray) -> BothArms:
    """Points in reach of both arms at once: with the reported joints, else with the best of 6 x 6 other pairs."""
    inside, outside = np.full(len(points), np.nan), np.full(len(points), np.nan)
    joints = left.report.joints.copy(), right.report.joints.copy()
    rows = np.flatnonzero(left.report.reachable & right.report.reachable)
    if rows.size:
        kinematics = left.kinematics, right.kinematics
        inside[rows], outside[rows] = pair_distances(kinematics, (joints[0][rows], joints[1][rows]), points[rows])
    close = rows[np.minimum(inside[rows], outside[rows]) < ARM_DISTANCE]
    if close.size:
        # The widest of the pairs of candidates there.
        other = [ways(arm, close) for arm in (left, right)]
        for first, second in product(range(WAYS), repeat=2):
            pair = other[0][:, first], other[1][:, second]
            near, far = pair_distances((left.kinematics, right.kinematics), pair, points[close])
            wider = np.minimum(near, far) > np.minimum(inside[close], outside[close])
            inside[close[wider]], outside[close[wider]] = near[wider], far[wider]
            for chosen, tried in zip(joints, pair, strict=True):
                chosen[close[wider]] = tried[wider]
    with np.errstate(invalid="ignore"):
        return BothArms(np.minimum(inside, outside) >= ARM_DISTANCE, inside, outside, joints)


def ways(arm: Reach, rows: NDArray) -> FloatArray:
    """Joint values of usable candidates, the furthest from limits to the nearest, (len(rows), WAYS, n_joint)."""
    usable = arm.usable[rows]
    margin = np.where(usable, limit_margin(arm.kinematics, arm.candidates.joints[rows]), -np.inf)
    order = np.argsort(-margin, axis=1, kind="stable")
    count = usable.sum(axis=1)
    rank = (np.linspace(0.0, 1.0, WAYS) * (count[:, None] - 1)).astype(np.int64)
    chosen = np.take_along_axis(order, rank, axis=1)
    return arm.candidates.joints[rows[:, None], chosen]


def pair_distances(
    kinematics: tuple[BatchKinematics, BatchKinematics], joints: tuple[FloatArray, FloatArray], points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """`arm_distances` of the left and the right arm at joint values (n, n_joint) each."""
    first, second = ((arm, arm.at(values)) for arm, values in zip(kinematics, joints, strict=True))
    return arm_distances(first, second, points)


def scaled_singular_values(kinematics: BatchKinematics, chain: Chain) -> FloatArray:
    """Singular values, largest first, of J = [J_v; L J_w] with L = 0.1 m, shape (n, k).

    k is the smaller of 6 and the degrees of freedom with the shaft in the trocar: if control keeps it there, J acts on
    the remaining n_joint - 2 motions.
    """
    linear, angular = kinematics.tip_jacobian(chain)
    jacobian = np.concatenate([linear, CHARACTERISTIC_LENGTH * angular], axis=1)
    freedoms = kinematics.arm.joint_count
    if not kinematics.arm.remote_centre_fixed:
        idle = np.linalg.svd(across(kinematics.shaft_jacobian(chain), chain.along))[2][:, 2:]
        jacobian, freedoms = jacobian @ np.swapaxes(idle, 1, 2), freedoms - 2
    values: FloatArray = np.asarray(np.linalg.svd(jacobian, compute_uv=False), dtype=np.float64)
    return values[:, : min(6, freedoms)]


def manipulability(singular_values: FloatArray) -> FloatArray:
    """Yoshikawa's measure, the product of the singular values: sqrt(det J J^T) at full rank, (n,)."""
    return singular_values.prod(axis=1)


def isotropy(singular_values: FloatArray) -> FloatArray:
    """Smallest over largest singular value: 1 moves alike in all directions, 0 is singular, (n,)."""
    return singular_values[:, -1] / singular_values[:, 0]


def limit_margin(kinematics: BatchKinematics, joints: FloatArray) -> FloatArray:
    """Prod 4 (q - low)(high - q) / (high - low)^2 over joints: 1 in the middle of all limits, 0 at any, (n,)."""
    low, high = kinematics.lower, kinematics.upper
    return (4.0 * (joints - low) * (high - joints) / (high - low) ** 2).prod(axis=-1)


def tip_force(kinematics: BatchKinematics, chain: Chain, directions: FloatArray) -> FloatArray:
    """Largest static force along unit vectors (n, 3) within the joints' torques [N], (n,); inf if none is stated.

    tau = J_v^T F d, so F = min over joints of tau_max / |J_v^T d|. Gravity is compensated; the trocar bears no load.
    """
    torque = np.abs(np.einsum("nij,ni->nj", kinematics.tip_jacobian(chain)[0], directions))
    with np.errstate(divide="ignore"):
        return np.where(torque > 1e-12, kinematics.effort / np.maximum(torque, 1e-300), np.inf).min(axis=1)


def trocar_load(kinematics: BatchKinematics, chain: Chain, directions: FloatArray) -> FloatArray:
    """Sideways force on the trocar [N] at 1 N on the tip along unit vectors (n, 3), (n,).

    The shaft is a lever, supported by the trocar and held at its outer end without a moment, as by an arm without a
    mechanical remote centre. Moments about the outer end o, with the shaft's direction a, the tip x and the trocar t:
    N = |a x ((x - o) x f)| / (t - o).a; for a straight instrument and a sideways force that is (outer + inner length) /
    outer length. NaN for a shaft without a shape outside.
    """
    ends = chain.shape_ends[:, kinematics.shaft_index].reshape(len(chain.tip), -1, 3)
    if ends.shape[1] == 0:
        return np.full(len(chain.tip), np.nan)
    along = dot(ends - chain.near[:, None], chain.along[:, None])
    outer = np.min(along, axis=1)
    start = chain.near + outer[:, None] * chain.along
    moment = cross(chain.along, cross(chain.tip - start, directions))
    return np.where(outer < -1e-3, np.linalg.norm(moment, axis=1) / np.maximum(-outer, 1e-3), np.nan)


def camera_angle(chain: Chain, points: FloatArray, endoscope: FloatArray) -> FloatArray:
    """Angle between the shafts and the lines of sight from the endoscope's port (3,) to points (n, 3) [rad], (n,)."""
    sight = points - endoscope
    return np.arctan2(np.linalg.norm(cross(chain.along, sight), axis=1), dot(chain.along, sight))
