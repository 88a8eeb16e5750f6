"""The ids of the environments, as Gymnasium knows them."""

import gymnasium as gym

from surgsim_env.tasks import palpate, retract


def register() -> None:
    """Register the environment ids with Gymnasium; importing `surgsim_env` does it."""
    if "SurgSim/Palpate-v0" in gym.registry:
        return
    gym.register(
        id="SurgSim/Palpate-v0",
        entry_point="surgsim_env.env:PalpateEnv",
        vector_entry_point="surgsim_env.vector_env:PalpateVectorEnv",
        max_episode_steps=palpate.EPISODE_STEPS,
    )
    gym.register(
        id="SurgSim/PalpateSites-v0",
        entry_point="surgsim_env.palpate_sites_env:PalpateSitesEnv",
        vector_entry_point="surgsim_env.palpate_sites_env:PalpateSitesVectorEnv",
    )
    gym.register(
        id="SurgSim/Retract-v0",
        entry_point="surgsim_env.env:RetractEnv",
        vector_entry_point="surgsim_env.vector_env:RetractVectorEnv",
        max_episode_steps=retract.EPISODE_STEPS,
    )
    gym.register(
        id="SurgSim/BimanualRetract-v0",
        entry_point="surgsim_env.env:BimanualRetractEnv",
        max_episode_steps=retract.EPISODE_STEPS,
    )
