"""A vector environment as stable-baselines3 takes it; needs the `agents` extra."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers.vector import DictInfoToList
from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.vec_env.base_vec_env import (  # pyright: ignore[reportMissingImports]
    VecEnvIndices,
    VecEnvObs,
    VecEnvStepReturn,
)


class VectorEnvForStableBaselines(VecEnv):
    """A vector environment behind the interface of stable-baselines3.

    Both interfaces reset an environment in the step in which its episode ends; the last observation of the episode is
    `info["terminal_observation"]` in stable-baselines3 and `info["final_obs"]` in Gymnasium.
    """

    def __init__(self, envs: VectorEnv) -> None:
        """Take environments with autoreset in the same step.

        Args:
            envs: such as gym.make_vec("SurgSim/Palpate-v0", num_envs=16, vectorization_mode="vector_entry_point",
                autoreset_mode="SameStep").

        Raises:
            ValueError: they reset otherwise (names how).
        """
        mode = AutoresetMode(envs.metadata["autoreset_mode"])
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f'autoreset_mode is {mode.value!r}; stable-baselines3 needs "SameStep"')
        self.envs = DictInfoToList(envs)
        self._actions: np.ndarray | None = None
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> VecEnvObs:
        """Start an episode everywhere, with the seeds from `seed` and the options from `set_options`.

        Raises:
            ValueError: options that differ between environments, or what the environments refuse.
        """
        options = self._options[0]
        if other := [given for given in self._options if given != options]:
            raise ValueError(
                f"set_options has {options} for environment 0 and {other[0]} for another; they are reset together: "
                "give one dictionary for all"
            )
        observation, self.reset_infos = self.envs.reset(seed=list(self._seeds), options=options)  # type: ignore[arg-type]
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions (n_env, n_action) for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """One control step of all."""
        observation, reward, terminated, truncated, infos = self.envs.step(self._actions)
        done = terminated | truncated
        for index in np.flatnonzero(done):
            last = infos[index]
            infos[index] = {
                **last.pop("final_info"),
                "terminal_observation": last.pop("final_obs"),
                "TimeLimit.truncated": bool(truncated[index] and not terminated[index]),
            }
        return observation, reward.astype(np.float32), done, infos

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """A picture of each environment, shape (height, width, 3); made with render_mode "rgb_array"."""
        return list(self.envs.render() or ())  # type: ignore[arg-type]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Values of an attribute of some environments."""
        return [env.get_wrapper_attr(attr_name) for env in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Give some environments an attribute."""
        for env in self._chosen(indices):
            env.set_wrapper_attr(attr_name, value)

    def env_method(self, method_name: str, *method_args, indices: VecEnvIndices = None, **method_kwargs) -> list[Any]:
        """Results of a method of some environments."""
        return [env.get_wrapper_attr(method_name)(*method_args, **method_kwargs) for env in self._chosen(indices)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """False for each of some environments: they have no wrappers."""
        return [False for _ in self._chosen(indices)]

    def _chosen(self, indices: VecEnvIndices) -> Sequence[gym.Env]:
        envs = self.envs.unwrapped.envs  # type: ignore[attr-defined]
        return [envs[index] for index in self._get_indices(indices)]
