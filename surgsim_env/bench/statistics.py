"""Medians, quantiles and exponents of timings."""

import math
import time
from collections.abc import Callable, Sequence

import numpy as np

# Shorter than this [s], a timing is mostly that of the clock and the call.
SHORTEST_TIMING = 0.01


def median(values: Sequence[float]) -> float:
    """The middle value; of an even number of values, the mean of the two middle ones."""
    return float(np.median(values))


def quantile(values: Sequence[float], share: float) -> float:
    """The smallest value that at least this share of all values do not exceed: one that was measured."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)]


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Exponent p of cost ~ size^p: the slope of the line of least squares through the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def spread(values: Sequence[float]) -> str:
    """How many rounds, and from where to where they went."""
    return f"{len(values)} rounds, {min(values):.3g} to {max(values):.3g}"


def interleaved(runs: dict[str, Callable[[], float]], rounds: int) -> dict[str, list[float]]:
    """What each run returns in each round; all runs once, then all once more, so that load falls on all alike."""
    results: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            results[name].append(run())
    return results


def seconds_per_call(call: Callable[[int], object], *, shortest: float = SHORTEST_TIMING) -> float:
    """Processor time of one of `count` repetitions that call(count) makes [s], with a count that lasts long enough."""
    count = 1
    while True:
        begin = time.process_time()
        call(count)
        taken = time.process_time() - begin
        if taken >= shortest:
            return taken / count
        count = max(2 * count, min(10 * count, math.ceil(1.2 * count * shortest / max(taken, 1e-6))))
