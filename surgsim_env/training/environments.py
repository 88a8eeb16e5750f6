"""The vector environments of a run's configuration, and wrappers of stable-baselines3's vector environments."""

from collections.abc import Callable, Sequence

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from surgsim_env.envs.stable_baselines import VectorEnvForStableBaselines
from surgsim_env.training.config import EnvironmentSettings, Stage
from surgsim_env.training.site_policy import CHOICE_SPACE, FEATURE_SPACE, belief_features, site_actions


def make_environments(settings: EnvironmentSettings, count: int | None = None) -> VecEnv:
    """The environments with all wrappers except the normalisation."""
    envs = _bare(settings, settings.count if count is None else count)
    if settings.action_repeat > 1:
        envs = RepeatedAction(envs, settings.action_repeat)
    if settings.without_force:
        envs = WithoutForce(envs, force_entries(envs))
    if settings.belief:
        envs = BelievingEnvs(envs)
    return EpisodeMonitor(envs)


def observed_environment(settings: EnvironmentSettings, envs: VecEnv) -> gym.Env:
    """An environment whose observation a policy of these reads: one of them, or the one that a surrogate stands for."""
    if settings.kind == "bells":
        return gym.make(settings.id, **settings.kwargs).unwrapped
    return envs.get_attr("unwrapped", indices=[0])[0]


def force_entries(envs: VecEnv) -> list[int]:
    """Entries of the observation that depend on force sensing, by the task's `force_entries`.

    Raises:
        ValueError: the task has no `force_entries`.
    """
    task = envs.get_attr("unwrapped", indices=[0])[0].task
    if not hasattr(task, "force_entries"):
        raise ValueError(
            f"{type(task).__name__} does not declare which entries of its observation are forces: give it "
            "`force_entries`, or train with without_force: false"
        )
    return list(task.force_entries)


def _bare(settings: EnvironmentSettings, count: int) -> VecEnv:
    if settings.kind == "lanes":
        envs = gym.make_vec(
            settings.id,
            num_envs=count,
            vectorization_mode="vector_entry_point",
            autoreset_mode="SameStep",
            dtype=settings.dtype,
            threads=settings.threads,
            **settings.kwargs,
        )
        return VectorEnvForStableBaselines(envs)
    if settings.kind == "library":
        from surgsim_env.training.press_library import PressLibraryEnv

        return DummyVecEnv([lambda: PressLibraryEnv(settings.library, **settings.kwargs)] * count)
    if settings.kind == "bells":
        from surgsim_env.training.bell_sites import BellFaces
        from surgsim_env.training.site_surrogate import SiteSurrogate

        return DummyVecEnv([lambda: SiteSurrogate(BellFaces())] * count)
    if settings.kind == "surrogate":
        from surgsim_env.training.palpate_surrogate import PalpateSurrogate

        # As gym.make: no level unless one is given.
        return VectorEnvForStableBaselines(PalpateSurrogate(count, **{"level": None, **settings.kwargs}))
    return DummyVecEnv([lambda: gym.make(settings.id, **settings.kwargs)] * count)


# ---- wrappers -------------------------------------------------------------------------------------------------------


class RepeatedAction(VecEnvWrapper):
    """One decision lasts `count` control steps; their rewards are summed.

    If an episode ends within a decision, its environment, which has begun the next episode, gets zero actions for the
    rest of the decision; the rewards of those steps count for the next episode.
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


class StagedRewards(VecEnvWrapper):
    """Environments whose rewards are those of a stage of the curriculum.

    The reward of a failure is multiplied by `stage.failure`, term by term, and each site of the touch map that is felt
    for the first time in an episode pays `stage.novelty`.

    Attributes:
        stage: the current one; it may be replaced between steps
    """

    def __init__(self, envs: VecEnv, stage: Stage) -> None:
        """Begin with a stage.

        Raises:
            ValueError: novelty is paid, and the observation has no map of what was felt.
        """
        super().__init__(envs)
        task = envs.get_attr("unwrapped", indices=[0])[0].task
        self.failure_terms = [f"reward_{one.name}" for one in task.rewards if one.per in ("failure", "step left")]
        self.found = sum(one.weight for one in task.rewards if one.per == "success")
        self.visited: slice | None = task.observation_slices.get("visited")
        self._felt = np.zeros(envs.num_envs)
        self._stage = self._checked(stage)

    @property
    def stage(self) -> Stage:
        """The current stage."""
        return self._stage

    @stage.setter
    def stage(self, stage: Stage) -> None:
        self._stage = self._checked(stage)

    def _checked(self, stage: Stage) -> Stage:
        if stage.novelty and self.visited is None:
            raise ValueError(
                f"the stage that begins at {stage.begin} pays {stage.novelty} for a site felt for the first time, and "
                "the observation has no touch map: train SurgSim/Palpate-v0 with kwargs {memory: true}, or leave "
                "novelty out"
            )
        return stage

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
        paid += self._stage.novelty * np.where(done, 0.0, felt - self._felt)
        self._felt = felt
        for index in np.flatnonzero(done):
            cost = sum(float(infos[index][name]) for name in self.failure_terms)
            # A declaration has an error of at least 0 mm, other ends one of -1 mm.
            close = not infos[index]["success"] and 0.0 <= infos[index].get("error_mm", -1.0) <= 1e3 * self._stage.near
            paid[index] += self.found - cost if close else -(1.0 - self._stage.failure) * cost
        return observation, paid, done, infos

    def _count(self, observation: VecEnvObs) -> np.ndarray:
        if self.visited is None:
            return np.zeros(self.num_envs)
        return np.asarray(observation)[:, self.visited].sum(axis=1)


class Observed(VecEnvWrapper):
    """Environments whose observations pass through a function, those at the end of an episode too."""

    def __init__(self, envs: VecEnv, see: Callable[[np.ndarray], np.ndarray], **spaces: gym.Space) -> None:
        super().__init__(envs, **spaces)
        self.see = see
        # The observations as they are, of the last reset or step.
        self.unseen = np.zeros(0)

    def reset(self) -> VecEnvObs:
        """Start an episode everywhere."""
        self.unseen = np.asarray(self.venv.reset())
        return self.see(self.unseen)

    def step_wait(self) -> VecEnvStepReturn:
        """One step of all."""
        observation, reward, done, infos = self.venv.step_wait()
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = self.see(info["terminal_observation"][None])[0]
        self.unseen = np.asarray(observation)
        return self.see(self.unseen), reward, done, infos


class WithoutForce(Observed):
    """Observations with the entries of the force sensor set to 0."""

    def __init__(self, envs: VecEnv, entries: Sequence[int]) -> None:
        super().__init__(envs, lambda observation: blinded(observation, entries))


class BelievingEnvs(Observed):
    """Environments of SurgSim/PalpateSites-v0 whose observation is the belief and whose action is a site's number."""

    def __init__(self, envs: VecEnv) -> None:
        super().__init__(envs, belief_features, observation_space=FEATURE_SPACE, action_space=CHOICE_SPACE)

    def step_async(self, actions: np.ndarray) -> None:
        """Press the sites (n_env,)."""
        self.venv.step_async(site_actions(self.unseen, actions))


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
