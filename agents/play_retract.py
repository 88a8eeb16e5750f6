"""Score a policy, or the scripted expert, on SurgSim/Retract-v0: episodes on fixed seeds, several side by side.

    python -m agents.play_retract --policy agents/policies/retract_dagger.zip --out agents/results/retract_dagger.json
    python -m agents.play_retract --expert --episodes 20

The seeds are the evaluation's own (from 1,000,000 on), which no training uses.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

import surgsim_env  # noqa: F401  (registers the ids)
from agents.expert_retract import RetractExpert
from agents.training.policy_files import TrainedPolicy, load_policy

ID = "SurgSim/Retract-v0"
EVALUATION_SEED = 1_000_000
CONTROL_STEP = 0.05  # [s]
# Of the last info of an episode.
KEPT = (
    "success", "torn", "hard_limit", "sim_fault", "visible", "force_peak", "grip_force_peak", "grip_force_mean",
    "pull_force_peak", "pull_force_mean", "pull_impulse", "slips", "path_length", "strain_held", "strain_middle",
    "strain_free",
)  # fmt: skip
Z = 1.96


class Expert:
    """The scripted expert as policies are asked."""

    def reset(self, count: int) -> None:
        """Nothing is remembered."""

    def act(self, observations: NDArray, begins: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Actions (n, 5)."""
        return np.array([RetractExpert().act(one) for one in observations])


def play(player: TrainedPolicy | Expert, envs: VectorEnv, seeds: list[int]) -> list[dict[str, Any]]:
    """One episode for each seed; environments with autoreset_mode "Disabled", which go on with the next seed."""
    waiting, count = list(seeds), envs.num_envs
    playing = [waiting.pop(0) if waiting else None for _ in range(count)]
    observations, _ = envs.reset(seed=[seed if seed is not None else seeds[0] for seed in playing])
    begins, steps, returns, force = np.ones(count, dtype=np.bool_), np.zeros(count), np.zeros(count), np.zeros(count)
    player.reset(count)
    records: list[dict[str, Any]] = []
    while any(seed is not None for seed in playing):
        observations, rewards, terminated, truncated, info = envs.step(player.act(observations, begins))
        observations = observations.copy()
        steps, returns, force = steps + 1, returns + rewards, np.maximum(force, info["force_peak"])
        begins = terminated | truncated
        for index in np.flatnonzero(begins):
            if playing[index] is not None:
                last = {name: np.asarray(info[name][index]).item() for name in KEPT}
                figures = {"steps": int(steps[index]), "return": float(returns[index])}
                records.append({"seed": playing[index], **figures, **last, "force_peak": float(force[index])})
            playing[index] = waiting.pop(0) if waiting else None
        if begins.any():
            fresh = [seed if seed is not None else seeds[0] for seed in playing]
            observations = envs.reset(seed=fresh, options={"reset_mask": begins.copy()})[0].copy()
            steps[begins] = returns[begins] = force[begins] = 0.0
    return sorted(records, key=lambda record: record["seed"])


def summary(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares with Wilson's interval (95 %), means and largest values over episodes."""
    count = len(records)
    low, high = wilson(sum(bool(record["success"]) for record in records), count)
    won = [record for record in records if record["success"]]

    def mean(name: str, of: list[dict[str, Any]] = records) -> float:
        return float(np.mean([float(record[name]) for record in of])) if of else float("nan")

    return {
        "episodes": count,
        "success": mean("success"),
        "success_interval": [low, high],
        "torn": mean("torn"),
        "hard_limit": mean("hard_limit"),
        "faults": float(np.mean([bool(record["sim_fault"]) for record in records])),
        "return": mean("return"),
        "seconds_to_success": CONTROL_STEP * mean("steps", won),
        "grip_force_peak": mean("grip_force_peak"),
        "pull_force_peak_mean": mean("pull_force_peak"),
        "pull_force_peak_largest": max(float(record["pull_force_peak"]) for record in records),
        "force_peak_mean": mean("force_peak"),
        "force_peak_largest": max(float(record["force_peak"]) for record in records),
        "slips": mean("slips"),
        "path_length": mean("path_length"),
    }


def wilson(won: int, count: int) -> tuple[float, float]:
    """At 95 %: (p + z^2 / 2n -+ z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n) (Wilson 1927)."""
    share, width = won / count, Z * Z / count
    half = Z * float(np.sqrt(share * (1.0 - share) / count + width / (4.0 * count)))
    return (share + 0.5 * width - half) / (1.0 + width), (share + 0.5 * width + half) / (1.0 + width)


def main() -> None:
    """Play, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    who = parser.add_mutually_exclusive_group(required=True)
    who.add_argument("--policy", type=Path, help="NAME.zip, with NAME.json beside it; load only what you trust")
    who.add_argument("--expert", action="store_true")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=EVALUATION_SEED)
    parser.add_argument("--envs", type=int, default=16)
    parser.add_argument("--dtype", choices=("float64", "float32"), default="float64")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--out", type=Path, help="write summary and episodes as JSON")
    given = parser.parse_args()
    player = Expert() if given.expert else load_policy(given.policy)
    envs = gym.make_vec(
        ID,
        num_envs=given.envs,
        vectorization_mode="vector_entry_point",
        autoreset_mode="Disabled",
        dtype=given.dtype,
        threads=given.threads,
    )
    began = time.perf_counter()
    records = play(player, envs, list(range(given.first_seed, given.first_seed + given.episodes)))
    figures = {**summary(records), "wall_seconds": round(time.perf_counter() - began, 1), "dtype": given.dtype}
    print(json.dumps(figures, indent=1))
    if given.out is not None:
        name = "expert_retract" if given.expert else given.policy.stem
        table = {"agent": name, "env_id": ID, "first_seed": given.first_seed, "summary": figures, "episodes": records}
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    envs.close()


if __name__ == "__main__":
    main()
