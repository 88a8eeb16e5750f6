"""SurgSim/BimanualRetract-v0 for two agents: a PettingZoo `ParallelEnv`; needs the extra `pettingzoo`."""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from surgsim_env.envs.ids import BimanualRetractEnv

# Entries of the joint action that are the left arm's: velocity, turning and jaw.
LEFT_SIZE = 7
AGENTS = ("left", "right")


class BimanualRetractParallelEnv(ParallelEnv):
    """The bimanual retraction with an agent for each arm, "left" and "right".

    Both observe what the joint environment observes and get its reward, and an episode ends for both at once; "left"
    acts with the first 7 numbers of the joint action (velocity, turning, jaw), "right" with the other 6 (velocity,
    turning). Documentation of these: `surgsim_env.envs.ids.BimanualRetractEnv`, whose arguments it takes.

        env = BimanualRetractParallelEnv()
        observations, infos = env.reset(seed=1)
        env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    """

    def __init__(self, **arguments: Any) -> None:
        """Make the joint environment with its own arguments."""
        self.joint = BimanualRetractEnv(**arguments)
        self.metadata = {**self.joint.metadata, "name": "bimanual_retract_v0", "is_parallelizable": True}
        self.render_mode = self.joint.render_mode
        self.possible_agents = list(AGENTS)
        self.agents: list[str] = []
        joint = self.joint.action_space
        assert isinstance(joint, gym.spaces.Box)
        self._parts: dict[str, slice] = {"left": slice(0, LEFT_SIZE), "right": slice(LEFT_SIZE, None)}
        self.observation_spaces: dict[str, gym.Space] = dict.fromkeys(AGENTS, self.joint.observation_space)
        self.action_spaces: dict[str, gym.Space] = {
            agent: gym.spaces.Box(joint.low[part], joint.high[part], dtype=np.float32)
            for agent, part in self._parts.items()
        }

    def observation_space(self, agent: str) -> gym.Space:
        """The space of both agents' observation; always the same object."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gym.Space:
        """The space of one arm's actions; always the same object."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, dict[str, Any]]]:
        """Draw an episode; observations and infos by agent. PettingZoo passes options; none is known or used."""
        observation, info = self.joint.reset(seed=seed)
        self.agents = list(AGENTS)
        return self._for_each(observation), {agent: dict(info) for agent in AGENTS}

    def step(
        self, actions: dict[str, NDArray[np.float32]]
    ) -> tuple[dict[str, NDArray[Any]], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """One control step of both arms; observations, rewards, ends and infos by agent.

        Raises:
            ValueError: an agent without an action, an unknown one, or an action of another shape.
            ResetNeeded: no episode is running.
        """
        if set(actions) != set(AGENTS):
            raise ValueError(f"actions are for {sorted(actions)}; give one for each of {', '.join(AGENTS)}")
        for agent in AGENTS:
            wanted = self.action_spaces[agent].shape
            if np.shape(actions[agent]) != wanted:
                raise ValueError(f"the action of {agent!r} has shape {np.shape(actions[agent])}; the rule is {wanted}")
        joint = np.concatenate([np.asarray(actions[agent], dtype=np.float32) for agent in AGENTS])
        observation, reward, terminated, truncated, info = self.joint.step(joint)
        if terminated or truncated:
            self.agents = []
        return (
            self._for_each(observation),
            dict.fromkeys(AGENTS, reward),
            dict.fromkeys(AGENTS, terminated),
            dict.fromkeys(AGENTS, truncated),
            {agent: dict(info) for agent in AGENTS},
        )

    def render(self) -> NDArray[np.uint8] | None:
        """The joint environment's picture."""
        return self.joint.render()

    def state(self) -> NDArray[Any]:
        """The joint observation, equal for both."""
        return self.joint.observation

    def close(self) -> None:
        """Close the joint environment."""
        self.joint.close()

    def _for_each(self, observation: NDArray[Any]) -> dict[str, NDArray[Any]]:
        return {agent: observation.copy() for agent in AGENTS}
