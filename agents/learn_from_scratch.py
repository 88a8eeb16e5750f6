"""Learn SurgSim/Retract-v0 from random weights with PPO of stable-baselines3, without an expert: two hours of a core.

    python -m agents.learn_from_scratch --seed 2
    surgsim evaluate --policy runs/retract-seed2/policy.json

Sixteen lobes side by side; failures cost nothing. The run's folder holds the policy, `progress.csv`, and checkpoints
of stable-baselines3 (pickles: load only runs of your own). Palpation: docs/tutorials/train_an_agent.md.
"""

import argparse
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecMonitor, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_apps.cli.main import exit_status
from surgsim_apps.reports.output_folder import lone_run
from surgsim_apps.training.policy_files import PolicyDescription, observation_declaration, save_policy
from surgsim_apps.training.policy_network import NetworkLayout, actor_of
from surgsim_env import VectorEnvForStableBaselines

ENV_ID = "SurgSim/Retract-v0"
# Control steps of a decision.
REPEAT = 5
HIDDEN = (128, 128)
# First standard deviation of each entry of the action.
SPREAD = (0.5, 0.5, 0.5, 0.2, 0.8)
DECISIONS = 30_720
# First seed of the environments; scores use seeds from 1,000,000.
TRAINING_SEED = 2_000_000


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


def train(folder: Path, seed: int, *, count: int = 16, decisions: int = DECISIONS, rollout: int = 64) -> PPO:
    """Train with `count` environments and `rollout` decisions of each before an update, and write the policy."""
    torch.set_num_threads(1)
    lanes = {"vectorization_mode": "vector_entry_point", "autoreset_mode": "SameStep", "dtype": "float32"}
    made = gym.make_vec(ENV_ID, num_envs=count, failure_share=0.0, **lanes)
    envs = VecNormalize(
        VecMonitor(RepeatedAction(VectorEnvForStableBaselines(made), REPEAT)), norm_obs=False, gamma=0.99
    )
    envs.seed(TRAINING_SEED + 100_000 * seed)
    network = {"net_arch": list(HIDDEN), "activation_fn": torch.nn.Tanh}
    model = PPO("MlpPolicy", envs, n_steps=rollout, batch_size=128, policy_kwargs=network, seed=seed, device="cpu")
    with torch.no_grad():
        model.policy.log_std.copy_(torch.tensor(SPREAD).log())
    model.set_logger(configure(str(folder), ["stdout", "csv"]))
    model.learn(decisions, CheckpointCallback(max(1, decisions // count // 10), str(folder)))
    description = PolicyDescription(
        env_id=ENV_ID,
        observation=observation_declaration(envs.get_attr("unwrapped", indices=[0])[0]),
        action_repeat=REPEAT,
        trained_steps=model.num_timesteps,
        seed=seed,
    )
    save_policy(actor_of(model.policy, NetworkLayout("tanh"), drawn=True), description, folder / "policy.json")
    return model


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="the run's folder; runs/retract-seedSEED otherwise")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    folder = options.out or Path("runs") / f"retract-seed{options.seed}"
    with lone_run(folder / "policy.json"):
        model = train(folder, options.seed)
    print(f"{model.num_timesteps} decisions; policy in {folder}/policy.json")


if __name__ == "__main__":
    sys.exit(exit_status(main))
