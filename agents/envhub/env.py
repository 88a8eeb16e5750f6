"""The environments for LeRobot 0.6: `make_env` for its EnvHub, `--env.type=surgsim` for `lerobot-eval`.

    lerobot-eval --env.discover_packages_path=agents.envhub --env.type=surgsim --env.task=SurgSim/Palpate-v0 \
        --env.cameras='[endoscope]' --policy.path=outputs/train/palpate/checkpoints/last/pretrained_model
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from numpy.typing import NDArray

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_env.coupling import tip_wrench

# Default: all with control steps as steps.
IDS = ("SurgSim/Palpate-v0", "SurgSim/Retract-v0", "SurgSim/BimanualRetract-v0")
# LeRobot's names in data sets, by LeRobot's names in observations of environments.
NAMES = {"agent_pos": "observation.state", "meta.force_torque": "observation.meta.force_torque"}


def observe(env: gym.Env, cameras: list[str]) -> dict[str, Any]:
    """State in SI units, wrench on the tip [N, N m] and pictures (height, width, 3) of this moment."""
    inner: Any = env.unwrapped
    numbers = {"agent_pos": inner.task_observation, "meta.force_torque": tip_wrench(inner.simulation)}
    pictures = {camera: inner.renderer.rgb(camera) for camera in cameras}
    return numbers | ({"pixels": pictures} if pictures else {})


def make_single(env_id: str, cameras: list[str], arguments: dict[str, Any]) -> gym.Env:
    """One environment for LeRobot."""
    return LeRobotEnv(gym.make(env_id, render_mode="rgb_array", show_force=False, **arguments), cameras)


class LeRobotEnv(gym.Wrapper):
    """An environment with the observations of data sets (`agents/lerobot_dataset.py`).

    Args:
        env: made with gym.make.
        cameras: of the observed pictures.
    """

    def __init__(self, env: gym.Env, cameras: list[str]) -> None:
        super().__init__(env)
        self.cameras, self.task_description = cameras, describe_task(env)
        task: Any = env.unwrapped.task  # type: ignore[attr-defined]
        # LeRobot asks for it by this name; where episodes are of presses, a step is a press.
        self._max_episode_steps = task.episode_steps or task.budget
        env.reset(seed=0)
        self.observation_space = _space(observe(env, cameras))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; LeRobot's own options are left out."""
        _, info = self.env.reset(seed=seed)
        return observe(self.env, self.cameras), info

    def step(self, action: NDArray[np.float32]) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment; a network's actions beyond [-1, 1] are clipped."""
        _, reward, terminated, truncated, info = self.env.step(np.clip(action, -1.0, 1.0))
        return observe(self.env, self.cameras), reward, terminated, truncated, info


def describe_task(env: gym.Env) -> str:
    """The task as an instruction in words: the first line of its docstring."""
    task: Any = env.unwrapped.task  # type: ignore[attr-defined]
    return type(task).__doc__.strip().splitlines()[0]


def _space(value: Any) -> gym.Space:
    if isinstance(value, dict):
        return gym.spaces.Dict({name: _space(part) for name, part in value.items()})
    if value.dtype == np.uint8:
        return gym.spaces.Box(0, 255, value.shape, np.uint8)
    return gym.spaces.Box(-np.inf, np.inf, value.shape, np.float32)


@EnvConfig.register_subclass("surgsim")
@dataclass
class SurgSimConfig(EnvConfig):
    """Options `--env.*` of `lerobot-eval`.

    Args:
        task: id of the environment.
        cameras: of the observed pictures.
        arguments: of the environment.
    """

    task: str | None = "SurgSim/Retract-v0"
    fps: int = 20
    cameras: list[str] = field(default_factory=list)
    arguments: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        env = make_single(str(self.task), self.cameras, self.arguments)
        spaces: Any = env.observation_space
        action_shape = env.action_space.shape or ()
        self.features = {"action": PolicyFeature(FeatureType.ACTION, action_shape)}
        self.features_map = {"action": "action"}
        for name, lerobot_name in NAMES.items():
            self.features[name] = PolicyFeature(FeatureType.STATE, spaces[name].shape)
            self.features_map[name] = lerobot_name
        for camera in self.cameras:
            self.features[camera] = PolicyFeature(FeatureType.VISUAL, spaces["pixels"][camera].shape)
            self.features_map[camera] = f"observation.images.{camera}"
        env.close()

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of the environment."""
        return self.arguments

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """`make_env` of these options."""
        return make_env(n_envs, use_async_envs, self)


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, cfg: EnvConfig | None = None
) -> dict[str, dict[int, gym.vector.VectorEnv]]:
    """Vector environments by id, for LeRobot's EnvHub.

    Args:
        n_envs: side by side.
        use_async_envs: each in a process of its own, if there are several.
        cfg: names id, cameras and arguments; None: all of IDS, by state and wrench.
    """
    kind: Any = gym.vector.AsyncVectorEnv if use_async_envs and n_envs > 1 else gym.vector.SyncVectorEnv
    ids = IDS if cfg is None else (str(cfg.task),)
    cameras, arguments = getattr(cfg, "cameras", []), getattr(cfg, "arguments", {})
    # LeRobot reads successes of the `final_info` that this mode gives.
    mode = gym.vector.AutoresetMode.SAME_STEP
    return {
        env_id: {0: kind([partial(make_single, env_id, cameras, arguments)] * n_envs, autoreset_mode=mode)}
        for env_id in ids
    }
