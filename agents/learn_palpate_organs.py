"""Teach a network the expert of SurgSim/Palpate-v0 on any organ, with corrections in its own episodes (DAgger).

    python -m agents.learn_palpate_organs --out runs/palpate_organs.json

The network sees the observation alone, through `surgsim_apps.training.face_features.FaceSummary`. It is fitted to
imagined features all over their ranges, and to its own states on organs with forces from a formula
(`surgsim_apps.training.face_surrogate`), all labelled by the expert (`surgsim_apps.scoring.expert_organs`). Features
are kept in place of observations of 5069 numbers.
"""

import argparse
import sys
import time
from dataclasses import replace

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from surgsim_apps.cli.main import exit_status
from surgsim_apps.reports.output_folder import lone_run
from surgsim_apps.scoring.expert_organs import DEPTH, expert_actions
from surgsim_apps.training.face_features import (
    LATE,
    SUMMARY_SIZE,
    WAY_MOST,
    FaceFeatures,
    face_features,
    face_summary,
)
from surgsim_apps.training.face_surrogate import FaceSurrogate
from surgsim_apps.training.fit import fit
from surgsim_apps.training.policy_files import PolicyDescription, observation_declaration, policy_path, save_policy
from surgsim_apps.training.policy_network import NetworkLayout, PolicyNetwork

ENV_ID = "SurgSim/Palpate-v0"
BATCH = 512
KWARGS = {"memory": True, "frame": "face"}
# Errors of the player: first-order autoregressive noise on the velocity of every other organ.
ERROR, ERROR_KEPT = 0.15, 0.9
# Weight of a visited state over that of an imagined one.
REPEAT = 4.0
# The organs of a round; the first scene stands in the policy's file.
SCENES = ["liver"] * 3 + ["liver_family"] * 2 + ["kidney_family"] * 2 + ["spleen_family", "phantom", "phantom"]


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


def play_round(envs: FaceSurrogate, policy: PolicyNetwork | None) -> tuple[NDArray, NDArray, list[bool]]:
    """Features (n, SUMMARY_SIZE) of a policy's states, the expert's actions there (n, 4), and successes.

    The policy plays an episode in each environment, or the expert if there is none.
    """
    count = len(envs.envs)
    observations = envs.reset()
    error = np.zeros((count, 3))
    seen, labels = [], []
    while not envs.over.all():
        with torch.no_grad():
            now = face_features(torch.as_tensor(observations))
            wanted, features = expert_actions(now).numpy(), face_summary(now).numpy()
        seen.append(features[~envs.over])
        labels.append(wanted[~envs.over])
        action = wanted.copy() if policy is None else policy.actions(observations, ())
        error = ERROR_KEPT * error + ERROR * envs.rng.normal(size=error.shape)
        action[:, :3] = np.clip(action[:, :3] + error * (np.arange(count) % 2 == 0)[:, None], -1.0, 1.0)
        observations = envs.step(action)
    return np.concatenate(seen), np.concatenate(labels), [bool(info["success"]) for info in envs.infos]


def refit(
    network: PolicyNetwork,
    seen: NDArray,
    labels: NDArray,
    *,
    imagined_count: int,
    epochs: int,
    rates: tuple[float, float],
    seed: int,
) -> float:
    """Fit the layers to labelled features, each with the weight REPEAT, and to imagined ones; returns the loss."""
    with torch.no_grad():
        features = imagined(imagined_count, np.random.default_rng(seed))
        inputs, wanted = face_summary(features).numpy(), expert_actions(features).numpy()
    weight = np.concatenate([np.full(len(seen), REPEAT), np.ones(imagined_count)])
    return fit(
        network.layers,
        np.concatenate([seen, inputs]),
        np.concatenate([labels, wanted]),
        weight=(weight / weight.mean())[:, None],
        updates=epochs * len(weight) // BATCH + 1,
        rates=rates,
        batch=BATCH,
        seed=seed,
    )


def main() -> None:
    """Train; print a line and write the policy after each round."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=policy_path, required=True, help="the policy's file, NAME.json")
    parser.add_argument("--scenes", nargs="+", default=SCENES, help="organs of a round, each played once")
    parser.add_argument("--level", default="standard")
    parser.add_argument("--rounds", type=int, default=5, help="the first is the expert's")
    parser.add_argument("--imagined", type=int, default=100_000, help="imagined features of each fit")
    parser.add_argument("--epochs", type=int, default=12, help="of a fit; the last one has four times as many")
    parser.add_argument("--seed", type=int, default=2_000_000)
    options = parser.parse_args()
    with lone_run(options.out):
        learn(options)


def learn(options: argparse.Namespace) -> None:
    """Train by the options of the command line."""
    torch.set_num_threads(1)
    torch.manual_seed(options.seed)
    begin = time.time()
    envs = FaceSurrogate(
        [gym.make(ENV_ID, scene=scene, level=options.level, **KWARGS) for scene in options.scenes],
        np.random.default_rng(options.seed),
    )
    seen, labels = np.zeros((0, SUMMARY_SIZE), np.float32), np.zeros((0, 4), np.float32)
    network = PolicyNetwork(NetworkLayout("elu", "FaceSummary"), (SUMMARY_SIZE, 192, 192, 4))
    description = PolicyDescription(
        env_id=ENV_ID,
        env_kwargs={"scene": options.scenes[0], "level": options.level, **KWARGS},
        observation=observation_declaration(envs.envs[0]),
    )
    for index in range(options.rounds):
        new_seen, new_labels, won = play_round(envs, network if index else None)
        seen, labels = np.concatenate([seen, new_seen]), np.concatenate([labels, new_labels])
        last = index == options.rounds - 1
        loss = refit(
            *(network, seen, labels),
            imagined_count=options.imagined,
            epochs=options.epochs * (4 if last else 1),
            rates=(3e-4, 3e-5) if last else (1e-3, 3e-4),
            seed=index,
        )
        save_policy(network, replace(description, trained_steps=len(seen)), options.out)
        print(
            f"{time.time() - begin:6.0f} s round {index}: success {np.mean(won):.2f}, {len(seen)} steps, "
            f"loss {loss:.5f}",
            flush=True,
        )


if __name__ == "__main__":
    sys.exit(exit_status(main))
