"""Environments of one id many times over: their organs advance side by side in vector registers."""

import math
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, ClassVar, Literal

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array
from numpy.typing import NDArray

from msdm_core.kernels.vector_kernels import lane_counts
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.lane_group import LaneGroup, core_count
from surgsim_env.envs import ids
from surgsim_env.envs.surgical_env import NOT_BEGUN, OVER, SurgicalEnv
from surgsim_env.scene.load import require_known


class LaneVectorEnv(VectorEnv):
    """Environments of one scene, stepped together with the same results as alone.

    Autoreset modes, infos and spaces are those of Gymnasium's `SyncVectorEnv`. In float64 each environment equals a
    single one to the bit, whatever its neighbours do.

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

    Attributes:
        envs: the environment of each lane

    Raises:
        ValueError: an unknown autoreset_mode or dtype, a count that is no whole number above 0, a window for several
            environments, or what a single environment refuses.
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
        threads = core_count() if threads is None else threads
        steps = 1 if max_episode_steps is None else max_episode_steps
        for name, count in {"num_envs": num_envs, "threads": threads, "max_episode_steps": steps}.items():
            if not isinstance(count, int | np.integer) or count < 1:
                raise ValueError(f"{name} is {count!r}; it must be a whole number, at least 1")
        if render_mode == "human" and num_envs != 1:
            raise ValueError(f'render_mode "human" shows one environment, not {num_envs}: use "rgb_array"')
        mode = getattr(autoreset_mode, "value", autoreset_mode)
        require_known("autoreset_mode", mode, [known.value for known in AutoresetMode])
        require_known("dtype", dtype, ("float64", "float32"))
        self.autoreset_mode = AutoresetMode(mode)
        self.envs = [self.single(render_mode=render_mode, **settings) for _ in range(num_envs)]
        first = self.envs[0]
        self.num_envs, self.render_mode = num_envs, render_mode
        self.metadata = {**first.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space, self.single_action_space = first.observation_space, first.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        own_steps = first.task.episode_steps or math.inf
        # The environment truncates an episode of its own number of steps by itself.
        self._step_limit = math.inf if (max_episode_steps or math.inf) >= own_steps else max_episode_steps
        width = group_width(num_envs, np.dtype(dtype), threads)
        self._members = [range(first, min(first + width, num_envs)) for first in range(0, num_envs, width)]
        self._groups = [
            LaneGroup([self.envs[lane].simulation for lane in members], np.dtype(dtype).type, width)
            for members in self._members
        ]
        # The last observation of each lane.
        self._observations: list[Any] = [None] * num_envs
        self._paused = np.zeros(num_envs, dtype=np.bool_)
        self._pool = ThreadPoolExecutor(max_workers=min(len(self._groups), threads))
        # The threads live in this process alone: a forked child has none of them, and would wait for them for ever.
        self._process = os.getpid()
        # Held while a group advances, which it does only in the round in which it was asked to.
        self._locks = [threading.Lock() for _ in self._groups]
        self._round = 0

    def _await_threads(self) -> None:
        """Wait for groups that still advance after an exception in `step`; those that have not begun will not."""
        self._round += 1
        for lock in self._locks:
            with lock:
                pass

    def __reduce__(self) -> tuple[Any, ...]:
        raise TypeError(
            f"{type(self).__name__} cannot be pickled or copied, as its threads run in this process alone: pickle its "
            "`envs`, or make another with gym.make_vec and load their saved states"
        )

    @property
    def observation_slices(self) -> dict[str, slice]:
        """Entries of each channel in observations: `observations[:, observation_slices["time_left"]]`."""
        return self.envs[0].observation_slices

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in all environments, or in those of `options={"reset_mask": mask}`.

        One that is reset is paused no more.

        Args:
            seed: of the first environment, with the next numbers for the others; or one for each.
            options: "reset_mask", bool of shape (num_envs,), and what a single environment takes.

        Raises:
            RuntimeError: a forked child calls it; see `step`.
            ValueError: another number of seeds, or a mask of another shape or type.
        """
        self._check_process()
        options = dict(options or {})
        begins = self._mask(options.pop("reset_mask", np.ones(self.num_envs, dtype=np.bool_)), "reset_mask")
        seeds = [None] * self.num_envs if seed is None else seed
        if isinstance(seeds, int):
            seeds = [seeds + lane for lane in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds are given for {self.num_envs} environments: give one for each")
        infos: dict[str, Any] = {}
        for lane in np.flatnonzero(begins).tolist():
            self._observations[lane], info = self.envs[lane].reset(seed=seeds[lane], options=options)
            self._paused[lane] = False
            infos = self._add_info(infos, info, lane)
        return self._together(), infos

    def pause(self, mask: NDArray[np.bool_]) -> None:
        """Leave the environments of a mask (n,) as they are in each `step`, until a reset of mode "Disabled".

        A step gives of them the last observation, a reward of 0, False for both ends, and no info; their actions are
        not read. So nothing is computed for lanes whose last episode is over.

        Raises:
            ValueError: a mask of another shape or type.
        """
        self._paused = self._mask(mask, "mask")

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One control step of all environments whose episode runs; the others are reset as their mode says.

        An exception, Ctrl-C among them, breaks off the episodes of the lanes that have moved and not been judged: the
        next step names them until they are reset, loaded or paused. The other lanes go on where they are.

        Raises:
            RuntimeError: a forked child calls it, where the threads that advance the organs do not run.
            ResetNeeded: an episode is over and the mode does not reset it, or was broken off (names the lane).
            ValueError: names the lane and the entry of the action that is out of bounds; no environment has moved.
        """
        self._check_process()
        # Why each lane takes no step; "" while its episode runs. No copy of it, which an exception could leave behind.
        halts = [env.halted or OVER * (env.task.step_count >= self._step_limit) for env in self.envs]
        next_step = self.autoreset_mode is AutoresetMode.NEXT_STEP
        resets = np.array([next_step and halt == OVER for halt in halts]) & ~self._paused
        moving = self._checked(actions, np.flatnonzero(~(resets | self._paused)).tolist(), halts)
        for lane, action in moving.items():
            self.envs[lane].begin(action)

        started = self._round

        def advance(lanes: LaneGroup, members: range, lock: threading.Lock) -> None:
            group = [self.envs[lane] for lane in members if lane in moving]
            with lock:
                if group and started == self._round:
                    group[0].advance(group, lanes)

        try:
            list(self._pool.map(advance, self._groups, self._members, self._locks))
        finally:
            self._await_threads()
        rewards, infos = np.zeros(self.num_envs), dict[str, Any]()
        terminated, truncated = np.zeros((2, self.num_envs), dtype=np.bool_)
        for lane, env in enumerate(self.envs):
            info: dict[str, Any] = {}
            if lane in moving:
                seen, rewards[lane], terminated[lane], truncated[lane], info = env.finish()
                truncated[lane] |= env.task.step_count >= self._step_limit
                self._observations[lane] = seen
                if (terminated[lane] or truncated[lane]) and self.autoreset_mode is AutoresetMode.SAME_STEP:
                    infos = self._add_info(infos, {"final_obs": seen, "final_info": info}, lane)
                    resets[lane] = True
            if resets[lane]:
                self._observations[lane], info = env.reset()
            infos = self._add_info(infos, info, lane)
        return self._together(), rewards, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8] | None, ...]:  # type: ignore[override]
        """The picture of each environment."""
        return tuple(env.render() for env in self.envs)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Results of a method of each environment, or values of an attribute, as of `SyncVectorEnv`."""
        values = [getattr(env, name) for env in self.envs]
        return tuple(value(*args, **kwargs) if callable(value) else value for value in values)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Values of an attribute of each environment."""
        return self.call(name)

    def close_extras(self, **kwargs: Any) -> None:
        """Stop the threads and close the environments."""
        self._pool.shutdown()
        for env in self.envs:
            env.close()

    def _checked(self, actions: Any, moving: list[int], halts: list[str]) -> dict[int, FloatArray]:
        """The checked actions of the moving lanes, by lane."""
        values = np.asarray(actions, dtype=np.float64)
        if values.shape != self.action_space.shape:
            raise ValueError(f"actions have shape {values.shape}; the rule is {self.action_space.shape}")
        if halted := [lane for lane in moving if halts[lane]]:
            alike = ", ".join(f"lane {lane}" for lane in halted if halts[lane] == halts[halted[0]])
            raise gym.error.ResetNeeded(
                f"{alike}: {halts[halted[0]]}: reset with options={{'reset_mask': mask}}, or pause(mask)"
            )
        return {lane: self.envs[lane].checked(values[lane], lane) for lane in moving}

    def _mask(self, values: Any, name: str) -> NDArray[np.bool_]:
        mask = np.array(values)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ValueError(f"{name} is {mask.dtype} {mask.shape}; the rule is bool ({self.num_envs},)")
        return mask

    def _check_process(self) -> None:
        if (child := os.getpid()) != self._process:
            raise RuntimeError(
                f"{type(self).__name__} of {self.num_envs} environments was made in process {self._process}, and "
                f"process {child} was forked from it, in which its threads do not run: make it in the child process, "
                'with gym.make_vec in the worker\'s own function, or start workers with the method "spawn"'
            )
        self._await_threads()

    def _together(self) -> Any:
        """The last observations of all environments."""
        if missing := [lane for lane, seen in enumerate(self._observations) if seen is None]:
            raise gym.error.ResetNeeded(f"lane {missing[0]}: {NOT_BEGUN}: reset all environments first")
        space = self.single_observation_space
        return concatenate(space, self._observations, create_empty_array(space, n=self.num_envs))


@cache
def vector_class(single: type[SurgicalEnv]) -> type[LaneVectorEnv]:
    """The vector environment of an environment class."""
    name = single.__name__.removesuffix("Env") + "VectorEnv"
    own = {"single": single, "__module__": single.__module__, "__doc__": single.__doc__}
    return type(name, (LaneVectorEnv,), own)


def __getattr__(name: str) -> Any:
    """The vector environment of a registered task, whose entry point has its id as the name."""
    if name not in ids.TASKS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return vector_class(ids.environment_class(ids.TASKS[name]))


def group_width(num_envs: int, dtype: np.dtype, threads: int) -> int:
    """Number of organs in a group: a full register, unless smaller groups keep more threads busy or are enough."""
    widest, narrowest = lane_counts(dtype)[0], lane_counts(dtype)[-1]
    return narrowest if math.ceil(num_envs / widest) < threads or num_envs <= narrowest else widest
