"""Teach a network what the scripted expert of SurgSim/Palpate-v0 does (DAgger), by formula first, then on the organ.

    python -m agents.learn_palpate --scene phantom --out runs/palpate_phantom_dagger.zip

PPO goes on from what comes out (`warm_start` in agents/configs/palpate_*.yaml).
"""

import argparse
import time
from pathlib import Path

import gymnasium as gym
import torch
from gymnasium.vector import VectorEnv
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from agents.cloning import CloningOptions
from agents.dagger import dagger
from agents.expert_palpate import PalpateExpert
from agents.palpate_surrogate import PalpateSurrogate
from agents.training.extractors import MemorySummary
from agents.training.policy_files import PolicyDescription, save_policy
from surgsim_env.stable_baselines import VectorEnvForStableBaselines

NETWORK = {"net_arch": [128, 128], "activation_fn": torch.nn.Tanh, "features_extractor_class": MemorySummary}


def organs(scene: str, count: int) -> VectorEnv:
    """The environments themselves, side by side."""
    return gym.make_vec(
        "SurgSim/Palpate-v0",
        num_envs=count,
        vectorization_mode="vector_entry_point",
        autoreset_mode="SameStep",
        dtype="float32",
        threads=1,
        scene=scene,
        level="standard",
        memory=True,
    )


def main() -> None:
    """Teach, printing a line a round, and write the policy after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="phantom")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--rounds", type=int, default=16, help="by formula")
    parser.add_argument("--organ-rounds", type=int, default=0, help="on the full physics")
    parser.add_argument("--steps", type=int, default=400, help="of each environment in a round")
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--seed", type=int, default=2_000_000)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    envs = PalpateSurrogate(arguments.envs, arguments.scene)
    scaled = VecNormalize(VectorEnvForStableBaselines(envs), norm_reward=False)
    model = PPO("MlpPolicy", scaled, policy_kwargs=NETWORK, device="cpu", seed=0)
    expert = PalpateExpert(envs.envs[0])
    begin = time.time()
    for stage in dagger(
        envs,
        lambda observations, _: expert.act(observations),
        model,
        rounds=arguments.rounds,
        steps=arguments.steps,
        expert_share=lambda index: 0.5**index if index < 3 else 0.0,
        normalisation=scaled,
        options=CloningOptions(epochs=8, patience=3, batch_size=256, std=0.05),
        seed=arguments.seed,
    ):
        print(f"{time.time() - begin:6.0f} s {stage}", flush=True)
        description = PolicyDescription(
            algorithm="PPO",
            env_id="SurgSim/Palpate-v0",
            env_kwargs={"scene": arguments.scene, "level": "standard", "memory": True},
            observation_mean=scaled.obs_rms.mean.tolist(),
            observation_variance=scaled.obs_rms.var.tolist(),
            trained_steps=stage.sample_count,
        )
        save_policy(model, description, arguments.out)


if __name__ == "__main__":
    main()
