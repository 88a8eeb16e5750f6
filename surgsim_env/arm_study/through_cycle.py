"""Two arms on a patient who breathes: reach, clearance and following through the cycle; tables and a figure.

The organ goes with its ground, as at slow motion: its points and surface are displaced, its normals are not turned.
Ports, body wall and endoscope stay.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.arm_study.clearance import ClusteredSurface, Obstacles
from surgsim_env.arm_study.following import STEPS, Cycle, course, make_cycle, speeds_through_cycle
from surgsim_env.arm_study.joint_search import Wanted, search_joints
from surgsim_env.arm_study.kinematics import BatchKinematics
from surgsim_env.arm_study.pictures import BOTH, LEFT, RIGHT
from surgsim_env.arm_study.reach import (
    ARM_DISTANCE,
    BothArms,
    Reach,
    Sites,
    evaluate_both,
    evaluate_reach,
    pair_distances,
    ways,
)
from surgsim_env.arm_study.results import (
    SIDES,
    ArmsEvaluation,
    ArmThroughCycle,
    Tell,
    ThroughCycle,
    number_text,
    share_text,
)
from surgsim_env.palpation.surface_drawing import INK, PAPER, save_png
from surgsim_env.reports.html_page import Picture
from surgsim_env.reports.output_folder import AnyFolder
from surgsim_env.scene.anatomy import Anatomy

PICTURE_NAME = "cycle.png"


def evaluate_cycle(
    arms: tuple[Reach, Reach],
    both: BothArms,
    sites: Sites,
    around: tuple[Obstacles, Obstacles],
    anatomy: Anatomy,
    tell: Tell,
) -> ThroughCycle:
    """Both arms through the cycle of a scene with motions.

    Args:
        arms: reach of each with the organ at rest.
        both: what both reach at once then.
        sites: the points at rest.
        around: obstacles of each arm at rest.
        anatomy: of the scene.
        tell: called with the current work and the share of it that is done.
    """
    cycle, mesh = make_cycle(anatomy.scene.motions), anatomy.mesh
    shifts, nodes = (
        np.stack([one.shift(places) for one in anatomy.ground_motions]) for places in (sites.points, mesh.points)
    )
    count = len(cycle.signals)
    places, organs = [sites], [around[0].organ]
    reachable, together = [[one.report.reachable] for one in arms], [both]
    for number in range(1, count):
        signal = cycle.signals[number]
        places.append(replace(sites, points=sites.points + np.einsum("m,mni->ni", signal, shifts)))
        organs.append(ClusteredSurface(mesh.points + np.einsum("m,mni->ni", signal, nodes), mesh.boundary_triangles))
        found = []
        for side, arm, obstacles, rows in zip(SIDES, arms, around, reachable, strict=True):
            tell(f"the {side} arm at position {number + 1} of {count} of the cycle", (number - 1) / count)
            found.append(evaluate_reach(arm.kinematics, places[-1], replace(obstacles, organ=organs[-1])))
            rows.append(found[-1].report.reachable)
        together.append(evaluate_both(found[0], found[1], places[-1].points))
    followed = []
    for side, arm, obstacles, rows in zip(SIDES, arms, around, reachable, strict=True):
        tell(f"the {side} arm follows", (count - 1) / count)
        moved = [replace(obstacles, organ=organ) for organ in organs]
        followed.append(_followed(arm, cycle, places, moved, shifts, np.stack(rows)))
    kinematics = arms[0].kinematics, arms[1].kinematics
    moved = [tuple(replace(one, organ=organ) for one in around) for organ in organs]
    order = [cycle.main, *cycle.others]
    one = course(cycle.motions[cycle.main])
    motions = [cycle.motions[number] for number in order]
    return ThroughCycle(
        motions=tuple(one.name for one in motions),
        travel=np.array([cycle.motions[m].size[1] * np.linalg.norm(nodes[m], axis=1).max() for m in order]),
        period=np.array([one.period[0] for one in motions]),
        level=cycle.level[:, order],
        time=one.time,
        course=one.level,
        left=followed[0],
        right=followed[1],
        both=_together(kinematics, cycle, places, moved, together),
    )


def _followed(
    arm: Reach,
    cycle: Cycle,
    places: Sequence[Sites],
    around: Sequence[Obstacles],
    shifts: FloatArray,
    reachable: NDArray[np.bool_],
) -> ArmThroughCycle:
    """An arm along paths that begin at the reported joints, or where these end at an obstacle at other candidates."""
    kinematics, n_point = arm.kinematics, len(shifts[0])
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
    speed = np.full((n_point, kinematics.arm.joint_count), np.nan)
    shares = np.full(len(course(cycle.motions[cycle.main]).time), np.nan)
    if rows.size:
        for number, (sites, obstacles) in enumerate(zip(places, around, strict=True)):
            chain = kinematics.at(paths[number, rows])
            organ = obstacles.organ_clearance(kinematics, chain, exact=True)
            organ = np.where(sites.inner[rows], np.inf, organ)
            clearance[number, rows] = np.minimum(organ, obstacles.wall_clearance(kinematics, chain))
        alone = paths[: STEPS + 1, rows]
        speeds = speeds_through_cycle(kinematics, cycle, alone, shifts[:, rows])
        speed[rows] = speeds.max(axis=0)
        shares = (speeds / kinematics.arm.speed_limit).max(axis=(1, 2))
    return ArmThroughCycle(
        reachable=reachable,
        joints=paths,
        clearance=clearance,
        speed=speed,
        speed_share=shares,
        joint_names=tuple(kinematics.arm.joints),
        hinge=kinematics.hinge,
        speed_limit=kinematics.arm.speed_limit,
    )


def _path(
    kinematics: BatchKinematics,
    cycle: Cycle,
    places: Sequence[Sites],
    around: Sequence[Obstacles],
    rows: NDArray[np.integer],
    start: FloatArray,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Joints of some points (rows) from position to position (n_position, n, n_joint), and which keep all rules (n,).

    Each position begins at the joints of the one before: the search changes them as little as it needs.
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
    """Joints (n, n_joint) changed to follow some points (rows) to a position, and which keep all rules there (n,)."""
    found = search_joints(kinematics, Wanted(sites.tips(around.ball)[rows]), joints)
    chain = kinematics.at(found.joints)
    clear = sites.inner[rows] | (around.organ_clearance(kinematics, chain, exact=False) >= 0.0)
    return found.joints, found.met & clear & (around.wall_clearance(kinematics, chain) >= 0.0)


def _together(
    kinematics: tuple[BatchKinematics, BatchKinematics],
    cycle: Cycle,
    places: Sequence[Sites],
    around: Sequence[tuple[Obstacles, ...]],
    found: Sequence[BothArms],
) -> NDArray[np.bool_]:
    """Which points both reach at once at each position, (n_position, n).

    The search at a position tries few pairs of candidates. Where it finds none, that of the position before it, or
    after it, is followed here. At rest it is as found.
    """
    both = np.stack([one.reachable for one in found])
    pairs = [(one.joints[0].copy(), one.joints[1].copy()) for one in found]
    ahead = list(enumerate(cycle.before))[1:]
    back = [(before, number) for number, before in reversed(ahead) if before]
    for to, start in [*ahead, *back]:
        rows = np.flatnonzero(both[start] & ~both[to])
        if not rows.size:
            continue
        (left, left_good), (right, right_good) = (
            _next(arm, places[to], one, rows, joints[rows])
            for arm, one, joints in zip(kinematics, around[to], pairs[start], strict=True)
        )
        gaps = np.minimum(*pair_distances(kinematics, (left, right), places[to].points[rows]))
        good = left_good & right_good & (gaps >= ARM_DISTANCE)
        both[to, rows[good]] = True
        for joints, changed in zip(pairs[to], (left, right), strict=True):
            joints[rows[good]] = changed[good]
    return both


def cycle_clause(evaluation: ArmsEvaluation) -> str:
    """The patient's breathing in a sentence for a report's first paragraph; "" for a patient who holds still."""
    cycle, outer = evaluation.cycle, ~evaluation.inner
    if cycle is None:
        return ""
    (_, left), (_, right) = cycle.arms
    shares = [share_text(mask[outer]) for mask in (left.always, right.always, cycle.both_always)]
    follows = [share_text(arm.follows[outer]) for arm in (left, right)]
    return (
        f"Through the cycle of {_listed(cycle.motions)}, which moves the organ by up to "
        f"{_millimetres(cycle.travel.sum())}, the left arm reaches {shares[0]} of the points always, the right arm "
        f"{shares[1]}, and both at once {shares[2]}; the left arm can follow {follows[0]}, the right arm {follows[1]}."
    )


def cycle_summary(evaluation: ArmsEvaluation) -> dict[str, Any]:
    """The entry `cycle` of summary.json, SI units; empty for a patient who holds still."""
    cycle, outer = evaluation.cycle, ~evaluation.inner
    if cycle is None:
        return {}
    motions = zip(cycle.motions, cycle.travel, cycle.period, strict=True)
    return {
        "cycle": {
            "motions": [{"name": name, "travel_m": travel, "period_s": period} for name, travel, period in motions],
            "level": cycle.level,
            **{side: _arm_summary(arm, outer) for side, arm in cycle.arms},
            "both": _reach_summary(cycle.both[:, outer]),
            "time_s": cycle.time,
            "course": cycle.course,
        }
    }


def _reach_summary(reachable: NDArray[np.bool_]) -> dict[str, Any]:
    share = reachable.mean(axis=1)
    return {"share": share, "median": float(np.median(share)), "always": float(reachable.all(axis=0).mean())}


def _arm_summary(arm: ArmThroughCycle, outer: NDArray[np.bool_]) -> dict[str, Any]:
    joint, share = arm.limiting
    fastest = _greatest(arm.speed)
    return {
        "reachable": _reach_summary(arm.reachable[:, outer]),
        "has_path": float(arm.has_path[outer].mean()),
        "follows": float(arm.follows[outer].mean()),
        "path_clearance": _worst_and_median(arm.clearance[:, outer]),
        "limiting_joint": joint,
        "speed_share": share,
        "speed_share_over_time": arm.speed_share,
        "joints": [
            {"name": name, "speed": speed, "speed_limit": limit}
            for name, speed, limit in zip(arm.joint_names, fastest, arm.speed_limit, strict=True)
        ],
    }


def _worst_and_median(values: FloatArray) -> dict[str, float]:
    """The least of all points and positions; the median over the points of each one's least, and of its median."""
    known = values[:, np.isfinite(values).all(axis=0)]
    if not known.size:
        return dict.fromkeys(("worst", "median_of_worst", "median"), math.nan)
    each = known.min(axis=0)
    return {
        "worst": float(each.min()),
        "median_of_worst": float(np.median(each)),
        "median": float(np.median(np.median(known, axis=0))),
    }


