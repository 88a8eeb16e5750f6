"""Measuring: sizes and repetitions of a run, timing functions, and statistics of the times."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

Cells = tuple[int, int, int]


@dataclass(frozen=True)
class Effort:
    """Sizes and repetitions of one run.

    Args:
        blocks: cells along x, y, z of the blocks for the time of a substep.
        substep_rounds: repetitions of each.
        scenes: for the time of a haptic step.
        haptic_steps: number of steps of each, in contact.
        env_counts: environments side by side.
        control_steps: of every environment in one round.
        control_rounds: repetitions.
        organ_cells: of this project's block beside the peers', cells along x, y, z.
        grid: nodes of the peers' block along x, y, z.
        press_rounds: repetitions of each press.
        longer_steps: steps to try with flex, in multiples of 1 ms.
        starts: warm starts.
        memory_envs: number of environments for the growth of memory.
        rollout_steps: control steps of each environment between two updates of PPO.
        training_rounds: updates of PPO.
    """

    blocks: tuple[Cells, ...]
    substep_rounds: int
    scenes: tuple[str, ...]
    haptic_steps: int
    env_counts: tuple[int, ...]
    control_steps: int
    control_rounds: int
    organ_cells: Cells
    grid: Cells
    press_rounds: int
    longer_steps: tuple[int, ...]
    starts: int
    memory_envs: int
    rollout_steps: int
    training_rounds: int


SCENES = ("phantom", "liver", "bovine_liver_block")
# About 400, 640, 2000, 5000 and 20 000 nodes; cubic cells.
BLOCKS: tuple[Cells, ...] = ((7, 7, 3), (9, 9, 3), (12, 12, 6), (15, 15, 10), (24, 24, 16))

FULL = Effort(
    blocks=BLOCKS, substep_rounds=9, scenes=SCENES, haptic_steps=2000, env_counts=(1, 4, 16, 64), control_steps=20,
    control_rounds=3, organ_cells=(12, 12, 6), grid=(15, 15, 9), press_rounds=3, longer_steps=(2, 3, 4, 5, 8, 10),
    starts=3, memory_envs=8, rollout_steps=128, training_rounds=3,
)  # fmt: skip
QUICK = Effort(
    blocks=BLOCKS[:3], substep_rounds=5, scenes=SCENES, haptic_steps=400, env_counts=(1, 4, 16), control_steps=8,
    control_rounds=2, organ_cells=(8, 8, 4), grid=(11, 11, 6), press_rounds=2, longer_steps=(2, 5), starts=1,
    memory_envs=4, rollout_steps=32, training_rounds=2,
)  # fmt: skip
# A timing shorter than this [s] is mostly that of the clock and the call.
SHORTEST_TIMING = 0.01


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Exponent p of cost ~ size^p: the slope of the line of least squares through the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def spread(values: Sequence[float]) -> str:
    """Number of rounds and range of their values, as text."""
    return f"{len(values)} rounds, {min(values):.3g} to {max(values):.3g}"


def interleaved(runs: dict[str, Callable[[], float]], rounds: int) -> dict[str, list[float]]:
    """Values of each run, one a round; runs take turns, so that other load affects all alike."""
    results: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            results[name].append(run())
    return results


def seconds_per_call(call: Callable[[int], object]) -> float:
    """Processor time of one of `count` repetitions by call(count) [s], with a count of at least SHORTEST_TIMING."""
    count = 1
    while True:
        begin = time.process_time()
        call(count)
        elapsed = time.process_time() - begin
        if elapsed >= SHORTEST_TIMING:
            return elapsed / count
        count = max(2 * count, min(10 * count, math.ceil(1.2 * count * SHORTEST_TIMING / max(elapsed, 1e-6))))
