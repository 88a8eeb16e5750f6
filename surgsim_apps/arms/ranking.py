"""Ranking of placements and robots."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_apps.arms.quantities import spread
from surgsim_apps.arms.results import ArmsEvaluation

RANKING_RULE = (
    "Ranked by the share of the surface's points that both arms reach at once, in whole per cent, largest first (for "
    "a patient who breathes: at every position); equal shares by the share that either reaches, then by the median "
    "clearance from organ and body wall in whole millimetres, then by the smallest tip force in tenths of a newton, "
    "always the largest first; then as given."
)


@dataclass(frozen=True)
class Ranked:
    """A row of the ranking; shares 0 to 1, median clearance [m], smallest force [N], NaN if nothing is reached."""

    name: str
    what: str
    left: float
    right: float
    both: float
    either: float
    clearance: float
    force: float

    @property
    def key(self) -> tuple[float, ...]:
        """Sort key of RANKING_RULE."""
        shares = round(100.0 * self.both), round(100.0 * self.either)
        values = self.clearance * 1e3, self.force * 10.0
        return tuple(-(round(value) if math.isfinite(value) else -math.inf) for value in (*shares, *values))


def rank(candidates: Sequence[tuple[str, str, ArmsEvaluation]]) -> list[Ranked]:
    """Placements or robots in the order of RANKING_RULE.

    Args:
        candidates: name, description in a few words, and evaluation of each.
    """
    return sorted((_row(*candidate) for candidate in candidates), key=lambda row: row.key)


def _row(name: str, what: str, evaluation: ArmsEvaluation) -> Ranked:
    outer, by_left, by_right = ~evaluation.inner, evaluation.left.reachable, evaluation.right.reachable
    together = evaluation.both if evaluation.cycle is None else evaluation.cycle.both_always
    masks = (by_left, by_right, together, by_left | by_right)
    left, right, both, either = (float(mask[outer].mean()) if outer.any() else 0.0 for mask in masks)
    force = spread(np.concatenate([arm.tip_force[arm.reachable] for arm in evaluation.arms.values()])).least
    return Ranked(name, what, left, right, both, either, spread(_clearances(evaluation)).median, force)


def _clearances(evaluation: ArmsEvaluation) -> FloatArray:
    """The smaller distance from organ and wall of either arm at every point in its reach [m], (n,)."""
    parts = [
        np.minimum(arm.organ_clearance, arm.wall_clearance)[arm.reachable & np.isfinite(arm.organ_clearance)]
        for arm in evaluation.arms.values()
    ]
    return np.concatenate(parts)
