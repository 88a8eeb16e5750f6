"""A fast surrogate of SurgSim/Palpate-v0 on the block of `phantom_small`, with forces from a formula.

Agents are scored on the full physics only. The force of a press at x, y and depth d is

    F = c (d / 1 m)^p (1 + A exp(-r^2 / (2 s^2))) e(x, y)

with r the distance from the lesion's place, and e the fall towards the block's edges. The numbers are fitted to presses
of the full physics; sensor, limits, rewards, memory and episode are the environment's own. All environments
are stepped together.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from surgsim_env.palpation import MAP_SIDE, stiffest_spots
from surgsim_env.tasks import (
    DECLARE_STEPS,
    DECLARE_VALUE,
    EPISODE_STEPS,
    SPEED_FULL_SCALE,
    START_GAP,
    PalpateTask,
    reward_weights,
    touch_memory,
)

SCENE = "phantom_small"
# The formula's numbers, fitted to the full physics at level "standard": c [N], p, the ranges of A and s [m], and of
# e = 1 - EDGE (x/a)^EDGE_POWER - EDGE (y/a)^EDGE_POWER, x and y from the middle, a half the block's side.
STIFFNESS, EXPONENT, EXCESS, WIDTH = 587.0, 1.42, (0.13, 0.50), (0.0045, 0.0066)
EDGE, EDGE_POWER = 0.315, 3.06
# Tangential over normal force of a sliding tip.
FRICTION = 0.2


class PalpateSurrogate(VectorEnv):
    """Vectorised palpations of a block's flat top, by formula; an ended episode is reset in the same step."""

    metadata: ClassVar[dict[str, Any]] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}

    def __init__(self, count: int) -> None:
        """Make `count` environments with spaces, limits, sensor and memory of the original."""
        env: Any = gym.make("SurgSim/Palpate-v0", scene=SCENE, memory=True).unwrapped
        self.scene, self.task = env.scene, env.task
        remembered = touch_memory(env.simulation.anatomy)
        self.chart, self.map, self.bell_fit = remembered.chart, remembered.map, remembered.bell_fit
        self.indenter, self.least_depth = remembered.indenter, remembered.least_depth
        timing = env.scene.timing
        self.control_step = timing.haptic_step * timing.haptic_steps_per_control
        instrument = env.simulation.instrument
        self.low, self.high = instrument.lower, instrument.upper
        self.block = np.array(env.scene.mesh.block.size)
        self.surface = self.block[2] + env.scene.instrument.tip_radius
        self.num_envs = count
        self.single_observation_space, self.single_action_space = env.observation_space, env.action_space
        self.observation_space = batch_space(self.single_observation_space, count)
        self.action_space = batch_space(self.single_action_space, count)
        # Scene and task are those of the original environment.
        self.envs = [env] * count
        self.rng = np.random.default_rng(0)
        sites = MAP_SIDE**2
        self.tip, self.velocity, self.bias = np.zeros((3, count, 3))
        self.lesion = np.zeros((count, 2))
        self.excess, self.width = np.zeros((2, count))
        self.steps, self.declared = np.zeros((2, count), dtype=np.int64)
        self.product, self.square = np.zeros((2, count, sites))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[NDArray[np.float32], dict]:
        """Start an episode in every environment."""
        if isinstance(seed, list):
            seed = seed[0]
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        everywhere = np.ones(self.num_envs, dtype=np.bool_)
        self._draw(everywhere)
        return self._observe(everywhere), {}

    def step(self, actions: NDArray[np.floating]) -> tuple[NDArray[np.float32], NDArray, NDArray, NDArray, dict]:
        """One control step of all; a finished environment begins its next episode in the same step."""
        actions, before = np.asarray(actions, dtype=np.float64), self.tip
        self.tip = np.clip(before + actions[:, :3] * SPEED_FULL_SCALE * self.control_step, self.low, self.high)
        self.velocity = (self.tip - before) / self.control_step
        self.steps += 1
        force = self.normal_force()
        pressing = (actions[:, 3] > DECLARE_VALUE) & (force > 0.0)
        self.declared = np.where(pressing, self.declared + 1, 0)
        observation = self._observe(np.ones(self.num_envs, dtype=np.bool_))
        rewards, terminated, truncated, endings = self._judge(force)
        infos: dict[str, Any] = {}
        over = terminated | truncated
        if over.any():
            for index in np.flatnonzero(over):
                ended = {"final_obs": observation[index].copy(), "final_info": endings(index)}
                infos = self._add_info(infos, ended, int(index))
            self._draw(over)
            observation[over] = self._observe(over)[over]
        return observation, rewards, terminated, truncated, infos

    # ---- the palpation -------------------------------------------------------------------------------------------

    def normal_force(self) -> NDArray[np.float64]:
        """Force along the normal [N] (n_env,): the formula above."""
        depth = np.maximum(self.surface - self.tip[:, 2], 0.0)
        off = np.abs(self.tip[:, :2] / (0.5 * self.block[:2]) - 1.0)
        edge = np.maximum(1.0 - EDGE * (off**EDGE_POWER).sum(axis=1), 0.3)
        gap = ((self.tip[:, :2] - self.lesion) ** 2).sum(axis=1)
        bump = 1.0 + self.excess * np.exp(-0.5 * gap / self.width**2)
        return STIFFNESS * depth**EXPONENT * bump * edge

    def _draw(self, which: NDArray[np.bool_]) -> None:
        """Draw new episodes: lesion, sensor bias, start."""
        count, rng, scene = int(which.sum()), self.rng, self.scene
        rim, margin = scene.lesion.rim_distance, scene.palpation.face_margin
        self.lesion[which] = rng.uniform(rim, self.block[:2] - rim, (count, 2))
        self.excess[which] = rng.uniform(*EXCESS, count)
        self.width[which] = rng.uniform(*WIDTH, count)
        self.bias[which] = rng.uniform(-scene.sensor.bias, scene.sensor.bias, (count, 3))
        place = rng.uniform(margin, self.block[:2] - margin, (count, 2))
        height = self.surface + rng.uniform(*START_GAP, count)
        self.tip[which] = np.column_stack([place, height])
        self.velocity[which] = 0.0
        self.steps[which] = self.declared[which] = 0
        self.product[which] = self.square[which] = 0.0

    def _observe(self, which: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Observations (n_env, n); the reading is added to the memory of `which`."""
        normal = self.normal_force()
        speed = np.linalg.norm(self.velocity[:, :2], axis=1, keepdims=True)
        way = self.velocity[:, :2] / np.maximum(speed, 1e-9)
        force = np.column_stack([-FRICTION * normal[:, None] * way, normal]) + self.bias
        reach = self.scene.sensor.range
        reading = np.clip(force + self.rng.normal(0.0, self.scene.sensor.noise, force.shape), -reach, reach)
        left = 1.0 - self.steps / EPISODE_STEPS
        seen = {"tip_position": self.tip, "tip_velocity": self.velocity, "contact_force": reading}
        seen["time_left"] = left[:, None]
        self._remember(which, reading[:, 2])
        seen |= zip(("contrast", "visited", "stiffest"), self._recalled(), strict=True)
        seen["face"] = np.broadcast_to(self.map.pressable, seen["visited"].shape)
        channels = self.envs[0].observation_slices
        return self.envs[0].as_observed(np.concatenate([seen[name] for name in channels], axis=1))

    def _remember(self, which: NDArray[np.bool_], force: NDArray[np.float64]) -> None:
        """`TouchMemory.feel` of all at once."""
        depth, site = self.surface - self.tip[:, 2], self.map.nearest(self.chart.place(self.tip))
        felt = which & (depth >= self.least_depth) & (site >= 0) & self.map.pressable[site]
        rows, sites = np.flatnonzero(felt), site[felt]
        healthy = self.indenter.force(1.0) * depth[felt] ** 1.5
        self.product[rows, sites] += force[felt] * healthy
        self.square[rows, sites] += healthy**2

    def _recalled(self) -> tuple[NDArray[np.float64], ...]:
        """Contrasts, visited marks and the stiffest place of a `TouchMemory`."""
        visited = self.square > 0.0
        contrast = np.divide(self.product, self.square, out=np.zeros_like(self.product), where=visited)
        return contrast, visited.astype(np.float64), stiffest_spots(self.bell_fit, self.product, self.square)

    def _judge(
        self, force: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Callable[[int], dict[str, Any]]]:
        """Rewards, ends and infos of `TaskRuntime.judge`."""
        limits, weights = self.scene.limits, reward_weights(PalpateTask)
        hard = force > limits.hard_force
        declared = ~hard & (self.declared >= DECLARE_STEPS)
        error = np.linalg.norm(self.tip[:, :2] - self.lesion, axis=1)
        right = declared & (error <= self.task.success_distance)
        terminated, left = hard | declared, EPISODE_STEPS - self.steps
        share = np.clip((force - limits.soft_force) / (limits.hard_force - limits.soft_force), 0.0, 1.0)
        rewards = (
            weights["time"]
            + weights["soft_force"] * share
            + weights["found"] * right
            + weights["wrong"] * (declared & ~right)
            + weights["hard_force"] * hard
            + weights["forgone"] * (terminated & ~right) * left
        )

        def ending(index: int) -> dict[str, Any]:
            return {
                "success": bool(right[index]),
                "is_success": bool(right[index]),
                "declared": bool(declared[index]),
                "hard_limit": bool(hard[index]),
                "error_mm": float(error[index]) * 1000.0 if declared[index] else -1.0,
                "reward_wrong": weights["wrong"] * float(declared[index] and not right[index]),
                "reward_hard_force": weights["hard_force"] * float(hard[index]),
                "reward_fault": 0.0,
                "reward_forgone": weights["forgone"] * float(terminated[index] and not right[index]) * int(left[index]),
            }

        return rewards, terminated, ~terminated & (left <= 0), ending
