"""Wrappers of stable-baselines3's vector environments: action repeat, removal of force, episode figures."""

from collections.abc import Sequence

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn


class RepeatedAction(VecEnvWrapper):
    """One decision lasts `count` control steps; their rewards are summed.

    If an episode ends within a decision, its environment, which has begun the next episode, gets zero actions for the
    rest of the decision; the rewards of those steps count for the next episode.
    """

    def __init__(self, envs: VecEnv, count: int) -> None:
        super().__init__(envs)
        self.count = count
        self._actions = np.zeros((0,))
        self._carried = np.zeros(envs.num_envs)

    def reset(self) -> VecEnvObs:
        """Start an episode everywhere."""
        self._carried[:] = 0.0
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions (n_env, n_action) for `step_wait`."""
        self._actions = np.array(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """One decision of all."""
        total, over = self._carried.copy(), np.zeros(self.num_envs, dtype=np.bool_)
        self._carried[:] = 0.0
        ended: dict[int, dict] = {}
        for _ in range(self.count):
            observation, reward, done, infos = self.venv.step(self._actions)
            total += np.where(over, 0.0, reward)
            self._carried += np.where(over, reward, 0.0)
            # An episode that ended during these zero actions would be lost, but no task ends so soon.
            for index in np.flatnonzero(done & ~over):
                ended[int(index)] = infos[index]
            over |= done
            self._actions[over] = 0.0
        infos = [ended.get(index, info) for index, info in enumerate(infos)]
        return observation, total.astype(np.float32), over, infos


class WithoutForce(VecEnvWrapper):
    """Observations with the entries of the force sensor set to 0."""

    def __init__(self, envs: VecEnv, entries: Sequence[int]) -> None:
        super().__init__(envs)
        self.entries = list(entries)

    def reset(self) -> VecEnvObs:
        """Start an episode everywhere."""
        return blinded(self.venv.reset(), self.entries)

    def step_wait(self) -> VecEnvStepReturn:
        """One step of all."""
        observation, reward, done, infos = self.venv.step_wait()
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = blinded(info["terminal_observation"], self.entries)
        return blinded(observation, self.entries), reward, done, infos


class EpisodeMonitor(VecMonitor):
    """Reports return, length and success of finished episodes to stable-baselines3's logger."""

    def step_wait(self) -> VecEnvStepReturn:
        """One step of all."""
        observation, reward, done, infos = super().step_wait()
        for index in np.flatnonzero(done):
            if "success" in infos[index]:
                infos[index]["is_success"] = bool(infos[index]["success"])
        return observation, reward, done, infos


def blinded(observation: VecEnvObs, entries: Sequence[int]) -> np.ndarray:
    """A copy of observations (..., n) with some entries set to 0."""
    seen = np.array(observation)
    seen[..., list(entries)] = 0.0
    return seen