def _greatest(values: FloatArray) -> FloatArray:
    """The largest of each joint over the points that have a path, (n_joint,); NaN where none has."""
    known = values[np.isfinite(values).all(axis=1)]
    return known.max(axis=0) if len(known) else np.full(values.shape[1], np.nan)


def cycle_section(evaluation: ArmsEvaluation, picture: Sequence[Picture]) -> dict[str, Any] | None:
    """Contents of the report's section on the cycle; None for a patient who holds still."""
    cycle, outer = evaluation.cycle, ~evaluation.inner
    if cycle is None:
        return None
    parts = [
        f"{name} by up to {_millimetres(travel)} in cycles of {period:.2g} s"
        for name, travel, period in zip(cycle.motions, cycle.travel, cycle.period, strict=True)
    ]
    return {
        "motions": ", ".join(parts),
        "positions": len(cycle.level),
        "reach": _reach_rows(cycle, outer),
        "clearance": _clearance_rows(cycle, outer),
        "joints": _joint_rows(cycle),
        "pictures": picture,
    }


def _reach_rows(cycle: ThroughCycle, outer: NDArray[np.bool_]) -> list[tuple[str, ...]]:
    """Shares of points at rest, median and least over the positions, at every position, and followed."""
    rows = [(f"{side} arm", arm.reachable, _per_cent(float(arm.follows[outer].mean()))) for side, arm in cycle.arms]
    rows.append(("both at once", cycle.both, ""))
    texts = []
    for name, reachable, follows in rows:
        each = reachable[:, outer]
        share = each.mean(axis=1)
        figures = (share[0], float(np.median(share)), float(share.min()), float(each.all(axis=0).mean()))
        texts.append((name, *map(_per_cent, figures), follows))
    return texts


