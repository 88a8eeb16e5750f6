"""Environments of one id many times over: their organs advance side by side in vector registers."""

import math
import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, ClassVar, Literal, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import iterate
from numpy.typing import NDArray

from msdm_core.kernels.vector_kernels import lane_counts
from surgsim_env.coupling.lane_group import LaneGroup, core_count
from surgsim_env.envs import ids
from surgsim_env.envs.surgical_env import SurgicalEnv


class LaneVectorEnv(SyncVectorEnv):
    """Environments of one scene, stepped together; each gives what it would give alone.

    Everything but the control step itself is `SyncVectorEnv`'s: resets, autoreset modes, infos, spaces. In float64 each
    environment equals a single one to the bit, whatever its neighbours do.

        envs = gym.make_vec("SurgSim/Palpate-v0", num_envs=16, vectorization_mode="vector_entry_point")

    Args:
        num_envs: how many; multiples of 8 (float64) or 16 (float32) leave no lane empty. In float32 groups are of 8
            where groups of 16 would leave a thread idle.
        autoreset_mode: "NextStep", "SameStep" or "Disabled" (reset with `options={"reset_mask": ...}`).
        dtype: "float64", or "float32" for up to half the speed more, with forces within 0.5 %.
        threads: groups of organs that advance at the same time; as many as there are cores by default.
        max_episode_steps: control steps until truncation, at most the environment's own number.
        render_mode: None, or "rgb_array": `render()` gives a tuple of pictures, drawn with shared graphics.
        settings: what a single environment takes, such as scene, instrument and level, by name.
    """

    # The environment of each lane, which a subclass says.
    single: ClassVar[type[SurgicalEnv]]

    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        dtype: Literal["float64", "float32"] = "float64",
        threads: int | None = None,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        if render_mode == "human" and num_envs != 1:
            raise ValueError(f'render_mode "human" shows one environment, not {num_envs}: use "rgb_array"')

        def make() -> gym.Env:
            env = self.single(render_mode=render_mode, **settings)
            if max_episode_steps is None or max_episode_steps >= (env.task.episode_steps or math.inf):
                return env
            return gym.wrappers.TimeLimit(env, max_episode_steps)

        super().__init__([make] * num_envs, autoreset_mode=autoreset_mode)
        self._singles: list[SurgicalEnv] = [env.unwrapped for env in self.envs]  # type: ignore[misc]
        threads = threads if threads is not None else core_count()
        width = group_width(num_envs, np.dtype(dtype), threads)
        self._members = [range(first, min(first + width, num_envs)) for first in range(0, num_envs, width)]
        self._groups = [
            LaneGroup([self._singles[index].simulation for index in members], np.dtype(dtype).type, width)
            for members in self._members
        ]
        self._pool = ThreadPoolExecutor(max_workers=min(len(self._groups), threads))
        self._paused = np.zeros(num_envs, dtype=np.bool_)
        # The threads live in this process alone: a forked child has none of them, and would wait for them for ever.
        self._process = os.getpid()

    @property
    def observation_slices(self) -> dict[str, slice]:
        """The entries of an observation that each channel has: `observations[:, observation_slices["time_left"]]`."""
        return self._singles[0].observation_slices

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in all environments, or in those that `options={"reset_mask": ...}` names.

        One that is reset is paused no more.

        Raises:
            RuntimeError: a forked child calls it; see `step`.
        """
        self._check_process()
        begins = (options or {}).get("reset_mask")
        given = super().reset(seed=seed, options=options)
        self._paused[slice(None) if begins is None else begins] = False
        return given

    def pause(self, mask: NDArray[np.bool_]) -> None:
        """Leave the environments that a mask (n,) names as they are in each `step`, until a reset of mode "Disabled".

        A step gives of them the last observation, a reward of 0, False for both ends, and no info; their actions are
        not read. So nothing is computed for lanes whose last episode is over.
        """
        self._paused = np.array(mask)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One control step of all environments whose episode runs; the others are reset as their mode says.

        Raises:
            RuntimeError: a forked child calls it, where the threads that advance the organs do not run.
        """
        self._check_process()
        active = np.zeros(self.num_envs, dtype=np.bool_)
        for index, action in enumerate(iterate(self.action_space, actions)):
            resets = self._autoreset_envs[index] and self.autoreset_mode is AutoresetMode.NEXT_STEP
            if not (resets or self._paused[index]):
                self._command(index, action)
                active[index] = True

        def advance(group: LaneGroup, members: range) -> None:
            moves = active[members.start : members.stop]
            if moves.any():
                self._advance(group, members, moves)

        list(self._pool.map(advance, self._groups, self._members))
        if not self._paused.any():
            return super().step(actions)
        return self._step_others(actions)

    def _step_others(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """`SyncVectorEnv.step`, with stand-ins for the environments that are paused."""
        envs = self.envs
        self._autoreset_envs[self._paused] = False
        try:
            stand_ins: list[Any] = [
                _Standstill(seen) if paused else env
                for env, seen, paused in zip(envs, self._env_obs, self._paused, strict=True)
            ]
            self.envs = stand_ins
            return super().step(actions)
        finally:
            self.envs = envs

    def _check_process(self) -> None:
        if (child := os.getpid()) != self._process:
            raise RuntimeError(
                f"{type(self).__name__} of {self.num_envs} environments was made in process {self._process}, and "
                f"process {child} was forked from it, in which its threads do not run: make it in the child process, "
                'with gym.make_vec in the worker\'s own function, or start workers with the method "spawn"'
            )

    def _command(self, index: int, action: Any) -> None:
        """Give an environment's instrument the commands of an action."""
        self._singles[index].command(action)

    def _advance(self, group: LaneGroup, members: range, active: NDArray[np.bool_]) -> None:
        """Advance the active of a group's environments (n,) by what a step lasts."""
        first = self._singles[members.start]
        count = first.scene.timing.haptic_steps_per_control
        group.control_step(active, count, first.runtime.force_limit, first.runtime.pull_limit)

    def close_extras(self, **kwargs: Any) -> None:
        """Stop the threads and close the environments."""
        self._pool.shutdown()
        super().close_extras(**kwargs)


class _Standstill(NamedTuple):
    """In place of an environment that is paused: its step gives the last observation, and nothing happens."""

    observation: Any

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation, 0.0, False, False, {}


@cache
def vector_class(single: type[SurgicalEnv]) -> type[LaneVectorEnv]:
    """The vector environment of an environment class."""
    name = single.__name__.removesuffix("Env") + "VectorEnv"
    told = {"single": single, "__module__": single.__module__, "__doc__": single.__doc__}
    return type(name, (LaneVectorEnv,), told)


def __getattr__(name: str) -> Any:
    """The vector environment of a registered task, whose entry point has its id as the name."""
    if name not in ids.TASKS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return vector_class(ids.environment_class(ids.TASKS[name]))


def group_width(num_envs: int, dtype: np.dtype, threads: int) -> int:
    """How many organs a group has: a register full, unless smaller groups keep more threads busy or are enough."""
    widest, narrowest = lane_counts(dtype)[0], lane_counts(dtype)[-1]
    return narrowest if math.ceil(num_envs / widest) < threads or num_envs <= narrowest else widest
