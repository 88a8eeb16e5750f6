"""The vector environments of a run's configuration."""

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

import surgsim_env  # noqa: F401  (registers the ids)
from agents.scoring.site_agent import SiteFacts, site_facts
from agents.training.config import EnvironmentSettings
from agents.training.site_belief import BelievingEnvs, SiteBelief
from agents.training.wrappers import EpisodeMonitor, RepeatedAction, WithoutForce
from surgsim_env.envs.stable_baselines import VectorEnvForStableBaselines

# First seeds of training and of its periodic evaluation; scores use others
# (`surgsim_env.palpation.scores.EVALUATION_SEEDS`, from 1,000,000 to 1,000,099).
TRAINING_SEEDS_FROM = 2_000_000
EVALUATION_SEED = 500_000


def make_environments(settings: EnvironmentSettings, count: int | None = None) -> VecEnv:
    """The environments with all wrappers except the normalisation."""
    count = settings.count if count is None else count
    envs = _bare(settings, count)
    if settings.action_repeat > 1:
        envs = RepeatedAction(envs, settings.action_repeat)
    if settings.without_force:
        envs = WithoutForce(envs, force_entries(envs))
    if settings.belief:
        envs = BelievingEnvs(envs, SiteBelief(belief_facts(envs)))
    return EpisodeMonitor(envs)


def normalized(envs: VecEnv, settings: EnvironmentSettings, gamma: float) -> VecEnv:
    """The environments with normalised observations and rewards, according to the settings."""
    if not settings.normalize_observation and not settings.normalize_reward:
        return envs
    return VecNormalize(
        envs, norm_obs=settings.normalize_observation, norm_reward=settings.normalize_reward, gamma=gamma
    )


def training_seed(seed: int, steps: int) -> int:
    """First seed of the environments' episodes, different at each start of a run."""
    drawn = int(np.random.SeedSequence([seed, steps]).generate_state(1)[0])
    return TRAINING_SEEDS_FROM + drawn % (2**31 - 2 * TRAINING_SEEDS_FROM)


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


def belief_facts(envs: VecEnv) -> SiteFacts:
    """The constants of environments of SurgSim/PalpateSites-v0 that belief is computed with."""
    return site_facts(envs.get_attr("unwrapped", indices=[0])[0])


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
        from agents.training.press_library import PressLibraryEnv

        return DummyVecEnv([lambda: PressLibraryEnv(settings.library, **settings.kwargs)] * count)
    if settings.kind == "surrogate":
        from agents.training.palpate_surrogate import PalpateSurrogate

        chosen = {name: value for name, value in settings.kwargs.items() if name != "level"}
        return VectorEnvForStableBaselines(PalpateSurrogate(count, **chosen))
    return DummyVecEnv([lambda: gym.make(settings.id, **settings.kwargs)] * count)
