"""Wrappers of stable-baselines3's vector environments for learning from scratch: repeated actions, staged rewards."""

from dataclasses import dataclass

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn


@dataclass(frozen=True)
class Stage:
    """Rewards of a part of the curriculum, beside the environment's own.

    Args:
        begin: number of decisions at its begin.
        failure: paid share of the reward terms of a failure (`per` "failure" or "step left"); below 1 a policy with
            failures by chance does not learn to do nothing instead.
        novelty: reward of each site of the touch map at its first touch in an episode (count-based exploration,
            Bellemare et al. 2016); for SurgSim/Palpate-v0 with memory.
        near: distance from the lesion [m] up to which a wrong declaration of SurgSim/Palpate-v0 is paid as a right one.
    """

    begin: int = 0
    failure: float = 1.0
    novelty: float = 0.0
    near: float = 0.0


class StagedRewards(VecEnvWrapper):
    """Environments with the rewards of `stage`, replaceable between steps."""

    def __init__(self, envs: VecEnv, stage: Stage) -> None:
        super().__init__(envs)
        first = envs.get_attr("unwrapped", indices=[0])[0]
        self.failure_terms = [
            f"reward_{term.name}" for term in first.task.rewards if term.per in ("failure", "step left")
        ]
        self.success_reward = sum(term.weight for term in first.task.rewards if term.per == "success")
        self.visited: slice = first.observation_slices.get("visited", slice(0))
        self.stage = stage
        self._felt = np.zeros(envs.num_envs)

    def reset(self) -> VecEnvObs:
        """Start an episode everywhere."""
        observation = self.venv.reset()
        self._felt = self._count(observation)
        return observation

    def step_wait(self) -> VecEnvStepReturn:
        """One step of all."""
        observation, reward, done, infos = self.venv.step_wait()
        paid = np.array(reward, dtype=np.float32)
        felt = self._count(observation)
        # The observation of an environment that is done is the first of its next episode.
        paid += self.stage.novelty * np.where(done, 0.0, felt - self._felt)
        self._felt = felt
        for index in np.flatnonzero(done):
            cost = sum(float(infos[index][name]) for name in self.failure_terms)
            # A declaration has an error of at least 0 mm, other ends one of -1 mm.
            close = not infos[index]["success"] and 0.0 <= infos[index].get("error_mm", -1.0) <= 1e3 * self.stage.near
            paid[index] += self.success_reward - cost if close else -(1.0 - self.stage.failure) * cost
        return observation, paid, done, infos

    def _count(self, observation: VecEnvObs) -> np.ndarray:
        """Number of felt sites in each environment (n_env,)."""
        return np.asarray(observation)[:, self.visited].sum(axis=1)


class RepeatedAction(VecEnvWrapper):
    """One decision lasts `count` control steps; their rewards are summed.

    After the end of an episode within a decision its environment, in the next episode already, gets zero actions until
    the decision ends; the rewards of those steps count for the next episode.
    """

    def __init__(self, envs: VecEnv, count: int) -> None:
        super().__init__(envs)
        self.count = count
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