def _clearance_rows(cycle: ThroughCycle, outer: NDArray[np.bool_]) -> list[tuple[str, ...]]:
    rows = []
    for side, arm in cycle.arms:
        found = _worst_and_median(arm.clearance[:, outer])
        rows.append((f"{side} arm: clearance [mm]", *(number_text(one, 1e3, 2) for one in found.values())))
    return rows


def _joint_rows(cycle: ThroughCycle) -> list[tuple[str, ...]]:
    rows = []
    for side, arm in cycle.arms:
        for index, speed in enumerate(_greatest(arm.speed)):
            unit, limit = "rad/s" if arm.hinge[index] else "m/s", arm.speed_limit[index]
            figures = f"{number_text(speed, 1.0, 3)} {unit}", f"{limit:g} {unit}", _per_cent(speed / limit)
            rows.append((f"{side} arm: {arm.joint_names[index]}", *figures))
    return rows


def draw_cycle(evaluation: ArmsEvaluation, folder: AnyFolder) -> list[Picture]:
    """The figure through the cycle; none for a patient who holds still.

    Between positions figures are interpolated along the main motion; the others are at rest, but count in the speeds.
    """
    from matplotlib.figure import Figure

    cycle, outer = evaluation.cycle, ~evaluation.inner
    if cycle is None:
        return []
    alone = cycle.alone
    at = np.interp(cycle.course, cycle.level[alone, 0], np.arange(alone.sum()))

    def over_time(values: FloatArray) -> FloatArray:
        return np.interp(at, np.arange(alone.sum()), values[alone])

    figure = Figure(figsize=(9.0, 9.6), dpi=100, facecolor=PAPER, layout="constrained")
    travel, reach, gap, speed = figure.subplots(4, 1, sharex=True, height_ratios=(0.6, 1.0, 1.0, 1.0))
    travel.plot(cycle.time, 1e3 * cycle.travel[0] * cycle.course, color=INK)
    travel.set_ylabel(f"{cycle.motions[0]}\n[mm]")
    for name, reachable, colour in (
        ("left arm", cycle.left.reachable, LEFT),
        ("right arm", cycle.right.reachable, RIGHT),
        ("both at once", cycle.both, BOTH),
    ):
        style = "--" if name == "right arm" else "-"
        reach.plot(cycle.time, 100.0 * over_time(reachable[:, outer].mean(axis=1)), style, color=colour, label=name)
    reach.set_ylabel("points reached [%]")
    for (side, arm), colour in zip(cycle.arms, (LEFT, RIGHT), strict=True):
        known = arm.clearance[:, outer & arm.has_path]
        if known.size:
            gap.plot(cycle.time, 1e3 * over_time(np.median(known, axis=1)), color=colour, label=f"{side} arm, median")
            gap.plot(cycle.time, 1e3 * over_time(known.min(axis=1)), ":", color=colour, label=f"{side} arm, smallest")
            speed.plot(cycle.time, 100.0 * arm.speed_share, color=colour, label=f"{side} arm: {arm.limiting[0]} limits")
    gap.set_ylabel("clearance on the paths\n[mm]")
    speed.set_ylabel("quickest joint\n[% of its limit]")
    speed.set_xlabel("time in the cycle [s]")
    for axes in (travel, reach, gap, speed):
        axes.grid(alpha=0.3)
        axes.set_ylim(bottom=0.0)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=9, frameon=False)
    reach.set_ylim(0.0, 104.0)
    figure.suptitle(f"through a cycle of {_listed(cycle.motions)}", fontsize=12, color=INK)
    save_png(figure, folder / PICTURE_NAME)
    others = _listed(cycle.motions[1:])
    beside = f" With {others} at rest, except that the speeds contain its largest." if others else ""
    return [
        Picture.of_file(
            folder / PICTURE_NAME,
            f"Over a cycle of {cycle.motions[0]}",
            f"Displacement by {cycle.motions[0]}; share of the surface's points that are reached; clearance from organ "
            "and wall over the points for which an arm has a path; largest speed of any joint over these points as a "
            f"share of its limit.{beside}",
        )
    ]


def _listed(names: Sequence[str]) -> str:
    return " and ".join(names)


def _millimetres(value: float) -> str:
    return number_text(value, 1e3, 1, "mm")


def _per_cent(share: float) -> str:
    return number_text(share, 100.0, 0, "%")
