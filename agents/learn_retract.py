"""Learn SurgSim/Retract-v0 from the scripted expert with DAgger: the policy plays, the expert labels.

    python -m agents.learn_retract --rounds 6 --out runs/retract_dagger.safetensors
    python -m agents.learn_retract --rounds 6 --without-force --out runs/retract_dagger_without_force.safetensors

With `--without-force` the policy sees 0 in place of the jaw's wrench, its grip and its pull; the expert sees all
channels. The result is a policy of stable-baselines3's PPO, from which `surgsim train` can start (`warm_start`).
"""

import argparse
import json
import time
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from numpy.typing import NDArray

import surgsim_env  # noqa: F401  (registers the ids)
from agents.command_line import one_line_errors
from surgsim_env.scoring.expert_retract import RetractExpert

with one_line_errors(__name__, "agents"):
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    from surgsim_env.envs.stable_baselines import VectorEnvForStableBaselines
    from surgsim_env.training.environments import blinded
    from surgsim_env.training.imitation import CloningOptions, dagger
    from surgsim_env.training.policy_files import describe, policy_path, save_policy

ID = "SurgSim/Retract-v0"
# The same as in the configurations of `surgsim train` that start from the result.
NETWORK = {"net_arch": [128, 128], "activation_fn": torch.nn.Tanh}
# Training seeds; scores use seeds from 1,000,000, periodic evaluations from 500,000.
FIRST_SEED = 2_000_000


class SeeingExpert:
    """The expert in each environment; it sees the unmodified observation, whatever the policy is shown."""

    def __init__(self, envs: VectorEnv) -> None:
        self._singles = [env.unwrapped for env in envs.unwrapped.envs]  # type: ignore[attr-defined]
        self._expert = RetractExpert()

    def __call__(self, observations: NDArray, begun: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Actions (n_env, 5); both arguments are the policy's."""
        return np.array([self._expert.act(one.task_observation) for one in self._singles])


class Blind(VectorWrapper):
    """Environments with some entries of their observations set to 0; `final_obs` is not changed.

    Gymnasium's own wrapper refuses environments that reset in the same step.
    """

    def __init__(self, envs: VectorEnv, entries: Sequence[int]) -> None:
        super().__init__(envs)
        self._entries = list(entries)

    def reset(self, **kwargs: Any) -> tuple[NDArray, dict[str, Any]]:
        """Start an episode everywhere."""
        observations, info = self.env.reset(**kwargs)
        return blinded(observations, self._entries), info

    def step(self, actions: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray, dict[str, Any]]:
        """One control step of all."""
        observations, *rest = self.env.step(actions)
        return (blinded(observations, self._entries), *rest)  # type: ignore[return-value]


def learn(arguments: argparse.Namespace) -> None:
    """Run DAgger; save the policy and print a line of figures after each round."""
    torch.set_num_threads(1)
    # DAgger requires environments that reset in the same step.
    lanes = {"vectorization_mode": "vector_entry_point", "autoreset_mode": "SameStep", "dtype": arguments.dtype}
    envs = gym.make_vec(ID, num_envs=arguments.envs, threads=arguments.threads, **lanes)
    expert = SeeingExpert(envs)
    entries = list(envs.unwrapped.envs[0].unwrapped.task.force_entries) if arguments.without_force else []  # type: ignore[attr-defined]
    normalisation = VecNormalize(VectorEnvForStableBaselines(envs), norm_reward=False)
    model = PPO("MlpPolicy", normalisation, policy_kwargs=NETWORK, seed=arguments.seed, device="cpu")
    options = CloningOptions(epochs=arguments.epochs, patience=15, std=0.05, seed=arguments.seed)
    began, rounds = time.time(), []
    for done in dagger(
        Blind(envs, entries),
        expert,
        model,
        rounds=arguments.rounds,
        steps=arguments.steps,
        expert_share=lambda index: 1.0 if index == 0 else 0.3 if index == 1 else 0.0,
        disturbance=arguments.disturbance,
        normalisation=normalisation,
        options=options,
        seed=FIRST_SEED + 10_000 * arguments.seed,
    ):
        rounds.append({**vars(done), "seconds": round(time.time() - began)})
        print(json.dumps(rounds[-1]), flush=True)
        description = describe(
            model,
            normalisation,
            envs.unwrapped.envs[0],  # type: ignore[attr-defined]
            env_id=ID,
            force_entries=entries,
            trained_steps=done.sample_count,
            seed=arguments.seed,
        )
        save_policy(model.policy, description, arguments.out)
    envs.close()


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=policy_path, required=True, help="the policy's file, NAME.safetensors")
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--steps", type=int, default=170, help="control steps of each environment in a round")
    parser.add_argument("--envs", type=int, default=16)
    parser.add_argument("--epochs", type=int, default=200, help="of each fit, at most")
    parser.add_argument("--disturbance", type=float, default=0.06, help="noise on actions while it plays, full scale 1")
    parser.add_argument("--dtype", choices=("float64", "float32"), default="float32")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--without-force", action="store_true")
    learn(parser.parse_args())


if __name__ == "__main__":
    with one_line_errors(__name__, "agents"):
        main()
