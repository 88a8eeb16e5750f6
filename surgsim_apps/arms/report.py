"""The report of an evaluation of two arms."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from surgsim_apps.arms.quantities import DISTANCES, QUANTITIES, spread
from surgsim_apps.arms.ranking import RANKING_RULE, Ranked
from surgsim_apps.arms.reach_kinds import PORT_COLOURS, REACH_KINDS
from surgsim_apps.arms.results import REASONS, ArmsEvaluation, PortsFound, ThroughCycle
from surgsim_apps.arms.wording import number_text, share_text, verdict
from surgsim_apps.reports.html_page import Picture, render_page

Rows = list[tuple[str, ...]]


def write_report(
    evaluation: ArmsEvaluation,
    path: Path,
    *,
    maps: Sequence[Picture],
    command: str,
    ranking: Sequence[Ranked] = (),
) -> None:
    """Write the report.

    Args:
        evaluation: of both arms.
        path: of the file.
        maps: heat maps.
        command: the command line that repeats this report.
        ranking: of several placements or robots; left out if empty.
    """
    page = render_page(
        "arms.html.j2",
        title=f"Two arms on {evaluation.scene}: {evaluation.left.name} (left) and {evaluation.right.name} (right)",
        verdict=verdict(evaluation),
        ranking=ranking,
        ranking_rule=RANKING_RULE,
        number_text=number_text,
        scene=evaluation.turning,
        maps=maps,
        colours={**PORT_COLOURS, "both": REACH_KINDS[0].colour},
        has_targets=evaluation.inner.any(),
        shares=_shares(evaluation),
        values=_values(evaluation),
        distances=[(title, *_spread_texts(getattr(evaluation, field), 1e3, 1)) for field, title, _ in DISTANCES],
        reasons=_reasons(evaluation),
        with_errors=_with_errors(evaluation),
        cycle=cycle_section(evaluation),
        ports=_ports(evaluation),
        search=_search(evaluation.search),
        definitions=_definitions(),
        command=command,
    )
    path.write_text(page, encoding="utf-8", newline="\n")


def _ports(evaluation: ArmsEvaluation) -> Rows:
    """Places of the ports for the theatre [mm]: coordinates, distances from the given port and the other ports."""
    rows, frames = [], evaluation.ports
    given = None if evaluation.search is None else evaluation.search.given.ports.frames
    for name, port in frames.items():
        others = [math.dist(port.point, other.point) for key, other in frames.items() if key != name]
        moved = "–" if given is None else number_text(math.dist(port.point, given[name].point), 1e3, 0)
        places = [number_text(value, 1e3, 0) for value in port.point]
        rows.append((name, *places, moved, *(number_text(value, 1e3, 0) for value in others)))
    return rows


def _search(search: PortsFound | None) -> dict[str, Any] | None:
    """Contents of the report on a search for ports; None without one."""
    if search is None:
        return None
    rows = [("given", search.given), ("found", search.best)]
    rows += [(f"front {number}", placement) for number, placement in enumerate(search.front, start=1)]
    return {
        "count": search.count,
        "bases": [*search.arms],
        "gains": {side: _per_cent(share) for side, share in search.gains.items()},
        "rows": [
            (
                name,
                _per_cent(placement.share),
                number_text(placement.clearance, 1e3, 1),
                number_text(placement.dexterity, 1.0, 3),
            )
            for name, placement in rows
        ],
    }


def _shares(evaluation: ArmsEvaluation) -> Rows:
    """Shares of points in reach of the left arm, the right arm and both at once."""
    groups = [("on the surface", ~evaluation.inner), ("inside the organ", evaluation.inner)]
    masks = [evaluation.left.reachable, evaluation.right.reachable, evaluation.both]
    return [
        (f"{name} ({int(group.sum())} points)", *(share_text(mask[group]) for mask in masks))
        for name, group in groups
        if group.any()
    ]


def _values(evaluation: ArmsEvaluation) -> list[tuple[str, list[tuple[str, ...]]]]:
    """Least, median and greatest of each quantity for each arm, and for the worse arm at points that both reach."""
    rows = []
    for quantity in QUANTITIES:
        groups = [*map(quantity.values, evaluation.arms.values()), quantity.worse_of_both(evaluation)]
        rows.append((quantity.label, [_spread_texts(values, quantity.scale, quantity.digits) for values in groups]))
    return rows


def _spread_texts(values: FloatArray, scale: float, digits: int | None) -> tuple[str, ...]:
    return tuple(number_text(value, scale, digits) for value in spread(values))


def _reasons(evaluation: ArmsEvaluation) -> Rows:
    """Numbers and shares of points by their reason, for both arms."""
    rows = []
    for index, reason in enumerate(REASONS):
        masks = [arm.reason == index for arm in evaluation.arms.values()]
        rows.append((reason, *(f"{int(mask.sum())} ({share_text(mask)})" for mask in masks)))
    return rows


def _with_errors(evaluation: ArmsEvaluation) -> Rows:
    """Median and 95th percentile of the errors of tip and depth [mm], share still clear, for arms that state errors."""
    rows = []
    for side, arm in evaluation.with_errors.items():
        spans = [np.percentile(values, (50.0, 95.0)) for values in (arm.tip_error, arm.depth_error)]
        rows.append((f"{side} arm", *(number_text(value, 1e3, 1) for value in np.ravel(spans)), _per_cent(arm.kept)))
    return rows


def _definitions() -> list[tuple[str, str]]:
    """Names and definitions of all figures of an evaluation."""
    return [
        ("reachable", "A point is reachable by an arm when joints within their limits put the tip there, the shaft "
         "passes through the trocar, and neither shaft nor links touch the organ or the body wall."),
        ("both at once", "A point is reachable by both at once when each arm reaches it and the arms are at least 5 mm "
         "apart, inside the body and outside, except within 20 mm of the point, where the tips meet."),
        *((quantity.label, quantity.definition) for quantity in QUANTITIES),
        *((f"{title} [mm]", definition) for _, title, definition in DISTANCES),
        ("the worse arm", "At a point, the smaller of both arms' values where more is better, else the larger."),
    ]  # fmt: skip


def cycle_section(evaluation: ArmsEvaluation) -> dict[str, Any] | None:
    """Contents of the report's section on the cycle; None for a motionless patient."""
    cycle, outer = evaluation.cycle, ~evaluation.inner
    if cycle is None:
        return None
    motions = [
        f"{name} by up to {number_text(travel, 1e3, 1, 'mm')} in cycles of {period:.2g} s"
        for name, travel, period in zip(cycle.motions, cycle.travel, cycle.period, strict=True)
    ]
    return {
        "motions": ", ".join(motions),
        "positions": len(cycle.both),
        "reach": _reach_rows(cycle, outer),
        "clearance": [
            (f"{side} arm: clearance [mm]", *_worst_and_median(arm.clearance[:, outer]))
            for side, arm in cycle.arms.items()
        ],
    }


def _reach_rows(cycle: ThroughCycle, outer: NDArray[np.bool_]) -> Rows:
    """Shares of points at rest, median and least over the positions, at every position, and with a path."""
    rows = [(f"{side} arm", arm.reachable, _per_cent(arm.has_path[outer].mean())) for side, arm in cycle.arms.items()]
    rows.append(("both at once", cycle.both, ""))
    texts = []
    for name, reachable, path in rows:
        positions = reachable[:, outer]
        share = positions.mean(axis=1)
        figures = (share[0], np.median(share), share.min(), positions.all(axis=0).mean())
        texts.append((name, *map(_per_cent, figures), path))
    return texts


def _worst_and_median(values: FloatArray) -> tuple[str, ...]:
    """The least of all points and positions; the median over the points of each one's least, and of its median."""
    known = values[:, np.isfinite(values).all(axis=0)]
    figures = [math.nan] * 3
    if known.size:
        worst = known.min(axis=0)
        figures = [float(worst.min()), float(np.median(worst)), float(np.median(np.median(known, axis=0)))]
    return tuple(number_text(figure, 1e3, 2) for figure in figures)


def _per_cent(share: float) -> str:
    return number_text(share, 100.0, 0, "%")
