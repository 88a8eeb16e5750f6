"""A wrapper that gives each episode's pictures a random look."""

from typing import Any

import gymnasium as gym

from surgsim_env.envs.surgical_env import SurgicalEnv
from surgsim_env.rendering.looks import LookRanges


class RandomLooks(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Episodes with random looks: where the camera is, its field of view, lights, colours, vessels, gloss and noise.

    A look is drawn at each reset from random numbers that follow from the seed of the reset, and from which the
    environment draws nothing else: the same seed gives the same pictures, and all but the pictures is as without looks.
    The same as the argument `looks` of an environment, which environments side by side take too.

        env = RandomLooks(gym.make("SurgSim/Retract-v0", obs_mode="rgb"), "train")
    """

    def __init__(self, env: gym.Env, looks: str | LookRanges = "train") -> None:
        """Draw looks from the next reset on.

        Args:
            env: any environment of ours that observes or renders pictures.
            looks: the split "train" or "test", or ranges of your own.

        Raises:
            ValueError: an environment that is not ours or draws no picture, or an unknown split (lists the known).
        """
        gym.utils.RecordConstructorArgs.__init__(self, looks=looks)
        super().__init__(env)
        inner = env.unwrapped
        if not isinstance(inner, SurgicalEnv):
            raise ValueError(f"{type(inner).__name__} has no looks: wrap an environment of surgsim_env")
        inner.take_looks(looks)
