"""How much a run of `surgsim bench` measures."""

from dataclasses import dataclass

Cells = tuple[int, int, int]


@dataclass(frozen=True)
class Effort:
    """Sizes and repetitions of one run.

    Args:
        blocks: cells along x, y, z of the blocks whose substep is timed.
        substep_rounds: repetitions of each.
        scenes: whose haptic step is timed.
        haptic_steps: how many of each, in contact.
        env_counts: environments side by side.
        control_steps: of every environment in one round.
        control_rounds: repetitions.
        organ_cells: of this project's block that is pressed beside the peers', cells along x, y, z.
        grid: nodes of the peers' block along x, y, z.
        press_rounds: repetitions of each press.
        longer_steps: that flex is tried at, as multiples of 1 ms.
        starts: warm starts.
        memory_envs: over how many environments memory is measured.
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


SCENES = ("phantom", "liver", "bovine_liver_block")
# About 400, 640, 2000, 5000 and 20 000 nodes; cubic cells.
BLOCKS: tuple[Cells, ...] = ((7, 7, 3), (9, 9, 3), (12, 12, 6), (15, 15, 10), (24, 24, 16))

FULL = Effort(
    blocks=BLOCKS, substep_rounds=9, scenes=SCENES, haptic_steps=2000, env_counts=(1, 4, 16, 64), control_steps=20,
    control_rounds=3, organ_cells=(12, 12, 6), grid=(15, 15, 9), press_rounds=3, longer_steps=(2, 3, 4, 5, 8, 10),
    starts=3, memory_envs=8,
)  # fmt: skip
QUICK = Effort(
    blocks=BLOCKS[:3], substep_rounds=5, scenes=SCENES, haptic_steps=400, env_counts=(1, 4, 16), control_steps=8,
    control_rounds=2, organ_cells=(8, 8, 4), grid=(11, 11, 6), press_rounds=2, longer_steps=(2, 5), starts=1,
    memory_envs=4,
)  # fmt: skip
