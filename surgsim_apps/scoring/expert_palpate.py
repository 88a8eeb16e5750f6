"""A scripted expert for SurgSim/Palpate-v0 with memory=True: slide over the face, go back to the stiffest, declare.

It has no state: each action is a function of one observation, which holds the measured contrast. The tip slides along
rows at a constant depth, less near the soft limit of force. After the rows it returns to the stiffest place and
declares it.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import norm
from surgsim_env.palpation import MAP_SIDE

# Fewest rows, and largest distance between them [m].
ROWS_FEWEST, ROW_SPACING = 5, 0.010
DEPTH = 0.003  # [m] of the tip while it slides
FORCE_SHARE = 0.75  # of the soft limit, above which the tip lifts
NEAR = 0.003  # [m] below this distance speed is proportional to it; also the zone at the end of a row
GOAL_NEAR = 0.006  # [m] the same on the way to the first row and to the stiffest place
ABOVE = 0.004  # [m] within this of the first row's start the tip descends
TRAVEL_GAP = 0.001  # [m] between tip and surface before that
CLOSE_ENOUGH = 0.0015  # [m] within this a row is reached
DECLARE_NEAR = 0.0015  # [m] within this of the stiffest place it declares
FORCE_GAIN = 20.0  # [1/N] full speed upwards at an excess force of 50 mN


class PalpateExpert:
    """Actions (n, 4) for observations (n, n_observation) of a block's flat top.

    Along the rows the direction is a function of place: row by row in alternating directions. The visited marks of the
    first and the last site of the rows show that the search has begun, and that it is over.
    """

    def __init__(self, env: gym.Env) -> None:
        """Read the chart, the block's height and the soft limit from an environment.

        Args:
            env: with memory=True.

        Raises:
            ValueError: a scene that is not a block, or an environment without memory.
        """
        single: Any = env.unwrapped
        scene, task = single.scene, single.task
        if scene.mesh.block is None:
            raise ValueError(f"this expert slides on a block's flat top; {scene.name!r} is not a block: use phantom")
        if task.memory is None:
            raise ValueError("this expert reads the memory of the observation: make the environment with memory=True")
        self.env, self.slices = single, single.observation_slices
        self.chart = task.memory.chart
        self.surface = scene.mesh.block.size[2] + scene.instrument.tip_radius
        self.force_most = FORCE_SHARE * scene.limits.soft_force
        # Rows lie on rows of the map's sites, which have visited marks.
        row_count = max(int(np.ceil(self.chart.extent[1] / ROW_SPACING - 1e-6)) + 1, ROWS_FEWEST)
        along, across = task.memory.map.rows_and_columns
        rows = np.unique(np.round(np.linspace(along[0], along[-1], row_count)).astype(int))
        self.rows = self.chart.lower[1] + task.memory.map.axes[1][rows]
        marks = self.slices["visited"].start
        self.first = marks + rows[0] * MAP_SIDE + across[0]
        self.last = marks + rows[-1] * MAP_SIDE + across[-1 if len(rows) % 2 else 0]
        self.start = np.array([self.chart.lower[0], self.rows[0]])

    def act(self, observations: NDArray, begins: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
        """The next actions; `begins` is not used."""
        seen = self.env.si_values(observations)
        position, force, stiffest = (
            seen[:, self.slices[name]] for name in ("tip_position", "contact_force", "stiffest")
        )
        tip, height, force = position[:, :2], position[:, 2], force[:, 2]
        begun, over = seen[:, self.first] > 0.5, seen[:, self.last] > 0.5
        goal = np.where(over[:, None], self.chart.plane_point(stiffest[:, :2]), self.start)
        gap = goal - tip
        distance = norm(gap, axis=1)
        sliding = begun & ~over
        across = np.where(sliding[:, None], self._along_rows(tip), gap / GOAL_NEAR)
        # In the air on the way to the first row.
        wanted = np.where(begun | (distance < ABOVE), DEPTH, -TRAVEL_GAP)
        depth = self.surface - height
        rise = np.maximum((depth - wanted) / NEAR, FORCE_GAIN * (force - self.force_most))
        declare = over & (distance < DECLARE_NEAR)
        return np.clip(np.column_stack([across, rise, declare]), -1.0, 1.0).astype(np.float32)

    def _along_rows(self, tip: NDArray[np.float64]) -> NDArray[np.float64]:
        """Directions (n, 2) at places (n, 2) [m]: along the current row, at its end to the next."""
        row = np.searchsorted(self.rows, tip[:, 1] + CLOSE_ENOUGH, side="right") - 1
        row = np.clip(row, 0, len(self.rows) - 1)
        way = np.where(row % 2 == 0, 1.0, -1.0)
        end = np.where(way > 0.0, self.chart.upper[0], self.chart.lower[0])
        short = way * (end - tip[:, 0])
        at_end = (short < NEAR) & (row < len(self.rows) - 1)
        x = way * np.clip(short / NEAR, -1.0, 1.0)
        y = np.where(at_end, 1.0, (self.rows[row] - tip[:, 1]) / NEAR)
        return np.column_stack([x, y])
