"""Teach a network the expert of SurgSim/Palpate-v0 on any organ, and correct it where it plays itself (DAgger).

    python -m agents.learn_palpate_organs --out runs/palpate_organs.safetensors

The network sees the observation alone, through `agents.training.face_features.FaceSummary`. It is fitted to imagined
features, which fill their ranges, and to the states that it reaches on organs, all labelled by the expert
(`agents.expert_organs`). Features are kept in place of observations of 5069 numbers.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agents.command_line import one_line_errors

with one_line_errors(__name__, "agents"):
    import gymnasium as gym
    import torch
    from stable_baselines3 import PPO

    from agents.expert_organs import DEPTH, expert_actions
    from agents.scoring.episodes import make_envs
    from agents.training.face_features import (
        LATE,
        OBSERVATION_SIZE,
        SUMMARY_SIZE,
        WAY_MOST,
        FaceFeatures,
        FaceSummary,
        face_features,
        face_summary,
    )
    from agents.training.imitation import CloningOptions, clone
    from agents.training.policy_files import TrainedPolicy, describe, policy_path, save_policy

ENV_ID = "SurgSim/Palpate-v0"
NETWORK = {"net_arch": [128, 128], "activation_fn": torch.nn.ELU}
KWARGS = {"memory": True, "frame": "face"}
# Errors of the player: first-order autoregressive noise on the velocity of every other organ.
ERROR, ERROR_KEPT = 0.15, 0.9
# First seed of the organs; each round takes others.
SEED = 2_000_000


class _Spaces(gym.Env):
    """Spaces for an algorithm that is fitted and plays nothing itself."""

    def __init__(self, observation_space: gym.Space, action_space: gym.Space) -> None:
        self.observation_space, self.action_space = observation_space, action_space


def imagined(count: int, rng: np.random.Generator) -> FaceFeatures:
    """Features of states all over their ranges: on the way to the first row, along rows, across them, and there."""
    angle, tilt = rng.uniform(0.0, 2.0 * np.pi, count), np.radians(np.abs(rng.normal(0.0, 30.0, count)).clip(max=65.0))
    normal = np.column_stack([np.cos(angle) * np.sin(tilt), np.sin(angle) * np.sin(tilt), np.cos(tilt)])
    near = rng.random(count) < 0.8
    depth = np.where(near, rng.normal(DEPTH, 0.12, count), rng.uniform(-0.8, 0.7, count))
    force = rng.uniform(0.3, 3.0, count) * depth.clip(min=0.0) ** 1.5 + rng.normal(0.0, 0.02, count)
    begun = rng.random(count) < 0.9
    done = rng.random(count) < 0.35
    rows_left = np.where(done, 0.0, rng.uniform(0.0, 1.0, count) ** rng.choice([1.0, 4.0], count))
    rows_left = np.where(begun, rows_left, 1.0)
    across_left = (rng.random(count) < 0.5) & begun
    excess = np.where(begun, rng.uniform(-0.1, 1.6, count), 0.0)
    time_left = np.where(rng.random(count) < 0.15, rng.uniform(0.0, LATE, count), rng.uniform(LATE, 1.0, count))
    values = {
        "depth": depth,
        "force": force,
        "normal": normal,
        "begun": begun,
        "row_way": _ways(count, rng) * (rows_left > 0.0)[:, None],
        "rows_left": rows_left,
        "across_way": _ways(count, rng) * across_left[:, None],
        "across_left": across_left,
        "stiffest_way": _ways(count, rng) * begun[:, None],
        "excess": excess,
        "passed": (rng.random(count) < 0.6) & begun,
        "time_left": time_left,
    }
    return FaceFeatures(**{name: torch.as_tensor(np.asarray(value, np.float32)) for name, value in values.items()})


def _ways(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Ways of all lengths up to WAY_MOST, some along one axis."""
    size = WAY_MOST * rng.uniform(0.0, 1.0, (count, 1)) ** rng.choice([0.3, 1.0, 3.0], (count, 1))
    way = rng.uniform(-1.0, 1.0, (count, 2)) * np.where(rng.random((count, 2)) < 0.3, 0.1, 1.0)
    return size * way / np.abs(way).max(axis=1, keepdims=True)


