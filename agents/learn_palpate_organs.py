"""Teach a network the expert of SurgSim/Palpate-v0 on any organ, and correct it where it plays itself (DAgger).

    python -m agents.learn_palpate_organs --out runs/palpate_organs.safetensors

The network sees the observation alone, through `surgsim_env.training.face_features.FaceSummary`. It is fitted to
imagined features, which fill their ranges, and to the states that it reaches on organs whose forces a formula gives
(`surgsim_env.training.face_surrogate`), all labelled by the expert (`surgsim_env.scoring.expert_organs`). Features are
kept in place of observations of 5069 numbers.
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

    from surgsim_env.scoring.expert_organs import DEPTH, expert_actions
    from surgsim_env.training.face_features import (
        LATE,
        OBSERVATION_SIZE,
        SUMMARY_SIZE,
        WAY_MOST,
        FaceFeatures,
        FaceSummary,
        face_features,
        face_summary,
    )
    from surgsim_env.training.face_surrogate import FaceSurrogate
    from surgsim_env.training.imitation import CloningOptions, clone
    from surgsim_env.training.policy_files import TrainedPolicy, describe, policy_path, save_policy

ENV_ID = "SurgSim/Palpate-v0"
NETWORK = {"net_arch": [192, 192], "activation_fn": torch.nn.ELU}
KWARGS = {"memory": True, "frame": "face"}
# Errors of the player: first-order autoregressive noise on the velocity of every other organ.
ERROR, ERROR_KEPT = 0.15, 0.9
# Weight of a state that was reached over that of an imagined one.
REPEAT = 4.0
# The organs of a round; the first scene stands in the policy's file.
SCENES = ["liver"] * 3 + ["liver_family"] * 2 + ["kidney_family"] * 2 + ["spleen_family", "phantom", "phantom"]


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


def play_round(envs: FaceSurrogate, policy: TrainedPolicy | None) -> tuple[NDArray, NDArray, list[bool]]:
    """Features (n, SUMMARY_SIZE) of the states that a policy reaches, the expert's actions there (n, 4), and successes.

    The policy plays an episode in each environment, or the expert if there is none.
    """
    count = len(envs.envs)
    observations, begins = envs.reset(), np.ones(count, dtype=np.bool_)
    if policy is not None:
        policy.reset(count)
    error = np.zeros((count, 3))
    seen, labels = [], []
    while not envs.over.all():
        with torch.no_grad():
            found = face_features(torch.as_tensor(observations))
            wanted, features = expert_actions(found).numpy(), face_summary(found).numpy()
        seen.append(features[~envs.over])
        labels.append(wanted[~envs.over])
        action = wanted.copy() if policy is None else policy.act(observations, begins)
        begins[:] = False
        error = ERROR_KEPT * error + ERROR * envs.rng.normal(size=error.shape)
        action[:, :3] = np.clip(action[:, :3] + error * (np.arange(count) % 2 == 0)[:, None], -1.0, 1.0)
        observations = envs.step(action)
    return np.concatenate(seen), np.concatenate(labels), [bool(info["success"]) for info in envs.infos]


def fitted(
    seen: NDArray, labels: NDArray, *, imagined_count: int, options: CloningOptions, model: PPO | None = None
) -> tuple[PPO, float]:
    """A network on features, and its loss: fitted to labelled features, each REPEAT times, and to imagined ones."""
    rng = np.random.default_rng(options.seed)
    with torch.no_grad():
        made = imagined(imagined_count, rng)
        inputs, wanted = face_summary(made).numpy(), expert_actions(made).numpy()
    action_space = gym.spaces.Box(-1.0, 1.0, (4,), np.float32)
    space = gym.spaces.Box(-np.inf, np.inf, (SUMMARY_SIZE,), np.float32)
    model = model or PPO("MlpPolicy", _Spaces(space, action_space), policy_kwargs=NETWORK, device="cpu", seed=0)
    weight = np.concatenate([np.full(len(seen), REPEAT), np.ones(imagined_count)])
    curve = clone(
        *(model, np.concatenate([seen, inputs]), np.concatenate([labels, wanted])),
        sample_weight=weight, options=options,
    )  # fmt: skip
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
    parser.add_argument("--scenes", nargs="+", default=SCENES, help="organs of a round, each played once")
    parser.add_argument("--level", default="standard")
    parser.add_argument("--rounds", type=int, default=5, help="the first is the expert's")
    parser.add_argument("--imagined", type=int, default=100_000, help="imagined features of each fit")
    parser.add_argument("--epochs", type=int, default=12, help="of a fit; the last one has four times as many")
    parser.add_argument("--seed", type=int, default=2_000_000)
    given = parser.parse_args()
    torch.set_num_threads(1)
    begin = time.time()
    envs = FaceSurrogate(
        [gym.make(ENV_ID, scene=scene, level=given.level, **KWARGS) for scene in given.scenes],
        np.random.default_rng(given.seed),
    )
    seen, labels = np.zeros((0, SUMMARY_SIZE), np.float32), np.zeros((0, 4), np.float32)
    model, policy = None, None
    for index in range(given.rounds):
        new_seen, new_labels, won = play_round(envs, policy)
        seen, labels = np.concatenate([seen, new_seen]), np.concatenate([labels, new_labels])
        last = index == given.rounds - 1
        options = CloningOptions(
            epochs=given.epochs * (4 if last else 1), patience=8, batch_size=512, std=0.05, seed=index,
            learning_rate=3e-4 if last else 1e-3,
        )  # fmt: skip
        model, loss = fitted(seen, labels, imagined_count=given.imagined, options=options, model=model)
        policy = save(model, envs.envs[0], given.scenes[0], given.level, len(seen), given.out)
        print(
            f"{time.time() - begin:6.0f} s round {index}: success {np.mean(won):.2f}, {len(seen)} steps, "
            f"loss {loss:.5f}",
            flush=True,
        )


if __name__ == "__main__":
    with one_line_errors(__name__, "agents"):
        main()
