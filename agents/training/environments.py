"""The vector environments of a run, as its configuration asks for them."""

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

import surgsim_env  # noqa: F401  (registers the ids)
from agents.site_belief import BeliefSettings, BelievingEnvs, SiteBelief
from agents.training.config import EnvironmentSettings
from agents.training.wrappers import EpisodeMonitor, RepeatedAction, WithoutForce
from surgsim_env.stable_baselines import VectorEnvForStableBaselines

# Seeds of training episodes lie above these, those of its evaluation are the latter and on; a benchmark's lie apart
# from both (`surgsim_env.evaluation.palpation.EVALUATION_SEEDS`, from 1,000,000 to 1,000,099).
TRAINING_SEEDS_FROM = 2_000_000
EVALUATION_SEED = 500_000


def make_environments(settings: EnvironmentSettings, count: int | None = None) -> VecEnv:
    """The environments with their wrappers, but for the normalisation."""
    count = settings.count if count is None else count
    envs = _bare(settings, count)
    if settings.action_repeat > 1:
        envs = RepeatedAction(envs, settings.action_repeat)
    if settings.without_force:
        envs = WithoutForce(envs, force_entries(envs))
    if settings.belief:
        envs = BelievingEnvs(envs, SiteBelief(belief_settings(envs)))
    return EpisodeMonitor(envs)


def normalized(envs: VecEnv, settings: EnvironmentSettings, gamma: float) -> VecEnv:
    """The same, observations and rewards scaled as the settings say."""
    if not settings.normalize_observation and not settings.normalize_reward:
        return envs
    return VecNormalize(
        envs, norm_obs=settings.normalize_observation, norm_reward=settings.normalize_reward, gamma=gamma
    )


def training_seed(seed: int, steps: int) -> int:
    """First seed of the environments' episodes, another one for each start of a run."""
    drawn = int(np.random.SeedSequence([seed, steps]).generate_state(1)[0])
    return TRAINING_SEEDS_FROM + drawn % (2**31 - 2 * TRAINING_SEEDS_FROM)


def force_entries(envs: VecEnv) -> list[int]:
    """Entries of the observation that come from a force sensor, as the task says.

    Raises:
        ValueError: the task says nothing of it.
    """
    task = envs.get_attr("unwrapped", indices=[0])[0].task
    if not hasattr(task, "force_entries"):
        raise ValueError(
            f"{type(task).__name__} does not say which entries of its observation are forces: give it `force_entries`, "
            "or train with without_force: false"
        )
    return list(task.force_entries)


def belief_settings(envs: VecEnv) -> BeliefSettings:
    """What the belief of environments of SurgSim/PalpateSites-v0 is built on."""
    task = envs.get_attr("unwrapped", indices=[0])[0].task
    estimator = task.estimator
    return BeliefSettings(
        extent=tuple(estimator.extent.tolist()),
        site_count=task.site_count,
        tip_radius=estimator.tip_radius,
        noise=estimator.noise,
    )


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
        from agents.press_library import PressLibraryEnv

        return DummyVecEnv([lambda: PressLibraryEnv(settings.library, **settings.kwargs)] * count)
    if settings.kind == "surrogate":
        from agents.palpate_surrogate import PalpateSurrogate

        chosen = {name: value for name, value in settings.kwargs.items() if name != "level"}
        return VectorEnvForStableBaselines(PalpateSurrogate(count, **chosen))
    return DummyVecEnv([lambda: gym.make(settings.id, **settings.kwargs)] * count)
