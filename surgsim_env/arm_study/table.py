"""Evaluated arms as tables: points.csv, and the ranking of several placements or robots with reasons in words."""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from surgsim_env.arm_study.results import (
    DISTANCES,
    QUANTITIES,
    REASONS,
    ArmReach,
    ArmsEvaluation,
    Quantity,
    clearances,
    extreme,
    number_text,
    sides,
    spread,
    surface_shares,
    worst_clearance,
)

RANKING_RULE = (
    "Ranked by the share of the surface's points that both arms reach at once, in whole per cent, the largest first; "
    "equal shares by the share that either reaches, then by the median clearance from organ and body wall in whole "
    "millimetres, then by the smallest tip force in tenths of a newton, always the largest first; then as given."
)


@dataclass(frozen=True)
class Column:
    """A column of points.csv: its name, which ends with the SI unit, and its meaning."""

    name: str
    meaning: str


@dataclass(frozen=True)
class Candidate:
    """A placement or robot in a comparison.

    Fields:
        name: as the table shows it
        what: description in a few words
        evaluation: its evaluation
    """

    name: str
    what: str
    evaluation: ArmsEvaluation


@dataclass(frozen=True)
class Ranked:
    """A row of the ranking; shares 0 to 1, median clearance [m], smallest force [N], NaN where nothing is reached."""

    place: int
    name: str
    what: str
    left: float
    right: float
    both: float
    either: float
    clearance: float
    worst_clearance: float
    force: float
    reasons: str


def columns(evaluation: ArmsEvaluation) -> list[Column]:
    """The columns of points.csv."""
    listed = [Column("point", "number of the point, from 0")]
    for axis in "xyz":
        listed.append(Column(f"{axis}_m", f"{axis} of the point in the scene's frame"))
    for axis in "xyz":
        listed.append(Column(f"normal_{axis}", f"{axis} of the outward normal there"))
    listed.append(Column("inner", "1 for a target inside the organ, 0 on its surface"))
    for side, arm in sides(evaluation):
        listed.append(Column(f"{side}_reachable", f"1 where the {side} arm reaches the point, else 0"))
        listed.append(Column(f"{side}_reason", f"why not: one of {'; '.join(REASONS[1:])}"))
        for quantity in QUANTITIES:
            listed.append(Column(f"{side}_{quantity.field}{quantity.si}", f"{side} arm: {_meaning(quantity)}"))
        for number in range(arm.joints.shape[1]):
            listed.append(
                Column(f"{side}_joint_{number}", f"{side} arm: value of joint {number}, base to tip, rad or m")
            )
    listed.append(Column("both", "1 where both arms reach the point at once, else 0"))
    listed.extend(Column(f"{field}_m", title) for field, title, _ in DISTANCES)
    return listed


def write_points(evaluation: ArmsEvaluation, path: Path) -> None:
    """One line for each point, in SI units; empty where there is no value."""
    header = [column.name for column in columns(evaluation)]
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        for index in range(len(evaluation.points)):
            row = [str(index), *map(_cell, (*evaluation.points[index], *evaluation.normals[index]))]
            row.append(str(int(evaluation.inner[index])))
            for _, arm in sides(evaluation):
                row.extend(_arm_cells(arm, index))
            row.append(str(int(evaluation.both[index])))
            row.extend(_cell(getattr(evaluation, field)[index]) for field, _, _ in DISTANCES)
            writer.writerow(row)


def rank(candidates: Sequence[Candidate]) -> list[Ranked]:
    """The candidates in the order of RANKING_RULE, each with its differences from the best (for the best, the next)."""
    rows = [_row(one) for one in candidates]
    order = sorted(range(len(rows)), key=lambda index: (_rank_key(rows[index]), index))
    ordered = [rows[index] for index in order]
    ranked = []
    for place, row in enumerate(ordered):
        other = ordered[0] if place else (ordered[1] if len(ordered) > 1 else None)
        reasons = "" if other is None else _reasons(row, other)
        ranked.append(replace(row, place=place + 1, reasons=reasons))
    return ranked


def _row(candidate: Candidate) -> Ranked:
    evaluation = candidate.evaluation
    left, right, both = surface_shares(evaluation)
    either = float((evaluation.left.reachable | evaluation.right.reachable)[~evaluation.inner].mean())
    usual, (worst, _) = spread(clearances(evaluation)).median, worst_clearance(evaluation)
    force = extreme(evaluation, "tip_force").value
    return Ranked(0, candidate.name, candidate.what, left, right, both, either, usual, worst.value, force, "")


def _rank_key(row: Ranked) -> tuple[float, ...]:
    return -_per_cent(row.both), -_per_cent(row.either), -_whole(row.clearance, 1e3), -_whole(row.force, 10.0)


def _per_cent(share: float) -> int:
    return round(100.0 * share)


def _whole(value: float, scale: float) -> float:
    return round(value * scale) if math.isfinite(value) else -math.inf


def _reasons(row: Ranked, other: Ranked) -> str:
    """`reaches 12 % more of the points with both arms; 4 mm more median clearance`; equal figures are left out."""
    shares = []
    for share, title in (
        ("both", "both arms"),
        ("either", "either arm"),
        ("left", "the left arm"),
        ("right", "the right arm"),
    ):
        difference = _per_cent(getattr(row, share)) - _per_cent(getattr(other, share))
        # The share of either arm counts only where the shares of both are equal.
        if difference and not (share == "either" and shares):
            more = "more" if difference > 0 else "fewer"
            shares.append(f"{abs(difference)} % {more}{'' if shares else ' of the points'} with {title}")
    parts = [f"reaches {', '.join(shares)}"] if shares else []
    for field, scale, digits, unit, title in (
        ("clearance", 1e3, 0, "mm", "median clearance"),
        ("force", 1.0, 1, "N", "smallest tip force"),
    ):
        mine, theirs = getattr(row, field), getattr(other, field)
        if math.isfinite(mine) and math.isfinite(theirs):
            difference = round(mine * scale, digits) - round(theirs * scale, digits)
            if abs(difference) > 1e-9:
                more = "more" if difference > 0 else "less"
                parts.append(f"{number_text(abs(difference), 1.0, digits, unit)} {more} {title}")
    return f"against {other.name}: {'; '.join(parts)}" if parts else f"the same as {other.name} in these figures"


def _meaning(quantity: Quantity) -> str:
    return f"{quantity.title}, {quantity.si.lstrip('_')}" if quantity.si else f"{quantity.title}, a pure number"


def _arm_cells(arm: ArmReach, index: int) -> list[str]:
    reached = bool(arm.reachable[index])
    values = [getattr(arm, quantity.field)[index] for quantity in QUANTITIES]
    cells = [str(int(reached)), "" if reached else REASONS[arm.reason[index]]]
    return [*cells, *map(_cell, values), *map(_cell, arm.joints[index])]


def _cell(value: float) -> str:
    return "" if np.isnan(value) else f"{float(value):.9g}"
