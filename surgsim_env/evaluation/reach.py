"""Which points one arm reaches, why not, and how well it stands there."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray, IntArray
from surgsim_env.evaluation import dexterity
from surgsim_env.evaluation.approach import approach_directions, approach_share
from surgsim_env.evaluation.arm_results import ArmReach
from surgsim_env.evaluation.candidates import (
    REACHED,
    Candidates,
    from_directions,
    from_neighbours,
    from_starts,
    spread_starts,
    still_open,
)
from surgsim_env.evaluation.collisions import Surroundings
from surgsim_env.evaluation.kinematics import BatchKinematics

# How many candidates are put in place at once.
CANDIDATES_AT_ONCE = 20_000


@dataclass(frozen=True)
class Sites:
    """Where the arms shall come: points and outward normals (n, 3) [m], and which lie inside the organ (n,)."""

    points: FloatArray
    normals: FloatArray
    inner: NDArray[np.bool_]

    def tips(self, ball: float) -> FloatArray:
        """Where the tip is when its ball [m] touches the surface; at an inner target, the target itself."""
        return self.points + np.where(self.inner, 0.0, ball)[:, None] * self.normals


@dataclass(frozen=True)
class Reach:
    """What an arm's report says, and all that it found: candidates and which of them keep every rule (n, k)."""

    report: ArmReach
    kinematics: BatchKinematics
    candidates: Candidates
    usable: NDArray[np.bool_]


def tip_ball(kinematics: BatchKinematics) -> float:
    """Radius of the ball that the tip lies in the middle of [m], 0 if it has none."""
    arm = kinematics.arm
    name = arm.description.tip.ball
    if name is None:
        return 0.0
    geom = arm.model.geom(name)
    same_body = geom.bodyid[0] == arm.model.site_bodyid[arm.tip_site]
    centred = np.linalg.norm(geom.pos - arm.model.site_pos[arm.tip_site]) < 1e-6
    return float(geom.size[0]) if same_body and centred else 0.0


def evaluate_reach(kinematics: BatchKinematics, sites: Sites, around: Surroundings) -> Reach:
    """Everything about one arm at every site.

    A point is reached if among the candidates from all starts, directions and neighbours one puts the tip within 1 mm
    of it, keeps limits and trocar and clears organ and wall. The arm stands as the one furthest from its limits does.
    """
    tips = sites.tips(around.ball)
    ports = around.ports
    directions = approach_directions(
        sites.normals,
        np.array(ports.endoscope.point) - sites.points,
        np.array(ports.right.point) - np.array(ports.left.point),
    )
    found = from_neighbours(kinematics, tips, from_starts(kinematics, tips, spread_starts(kinematics)))
    clear = _clear(kinematics, found, sites, around)
    some = found.met.any(axis=1)
    if some.any():
        more, more_clear = _all_around(kinematics, tips, directions, found, clear, some, sites, around)
        found, clear = more, more_clear
    usable = clear.all(axis=0)
    reason = _reasons(kinematics, tips, found, clear)
    report = _report(kinematics, sites, around, found, usable, reason, directions)
    return Reach(report, kinematics, found, usable)


def _all_around(
    kinematics: BatchKinematics,
    tips: FloatArray,
    directions: FloatArray,
    found: Candidates,
    clear: NDArray[np.bool_],
    some: NDArray[np.bool_],
    sites: Sites,
    around: Surroundings,
) -> tuple[Candidates, NDArray[np.bool_]]:
    """Candidates from every direction, twice: from any that meets the point, then from those that keep every rule."""
    for usable in (found.met, None):
        begin = clear.all(axis=0) if usable is None else usable
        # Where none keeps every rule, the second round too begins at what meets the point.
        begin = np.where(begin.any(axis=1)[:, None], begin, found.met)
        more = _empty_like(found, directions.shape[1])
        rows = np.flatnonzero(some & still_open(directions, found, clear.all(axis=0)).any(axis=1))
        if rows.size:
            part = from_directions(kinematics, tips[rows], directions[rows], _rows(found, rows), begin[rows])
            for name in vars(more):
                getattr(more, name)[rows] = getattr(part, name)
        clear = np.concatenate([clear, _clear(kinematics, more, sites, around)], axis=2)
        found = found.add(more)
    return found, clear


def _rows(found: Candidates, rows: NDArray) -> Candidates:
    return Candidates(*(values[rows] for values in vars(found).values()))


