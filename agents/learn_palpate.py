"""Teach a network the scripted expert of SurgSim/Palpate-v0 on a fast surrogate with a force formula.

    python -m agents.learn_palpate --scene phantom --out runs/palpate_phantom_cloned.safetensors

The expert labels synthetic observations all over the face (`imagined`) and the states that the network reaches (DAgger,
Ross, Gordon & Bagnell 2011). PPO continues from the result: `warm_start` in agents/configs/palpate_*.yaml.
"""

import argparse
import time

import numpy as np
from numpy.typing import NDArray

from agents.command_line import one_line_errors
from surgsim_env.palpation.chart import MAP_SIDE
from surgsim_env.scoring.expert_palpate import PalpateExpert
from surgsim_env.training.palpate_surrogate import PalpateSurrogate

with one_line_errors(__name__, "agents"):
    import torch
    from stable_baselines3 import PPO

    from surgsim_env.envs.stable_baselines import VectorEnvForStableBaselines
    from surgsim_env.training.environments import blinded
    from surgsim_env.training.extractors import MemorySummary
    from surgsim_env.training.imitation import CloningOptions, clone
    from surgsim_env.training.policy_files import TrainedPolicy, describe, policy_path, save_policy

NETWORK = {"net_arch": [128, 128], "activation_fn": torch.nn.Tanh, "features_extractor_class": MemorySummary}
# Rounds that the expert plays, with random errors, so that the data show how to correct them.
EXPERT_ROUNDS = 2
ERROR, ERROR_KEPT = 0.3, 0.9


def play_round(
    envs: PalpateSurrogate,
    expert: PalpateExpert,
    policy: TrainedPolicy | None,
    steps: int,
    rng: np.random.Generator,
    begun: tuple[NDArray, NDArray[np.bool_]],
) -> tuple[list[NDArray], list[NDArray], list[float], tuple[NDArray, NDArray[np.bool_]]]:
    """Observations, the expert's actions there, successes, and the state to continue from.

    The policy plays, or the expert if there is none. Errors are first-order autoregressive noise on the action.
    """
    observation, begins = begun
    seen, labels, won = [], [], []
    error = np.zeros((envs.num_envs, 3))
    for _ in range(steps):
        wanted = expert.act(observation)
        seen.append(observation)
        labels.append(wanted)
        action = wanted.copy() if policy is None else policy.act(observation, begins)
        error = ERROR_KEPT * error + ERROR * rng.normal(size=error.shape) * [1.0, 1.0, 0.5]
        erring = 0.5 * error * (np.arange(envs.num_envs) % 2 == 0)[:, None]
        action[:, :3] = np.clip(action[:, :3] + erring, -1.0, 1.0)
        observation, _, terminated, truncated, info = envs.step(action)
        begins = terminated | truncated
        won += [float(info["final_info"]["success"][index]) for index in np.flatnonzero(begins)]
    return seen, labels, won, (observation, begins)


def imagined(
    observations: NDArray[np.float32], envs: PalpateSurrogate, expert: PalpateExpert, rng: np.random.Generator
) -> NDArray[np.float32]:
    """The same observations with the tip anywhere over the face, and the search not begun, in progress or over."""
    made, count = envs.envs[0].si_values(observations), len(observations)
    # Views of the channels.
    tip, force, visited, stiffest = (
        made[:, envs.task.observation_slices[name]] for name in ("tip_position", "contact_force", "visited", "stiffest")
    )
    low, high = envs.chart.lower - 0.005, envs.chart.upper + 0.005
    tip[:, :2] = rng.uniform(low, high, (count, 2))
    near = rng.random(count) < 0.7
    depth = np.where(near, rng.normal(expert.depth, 0.0005, count), rng.uniform(-0.008, 0.0045, count))
    tip[:, 2] = envs.surface - depth
    stiffness = envs.touch.stiffness * rng.uniform(0.6, 2.2, count)
    force[:, 2] = stiffness * np.maximum(depth, 0.0) ** envs.touch.exponent + rng.normal(0.0, 0.015, count)
    # Not begun, in progress, over.
    stage = rng.choice(3, count, p=[0.1, 0.5, 0.4])
    rows, columns = envs.map.rows_and_columns
    for row in rows[[0, -1]]:
        for column in columns[[0, -1]]:
            visited[:, row * MAP_SIDE + column] = np.where(stage == 2, 1.0, (stage == 1) & (rng.random(count) < 0.5))
    made[:, expert.first] = stage >= 1
    made[:, expert.last] = stage == 2
    stiffest[:, :2] = rng.uniform(-1.0, 1.0, (count, 2))
    # Some near the stiffest place, where the expert declares.
    close = (stage == 2) & (rng.random(count) < 0.4)
    spot = envs.chart.plane_point(stiffest[:, :2]) + rng.normal(0.0, 0.003, (count, 2))
    tip[close, :2] = spot[close]
    return envs.envs[0].as_observed(made)


def main() -> None:
    """Train; print a line and write the policy after each round."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="phantom")
    parser.add_argument("--out", type=policy_path, required=True, help="the policy's file, NAME.safetensors")
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--steps", type=int, default=200, help="steps of each environment in a round")
    parser.add_argument("--envs", type=int, default=128)
    parser.add_argument("--epochs", type=int, default=12, help="epochs of each round")
    parser.add_argument("--imagined", type=int, default=100_000, help="synthetic observations of a round")
    parser.add_argument("--seed", type=int, default=2_000_000)
    parser.add_argument(
        "--without-force", action="store_true", help="the network sees no force, nor quantities derived from it"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rng = np.random.default_rng(arguments.seed)
    envs = PalpateSurrogate(arguments.envs, arguments.scene)
    expert = PalpateExpert(envs.envs[0])
    entries = list(envs.task.force_entries) if arguments.without_force else []
    model = PPO("MlpPolicy", VectorEnvForStableBaselines(envs), policy_kwargs=NETWORK, device="cpu", seed=0)
    begun = (envs.reset(seed=arguments.seed)[0], np.ones(envs.num_envs, dtype=np.bool_))
    seen: list[NDArray] = []
    labels: list[NDArray] = []
    begin, policy = time.time(), None
    for index in range(arguments.rounds):
        played = policy if index >= EXPERT_ROUNDS else None
        new_seen, new_labels, won, begun = play_round(envs, expert, played, arguments.steps, rng, begun)
        seen += new_seen
        labels += new_labels
        real = np.concatenate(seen)
        made = imagined(real[rng.integers(len(real), size=arguments.imagined)], envs, expert, rng)
        options = CloningOptions(epochs=arguments.epochs, patience=4, batch_size=512, std=0.05, seed=index)
        curve = clone(
            model,
            blinded(np.concatenate([real, made]), entries),
            np.concatenate([*labels, expert.act(made)]),
            options=options,
        )
        success = np.mean(won) if won else float("nan")
        loss = curve.validation[curve.best]
        print(
            f"{time.time() - begin:6.0f} s round {index}: {len(won)} episodes, success {success:.2f}, loss {loss:.5f}",
            flush=True,
        )
        description = describe(
            model,
            None,
            envs.envs[0],
            env_id="SurgSim/Palpate-v0",
            env_kwargs={"scene": arguments.scene, "level": "standard", "memory": True},
            force_entries=entries,
            trained_steps=len(real),
        )
        save_policy(model.policy, description, arguments.out)
        policy = TrainedPolicy(model.policy, description)
        policy.reset(envs.num_envs)


if __name__ == "__main__":
    with one_line_errors(__name__, "agents"):
        main()
