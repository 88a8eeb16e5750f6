"""Teach an LSTM the scripted expert of SurgSim/Palpate-v0 from observations without memory.

    python -m agents.learn_palpate_recurrent --scene phantom --out runs/palpate_phantom_recurrent_cloned.safetensors

The expert reads the contrast map from the observation; the network sees place and force alone and must remember the
rest, so whole episodes are cloned. First the expert plays, with random errors; then the network plays and the expert
labels its states.
"""

import argparse
import time

import numpy as np
from numpy.typing import NDArray

from agents.command_line import one_line_errors
from surgsim_env.scoring.expert_palpate import PalpateExpert
from surgsim_env.training.palpate_surrogate import PalpateSurrogate

with one_line_errors(__name__, "agents"):
    import torch
    from sb3_contrib import RecurrentPPO
    from stable_baselines3.common.vec_env import VecNormalize

    from agents.learn_palpate import ERROR, ERROR_KEPT
    from surgsim_env.envs.stable_baselines import VectorEnvForStableBaselines
    from surgsim_env.training.extractors import WITHOUT_MEMORY, PlaceAndForce
    from surgsim_env.training.imitation import CloningOptions, clone, normalise_by, pad
    from surgsim_env.training.policy_files import TrainedPolicy, describe, policy_path, save_policy

NETWORK = {
    "lstm_hidden_size": 96,
    "net_arch": [64],
    "activation_fn": torch.nn.Tanh,
    "features_extractor_class": PlaceAndForce,
}
# Entries of the observation without memory, which precede those of the memory.
SHORT = max(part.stop for part in WITHOUT_MEMORY.values())
# Weight of the steps back to the stiffest place, which are a tenth of an episode.
BACK_WEIGHT = 4.0


def play_episodes(
    envs: PalpateSurrogate,
    expert: PalpateExpert,
    policy: TrainedPolicy | None,
    steps: int,
    rng: np.random.Generator,
    repeat: int,
) -> tuple[list[NDArray], list[NDArray], list[NDArray], list[bool]]:
    """First episode of each environment: its short observations, the expert's actions, weights, success.

    A decision lasts `repeat` control steps; the steps between decisions are left out.
    """
    observation, _ = envs.reset(seed=int(rng.integers(2**31)))
    begins, running = np.ones(envs.num_envs, dtype=np.bool_), np.ones(envs.num_envs, dtype=np.bool_)
    length, won = np.zeros(envs.num_envs, dtype=np.int64), [False] * envs.num_envs
    error = np.zeros((envs.num_envs, 3))
    if policy is not None:
        policy.reset(envs.num_envs)
    seen, labels, weight = [], [], []
    for step in range(steps):
        if step % repeat == 0:
            wanted = expert.act(observation)
            seen.append(observation[:, :SHORT])
            labels.append(wanted)
            weight.append(np.where(observation[:, expert.last] > 0.5, BACK_WEIGHT, 1.0))
            error = ERROR_KEPT * error + ERROR * rng.normal(size=error.shape) * [1.0, 1.0, 0.5]
        action = wanted.copy() if policy is None else policy.act(observation[:, :SHORT], begins)
        erring = 0.4 * error * (np.arange(envs.num_envs) % 2 == 0)[:, None]
        action[:, :3] = np.clip(action[:, :3] + erring, -1.0, 1.0)
        length += running
        observation, _, terminated, truncated, info = envs.step(action)
        begins = terminated | truncated
        for index in np.flatnonzero(begins & running):
            won[index] = bool(info["final_info"]["success"][index])
        running &= ~begins
        if not running.any():
            break
    columns = [np.stack(rows, axis=1) for rows in (seen, labels, weight)]
    parts = [[column[index, : -(-length[index] // repeat)] for index in range(envs.num_envs)] for column in columns]
    return parts[0], parts[1], parts[2], won


def main() -> None:
    """Train; print a line and write the policy after each round."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="phantom")
    parser.add_argument("--out", type=policy_path, required=True, help="the policy's file, NAME.safetensors")
    parser.add_argument("--rounds", type=int, default=1, help="rounds; the network plays those after the first")
    parser.add_argument("--envs", type=int, default=512, help="episodes of a round")
    parser.add_argument("--steps", type=int, default=420, help="largest number of steps of an episode")
    parser.add_argument("--repeat", type=int, default=2, help="control steps per decision")
    parser.add_argument("--batch-size", type=int, default=32, help="episodes of a gradient step")
    parser.add_argument("--epochs", type=int, default=250, help="epochs of each round")
    parser.add_argument("--seed", type=int, default=2_000_000)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rng = np.random.default_rng(arguments.seed)
    envs = PalpateSurrogate(arguments.envs, arguments.scene)
    expert = PalpateExpert(envs.envs[0])
    blind = PalpateSurrogate(2, arguments.scene, memory=False)
    scaled = VecNormalize(VectorEnvForStableBaselines(blind), norm_reward=False)
    model = RecurrentPPO("MlpLstmPolicy", scaled, policy_kwargs=NETWORK, device="cpu", seed=0)
    episodes: list[list[NDArray]] = [[], [], []]
    begin, policy = time.time(), None
    for index in range(arguments.rounds):
        *parts, won = play_episodes(envs, expert, policy, arguments.steps, rng, arguments.repeat)
        for kept, new in zip(episodes, parts, strict=True):
            kept += new
        observations, inside = pad(episodes[0])
        actions, _ = pad(episodes[1])
        weights, _ = pad([one[:, None] for one in episodes[2]])
        if index == 0:
            normalise_by(scaled, np.concatenate(episodes[0]))
        curve = clone(
            model,
            observations,
            actions,
            sample_weight=inside * weights[:, :, 0],
            normalisation=scaled,
            options=CloningOptions(
                epochs=arguments.epochs,
                patience=60,
                batch_size=arguments.batch_size,
                learning_rate=4e-3,
                std=0.05,
                seed=index,
            ),
        )
        print(
            f"{time.time() - begin:6.0f} s round {index}: success {np.mean(won):.2f} of {len(won)} episodes, "
            f"loss {curve.validation[curve.best]:.5f}",
            flush=True,
        )
        description = describe(
            model,
            scaled,
            blind.envs[0],
            env_id="SurgSim/Palpate-v0",
            env_kwargs={"scene": arguments.scene, "level": "standard", "memory": False},
            action_repeat=arguments.repeat,
            trained_steps=int(sum(len(one) for one in episodes[0])),
        )
        save_policy(model.policy, description, arguments.out)
        policy = TrainedPolicy(model.policy, description)


if __name__ == "__main__":
    with one_line_errors(__name__, "agents"):
        main()