def _empty_like(found: Candidates, count: int) -> Candidates:
    """Candidates that meet nothing."""
    points, _, joints = found.joints.shape
    errors = np.full((points, count), np.inf)
    return Candidates(np.zeros((points, count, joints)), errors, errors.copy(), np.zeros((points, count, 3)))


def _clear(
    kinematics: BatchKinematics, found: Candidates, sites: Sites, around: Surroundings
) -> NDArray[np.bool_]:
    """Which candidates meet their point, and besides clear the organ, and the wall: (3, n, k)."""
    result = np.zeros((3, *found.met.shape), dtype=bool)
    result[0] = found.met
    points, places = np.nonzero(found.met)
    for low in range(0, len(points), CANDIDATES_AT_ONCE):
        part = slice(low, low + CANDIDATES_AT_ONCE)
        chain = kinematics.at(found.joints[points[part], places[part]])
        off_organ = around.organ_clearance(kinematics, chain, exact=False) >= 0.0
        result[1, points[part], places[part]] = off_organ | sites.inner[points[part]]
        result[2, points[part], places[part]] = around.wall_clearance(kinematics, chain) >= 0.0
    return result


def _reasons(
    kinematics: BatchKinematics, tips: FloatArray, found: Candidates, clear: NDArray[np.bool_]
) -> IntArray:
    """Index into REASONS of each point: the first test that no candidate passes, (n,)."""
    reason = np.where(clear[:2].all(axis=0).any(axis=1), 5, 4)
    reason[clear.all(axis=0).any(axis=1)] = 0
    lost = np.flatnonzero(~clear[0].any(axis=1))
    if lost.size:
        starts = spread_starts(kinematics)
        best = np.argmin(found.position_error[lost] + found.trocar_error[lost], axis=1)
        own = np.concatenate(
            [np.broadcast_to(starts, (lost.size, *starts.shape)), found.joints[lost, best][:, None]], axis=1
        )
        reason[lost] = 1
        free = from_starts(kinematics, tips[lost], own, limits=False, trocar=False)
        reason[lost[(free.position_error <= REACHED).any(axis=1)]] = 2
        held = from_starts(kinematics, tips[lost], own, trocar=False)
        reason[lost[(held.position_error <= REACHED).any(axis=1)]] = 3
    return reason.astype(np.int32)


def _report(
    kinematics: BatchKinematics,
    sites: Sites,
    around: Surroundings,
    found: Candidates,
    usable: NDArray[np.bool_],
    reason: IntArray,
    directions: FloatArray,
) -> ArmReach:
    rows, good = np.arange(len(reason)), reason == 0
    worth = np.where(usable, dexterity.limit_margin(kinematics, found.joints), -np.inf)
    nearest = np.argmin(found.position_error + found.trocar_error, axis=1)
    best = np.where(good, worth.argmax(axis=1), nearest)
    joints = found.joints[rows, best]
    chain = kinematics.at(joints)
    values = dexterity.scaled_singular_values(kinematics, chain)
    organ = np.full(len(rows), np.nan)
    outer = np.flatnonzero(good & ~sites.inner)
    if outer.size:
        organ[outer] = around.organ_clearance(kinematics, kinematics.at(joints[outer]), exact=True)

    def where_reached(quantity: FloatArray) -> FloatArray:
        return np.where(good & np.isfinite(quantity), quantity, np.nan)

    return ArmReach(
        name=kinematics.arm.description.name,
        reason=reason,
        joints=joints,
        position_error=found.position_error[rows, best],
        approach_share=where_reached(approach_share(found.pointing, usable, directions)),
        manipulability=where_reached(dexterity.manipulability(values)),
        isotropy=where_reached(dexterity.isotropy(values)),
        limit_margin=where_reached(dexterity.limit_margin(kinematics, joints)),
        tip_force=where_reached(dexterity.tip_force(kinematics, chain, -sites.normals)),
        trocar_load=where_reached(dexterity.trocar_load(kinematics, chain, -sites.normals)),
        camera_angle=where_reached(dexterity.camera_angle(chain, sites.points, np.array(around.ports.endoscope.point))),
        organ_clearance=organ,
        wall_clearance=where_reached(around.wall_clearance(kinematics, chain)),
        trocar_error=where_reached(kinematics.trocar_error(chain)),
    )
