"""Train SurgSim/Palpate-v0 with PPO of Ray RLlib, two workers with eight organs each in lanes, and score the result.

    python -m agents.train_rllib --iterations 500
    surgsim evaluate --agent agents.train_rllib:Trained --env SurgSim/Palpate-v0 --level standard \
        --env-arguments '{"memory": true}'

RLlib's own `PPOConfig` and `ray.tune` have the rest: checkpoints, clusters, searches.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import ray
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.rl_module import RLModule
from ray.tune.registry import register_env

from surgsim_apps.cli.main import exit_status
from surgsim_apps.reports.output_folder import lone_run, output_folder

ENV_ID, ENV_KWARGS = "SurgSim/Palpate-v0", {"scene": "phantom", "level": "standard", "memory": True}
MODULE = Path("runs/rllib/module")


def make_env(context: dict[str, Any]) -> Any:
    """One environment, or several in lanes for RLlib; it runs in the workers."""
    import surgsim_env  # noqa: F401  (registers the ids)

    if "num_envs" not in context:
        return gym.make(ENV_ID, **ENV_KWARGS)
    return gym.make_vec(ENV_ID, context["num_envs"], "vector_entry_point", **ENV_KWARGS)


class Trained:
    """An agent for `surgsim evaluate`: the mean actions of the module in MODULE."""

    def reset(self, rng: np.random.Generator, facts: Any) -> None:
        """Read the module."""
        self.module: Any = RLModule.from_checkpoint(MODULE.resolve())

    def act(self, observation: np.ndarray) -> np.ndarray:
        """The action (4,) for an observation."""
        outputs = self.module.forward_inference({"obs": torch.as_tensor(observation[None])})
        mean = outputs["action_dist_inputs"][0].detach().numpy()[: self.module.action_space.shape[0]]
        return np.clip(mean, -1.0, 1.0)


def main() -> None:
    """Train, print a line for each iteration, and save the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=500)
    parser.add_argument("--batch", type=int, default=2048, help="control steps of an iteration")
    options = parser.parse_args()
    with lone_run(MODULE):
        learn(options)


def learn(options: argparse.Namespace) -> None:
    """Train and save by the options of the command line."""
    ray.init(address="local", include_dashboard=False)
    register_env(ENV_ID, make_env)
    # The first environment on a machine compiles its kernels, for minutes.
    runners = {"num_env_runners": 2, "num_envs_per_env_runner": 8, "gym_env_vectorize_mode": "vector_entry_point"}
    config = PPOConfig().environment(ENV_ID).env_runners(**runners, sample_timeout_s=900.0)
    config.training(train_batch_size_per_learner=options.batch, minibatch_size=256, lr=3e-4, gamma=0.995)
    algorithm = config.build_algo()
    for iteration in range(options.iterations):
        result = algorithm.train()["env_runners"]
        print(f"iteration {iteration}: return {result.get('episode_return_mean', float('nan')):.2f}", flush=True)
    with output_folder(MODULE) as files:
        algorithm.get_module().save_to_path(str(files.part))
    algorithm.stop()
    ray.shutdown()


if __name__ == "__main__":
    sys.exit(exit_status(main))
