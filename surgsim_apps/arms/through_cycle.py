"""Two arms on a breathing patient: reach, paths and clearance through the cycle.

The organ follows its ground quasistatically: its points and surface are displaced, its normals are not turned. Ports,
body wall and endoscope stay.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from surgsim_apps.arms.clearance import ClusteredSurface, Obstacles
from surgsim_apps.arms.joint_search import Wanted, search_joints
from surgsim_apps.arms.kinematics import BatchKinematics
from surgsim_apps.arms.reach import (
    ARM_DISTANCE,
    BothArms,
    Reach,
    Sites,
    evaluate_both,
    evaluate_reach,
    pair_distances,
    ways,
)
from surgsim_apps.arms.results import ArmThroughCycle, ThroughCycle
from surgsim_env.scene import Anatomy, CyclicMotion
from surgsim_env.step_progress import StepProgress

# Evenly spaced positions between rest and top of the organ's largest motion.
STEPS = 5


@dataclass(frozen=True)
class Cycle:
    """Evaluated positions of an organ, each motion in its largest cycle.

    From rest to the top of the organ's largest motion in even steps, the others at rest; then, if there are others,
    rest and top again with all others at their tops.

    Fields:
        motions: of the scene
        main: index of the organ's largest motion
        level: share of each motion's top at each position                   (n_position, n_motion)
        before: the arm's previous position of each; the first has none
    """

    motions: tuple[CyclicMotion, ...]
    main: int
    level: FloatArray
    before: tuple[int, ...]

    @property
    def signals(self) -> FloatArray:
        """Signals of the motions at each position, (n_position, n_motion)."""
        return self.level * np.array([motion.size[1] for motion in self.motions])


def make_cycle(motions: Sequence[CyclicMotion]) -> Cycle:
    """The positions of an organ with at least one motion."""
    main = int(np.argmax([math.hypot(*motion.displacement) * motion.size[1] for motion in motions]))
    alone = np.arange(len(motions)) == main
    level = np.linspace(0.0, 1.0, STEPS + 1)[:, None] * alone
    before = [max(number - 1, 0) for number in range(STEPS + 1)]
    if len(motions) > 1:
        level = np.concatenate([level, [~alone, np.ones(len(motions))]])
        before += [0, STEPS]
    return Cycle(tuple(motions), main, level, tuple(before))


def extreme_signals(motions: Sequence[CyclicMotion]) -> FloatArray:
    """Signals at rest, at the top of the largest motion, and at the tops of all, (n_position, n_motion)."""
    if not motions:
        return np.zeros((1, 0))
    signals = make_cycle(motions).signals
    return signals[[0, STEPS, -1]] if len(motions) > 1 else signals[[0, STEPS]]


def moved_organ(anatomy: Anatomy, sites: Sites, signals: FloatArray) -> Iterator[tuple[Sites, FloatArray]]:
    """Points of the organ and nodes (n_node, 3) [m] at each position, by signals (n_position, n_motion)."""
    nodes = anatomy.mesh.points
    shifts = [(motion.shift(sites.points), motion.shift(nodes)) for motion in anatomy.ground_motions]
    for signal in signals:
        moved = [rest.copy() for rest in (sites.points, nodes)]
        for share, parts in zip(signal, shifts, strict=True):
            for points, shift in zip(moved, parts, strict=True):
                points += share * shift
        yield replace(sites, points=moved[0]), moved[1]


def evaluate_cycle(
    arms: tuple[Reach, Reach],
    both: BothArms,
    sites: Sites,
    around: tuple[Obstacles, Obstacles],
    anatomy: Anatomy,
    progress: StepProgress,
) -> ThroughCycle:
    """Both arms through the cycle of a scene with motions.

    Args:
        arms: reach of each with the organ at rest.
        both: reach of both at once then.
        sites: the points at rest.
        around: obstacles of each arm at rest.
        anatomy: of the scene.
        progress: shows the steps.
    """
    cycle, mesh = make_cycle(anatomy.scene.motions), anatomy.mesh
    nodes = [motion.shift(mesh.points) for motion in anatomy.ground_motions]
    count = len(cycle.signals)
    places, organs = [sites], [around[0].organ]
    reachable, together = [[arm.report.reachable] for arm in arms], [both]
    with progress.step("both arms through the cycle", 2 * count) as advance:
        for place, moved_nodes in moved_organ(anatomy, sites, cycle.signals[1:]):
            places.append(place)
            organs.append(ClusteredSurface(moved_nodes, mesh.boundary_triangles))
            reaches = []
            for arm, obstacles, rows in zip(arms, around, reachable, strict=True):
                reaches.append(evaluate_reach(arm.kinematics, places[-1], replace(obstacles, organ=organs[-1])))
                rows.append(reaches[-1].report.reachable)
                advance(1)
            together.append(evaluate_both(reaches[0], reaches[1], places[-1].points))
        followed = []
        for arm, obstacles, rows in zip(arms, around, reachable, strict=True):
            moved = [replace(obstacles, organ=organ) for organ in organs]
            followed.append(_followed(arm, cycle, places, moved, np.stack(rows)))
            advance(1)
    kinematics = arms[0].kinematics, arms[1].kinematics
    moved = [tuple(replace(obstacles, organ=organ) for obstacles in around) for organ in organs]
    order = [cycle.main, *(m for m in range(len(cycle.motions)) if m != cycle.main)]
    motions = [cycle.motions[number] for number in order]
    return ThroughCycle(
        motions=tuple(motion.name for motion in motions),
        travel=np.array([cycle.motions[m].size[1] * np.linalg.norm(nodes[m], axis=1).max() for m in order]),
        period=np.array([motion.period[0] for motion in motions]),
        left=followed[0],
        right=followed[1],
        both=_together(kinematics, cycle, places, moved, together),
    )


def _followed(
    arm: Reach,
    cycle: Cycle,
    places: Sequence[Sites],
    around: Sequence[Obstacles],
    reachable: NDArray[np.bool_],
) -> ArmThroughCycle:
    """An arm along paths from the reported joints, or from other candidates if these meet an obstacle."""
    kinematics, n_point = arm.kinematics, reachable.shape[1]
    paths = np.full((len(places), n_point, kinematics.arm.joint_count), np.nan)
    rows = np.flatnonzero(arm.report.reachable)
    starts = [arm.report.joints[rows], *np.swapaxes(ways(arm, rows), 0, 1)] if rows.size else []
    for start in starts:
        left = np.isnan(paths[0, rows, 0])
        if not left.any():
            break
        path, kept = _path(kinematics, cycle, places, around, rows[left], start[left])
        paths[:, rows[left][kept]] = path[:, kept]
    rows = np.flatnonzero(~np.isnan(paths[0, :, 0]))
    clearance = np.full((len(places), n_point), np.nan)
    if rows.size:
        for number, (sites, obstacles) in enumerate(zip(places, around, strict=True)):
            chain = kinematics.at(paths[number, rows])
            organ = obstacles.organ_clearance(kinematics, chain)
            organ = np.where(sites.inner[rows], np.inf, organ)
            clearance[number, rows] = np.minimum(organ, obstacles.wall_clearance(kinematics, chain))
    return ArmThroughCycle(reachable, paths, clearance)


def _path(
    kinematics: BatchKinematics,
    cycle: Cycle,
    places: Sequence[Sites],
    around: Sequence[Obstacles],
    rows: NDArray[np.integer],
    start: FloatArray,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Paths of some points (rows) in joint space (n_position, n, n_joint), and a mask of those within all rules (n,).

    Each position begins at the joints of the previous one: the search changes them as little as it needs.
    """
    path, kept = np.zeros((len(places), *start.shape)), np.ones(len(rows), dtype=bool)
    path[0] = start
    for number, before in list(enumerate(cycle.before))[1:]:
        path[number], good = _next(kinematics, places[number], around[number], rows, path[before])
        kept &= good
    return path, kept


