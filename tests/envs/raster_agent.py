"""A scripted agent for SurgSim/Palpate-v0: press a raster, go back to the stiffest place, declare it.

It uses the observation (tip position, force) and the scene file (height of the phantom, force limits) only, so a
learning agent should beat its score.
"""

from collections.abc import Iterator

import gymnasium as gym
import numpy as np

from surgsim_apps.scoring.episodes import EpisodeFacts

PRESS_DEPTH = 0.0035  # [m] below the resting surface
TRAVEL_GAP = 0.0006  # [m] between tip and surface while moving sideways
SPEED = 0.02  # [m/s] full scale of the action
CONTROL_STEP = 0.05  # [s]
CLOSE_ENOUGH = 0.0007  # [m]


class RasterAgent:
    """Presses a grid of sites on a flat top, remembers each force, then declares at the stiffest."""

    def __init__(self, sites_per_side: int = 5) -> None:
        self.sites_per_side = sites_per_side

    def reset(self, rng: np.random.Generator, facts: EpisodeFacts) -> None:
        """Begin an episode; it draws nothing from the random numbers."""
        self.env = gym.make(facts.env_id, **facts.env_kwargs).unwrapped
        scene = self.env.scene
        if scene.mesh.block is None:
            raise ValueError(f"this agent presses the flat top of a block; {scene.name!r} is not a block: use phantom")
        width, depth, self.top = scene.mesh.block.size
        self.radius = scene.instrument.tip_radius
        self.slices, self.soft_force = facts.observation_slices, facts.soft_force
        rim = scene.lesion.rim_distance
        xs, ys = (np.linspace(rim, side - rim, self.sites_per_side) for side in (width, depth))
        # Rows in alternating directions shorten the path.
        self.sites = [(x, y) for row, y in enumerate(ys) for x in (xs if row % 2 == 0 else xs[::-1])]
        self.forces: list[float] = []
        self._plan = self._search()

    def act(self, observation: np.ndarray) -> np.ndarray:
        """The next action, from an observation."""
        seen = self.env.si_values(observation)
        self.tip = seen[self.slices["tip_position"]]
        self.force = float(seen[self.slices["contact_force"]][2])
        return next(self._plan)

    def _search(self) -> Iterator[np.ndarray]:
        travel = self.top + self.radius + TRAVEL_GAP
        pressed = self.top + self.radius - PRESS_DEPTH
        for x, y in self.sites:
            yield from self._go(np.array([x, y, travel]))
            yield from self._go(np.array([x, y, pressed]))
            self.forces.append(self.force)
            yield from self._go(np.array([x, y, travel]))
        x, y = self._stiffest()
        yield from self._go(np.array([x, y, travel]))
        yield from self._go(np.array([x, y, pressed]))
        while True:
            yield np.array([0.0, 0.0, 0.0, 1.0], dtype=np.float32)

    def _go(self, target: np.ndarray) -> Iterator[np.ndarray]:
        """Velocities towards a place [m] until it is reached, or the soft limit on the way down."""
        while True:
            gap = target - self.tip
            pressing = self.force > self.soft_force and gap[2] < 0.0
            if np.linalg.norm(gap) < CLOSE_ENOUGH or pressing:
                return
            yield np.append(np.clip(gap / (SPEED * CONTROL_STEP), -1.0, 1.0), 0.0).astype(np.float32)

    def _stiffest(self) -> np.ndarray:
        """Centroid of the excess force around the stiffest site: its neighbours refine the estimate."""
        sites, forces = np.array(self.sites), np.array(self.forces)
        best = sites[np.argmax(forces)]
        excess = np.maximum(forces - np.median(forces), 0.0)
        near = np.linalg.norm(sites - best, axis=1) < 0.014
        return (excess[near, None] * sites[near]).sum(axis=0) / excess[near].sum()