def play_round(
    scene: str, level: str | None, policy: TrainedPolicy, count: int, steps: int, seed: int, threads: int = 1
) -> tuple[NDArray, NDArray, list[bool]]:
    """Features (n, SUMMARY_SIZE) of states that a policy reaches on `count` organs, and the expert's actions (n, 4).

    Also whether each episode that ended succeeded.
    """
    envs = make_envs(ENV_ID, count, scene=scene, level=level, threads=threads, **KWARGS)
    rng = np.random.default_rng(seed)
    observations, _ = envs.reset(seed=[seed + index for index in range(count)])
    policy.reset(count)
    error, over, begins = np.zeros((count, 3)), np.zeros(count, dtype=np.bool_), np.ones(count, dtype=np.bool_)
    seen, labels, won = [], [], []
    for _ in range(steps):
        with torch.no_grad():
            found = face_features(torch.as_tensor(observations))
            wanted, features = expert_actions(found).numpy(), face_summary(found).numpy()
        seen.append(features[~over])
        labels.append(wanted[~over])
        action = policy.act(observations, begins)
        begins[:] = False
        error = ERROR_KEPT * error + ERROR * rng.normal(size=error.shape)
        action[:, :3] = np.clip(action[:, :3] + error * (np.arange(count) % 2 == 0)[:, None], -1.0, 1.0)
        observations, _, terminated, truncated, infos = envs.step(action.astype(np.float32))
        ended = (terminated | truncated) & ~over
        won += [bool(infos["success"][index]) for index in np.flatnonzero(ended)]
        over |= ended
        if over.all():
            break
        envs.unwrapped.pause(over)  # type: ignore[attr-defined]
    envs.close()
    return np.concatenate(seen), np.concatenate(labels), won


def fitted(
    seen: NDArray, labels: NDArray, imagined_count: int, epochs: int, seed: int, model: PPO | None = None
) -> tuple[PPO, float]:
    """A network on features, and its loss: fitted to labelled features, and to so many imagined ones."""
    rng = np.random.default_rng(seed)
    with torch.no_grad():
        made = imagined(imagined_count, rng)
        inputs, wanted = face_summary(made).numpy(), expert_actions(made).numpy()
    action_space = gym.spaces.Box(-1.0, 1.0, (4,), np.float32)
    space = gym.spaces.Box(-np.inf, np.inf, (SUMMARY_SIZE,), np.float32)
    model = model or PPO("MlpPolicy", _Spaces(space, action_space), policy_kwargs=NETWORK, device="cpu", seed=seed)
    options = CloningOptions(epochs=epochs, patience=6, batch_size=512, std=0.05, seed=seed)
    curve = clone(model, np.concatenate([seen, inputs]), np.concatenate([labels, wanted]), options=options)
    return model, curve.validation[curve.best]


def on_observations(model: PPO) -> PPO:
    """The network of `fitted` behind the extractor that gives its features."""
    space: gym.Space = gym.spaces.Box(-np.inf, np.inf, (OBSERVATION_SIZE,), np.float32)
    arguments = {**NETWORK, "features_extractor_class": FaceSummary}
    whole = PPO("MlpPolicy", _Spaces(space, model.action_space), policy_kwargs=arguments, device="cpu", seed=0)
    whole.policy.load_state_dict(model.policy.state_dict())
    return whole


def save(model: PPO, env: gym.Env, scene: str, level: str | None, steps: int, out: Path) -> TrainedPolicy:
    """Write the policy's files; returns it."""
    whole = on_observations(model)
    description = describe(
        *(whole, None, env), env_id=ENV_ID, env_kwargs={"scene": scene, "level": level, **KWARGS}, trained_steps=steps
    )
    save_policy(whole.policy, description, out)
    return TrainedPolicy(whole.policy, description)


def main() -> None:
    """Train; print a line and write the policy after each round."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=policy_path, required=True, help="the policy's file, NAME.safetensors")
    parser.add_argument(
        "--rounds", nargs="*", default=["liver", "liver_family", "liver", "phantom"], help="scenes to play on, in order"
    )
    parser.add_argument("--level", default="standard")
    parser.add_argument("--steps", type=int, default=900, help="most control steps of an episode of a round")
    parser.add_argument("--envs", type=int, default=16, help="organs of a round, each played once")
    parser.add_argument("--imagined", type=int, default=400_000, help="imagined features of each fit")
    parser.add_argument("--epochs", type=int, default=40, help="epochs of the first fit; later ones have half as many")
    parser.add_argument("--threads", type=int, default=1, help="of the organs")
    given = parser.parse_args()
    torch.set_num_threads(1)
    begin = time.time()
    seen, labels = np.zeros((0, SUMMARY_SIZE), np.float32), np.zeros((0, 4), np.float32)
    model, loss = fitted(seen, labels, given.imagined, given.epochs, 0)
    print(f"{time.time() - begin:6.0f} s imagined: loss {loss:.5f}", flush=True)
    for index, scene in enumerate(given.rounds):
        env = gym.make(ENV_ID, scene=scene, level=given.level, **KWARGS)
        policy = save(model, env, given.rounds[0], given.level, len(seen), given.out)
        new_seen, new_labels, won = play_round(
            scene, given.level, policy, given.envs, given.steps, SEED + 1000 * index, given.threads
        )
        seen, labels = np.concatenate([seen, new_seen]), np.concatenate([labels, new_labels])
        model, loss = fitted(seen, labels, given.imagined, max(given.epochs // 2, 1), index + 1, model)
        save(model, env, given.rounds[0], given.level, len(seen), given.out)
        print(
            f"{time.time() - begin:6.0f} s round {index} on {scene}: success {sum(won)} of {given.envs}, {len(seen)} "
            f"steps, loss {loss:.5f}",
            flush=True,
        )


if __name__ == "__main__":
    with one_line_errors(__name__, "agents"):
        main()