def _next(
    kinematics: BatchKinematics, sites: Sites, around: Obstacles, rows: NDArray[np.integer], joints: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Joints (n, n_joint) that follow some points (rows) to a position, and a mask of those within all rules (n,)."""
    candidates = search_joints(kinematics, Wanted(sites.tips(around.ball)[rows]), joints)
    chain = kinematics.at(candidates.joints)
    clear = sites.inner[rows] | around.clears_organ(kinematics, chain)
    clear &= (around.wall_clearance(kinematics, chain) >= 0.0) & around.clears_others(kinematics, chain.shape_ends)
    return candidates.joints, candidates.met & clear


def _together(
    kinematics: tuple[BatchKinematics, BatchKinematics],
    cycle: Cycle,
    places: Sequence[Sites],
    around: Sequence[tuple[Obstacles, ...]],
    together: Sequence[BothArms],
) -> NDArray[np.bool_]:
    """Mask of points in reach of both at once at each position, (n_position, n).

    The search at a position tries few pairs of candidates. If it fails, the pair of the previous or the next position
    is followed here. The result at rest stays.
    """
    both = np.stack([result.reachable for result in together])
    pairs = [(result.joints[0].copy(), result.joints[1].copy()) for result in together]
    ahead = list(enumerate(cycle.before))[1:]
    back = [(before, number) for number, before in reversed(ahead) if before]
    for to, start in [*ahead, *back]:
        rows = np.flatnonzero(both[start] & ~both[to])
        if not rows.size:
            continue
        (left, left_good), (right, right_good) = (
            _next(arm, places[to], obstacles, rows, joints[rows])
            for arm, obstacles, joints in zip(kinematics, around[to], pairs[start], strict=True)
        )
        gaps = np.minimum(*pair_distances(kinematics, (left, right), places[to].points[rows]))
        good = left_good & right_good & (gaps >= ARM_DISTANCE)
        both[to, rows[good]] = True
        for joints, changed in zip(pairs[to], (left, right), strict=True):
            joints[rows[good]] = changed[good]
    return both
