"""Train with Ray RLlib, on this machine or on a cluster, from a JSON file; the same command resumes a run.

    python -m agents.train_rllib agents/configs/rllib_palpate.json
    python -m agents.train_rllib agents/configs/rllib_palpate.json --address auto   # on the cluster that is running

Needs the extra `distributed` (see agents/README.md). Environments are made inside the
workers, which only need `surgsim` installed; with `"gym_env_vectorize_mode": "vector_entry_point"` a worker's
environments run in lanes. The sections of the file are methods of RLlib's AlgorithmConfig, with their arguments.
"""

import argparse
import csv
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agents.command_line import one_line_errors

with one_line_errors(__name__, "distributed"):
    import ray
    from ray.rllib.algorithms.algorithm import Algorithm
    from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
    from ray.rllib.connectors.env_to_module import MeanStdFilter
    from ray.tune.registry import get_trainable_cls, register_env

# No usage report and no question about it.
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")


STEPS = "num_env_steps_sampled_lifetime"
# Time limit of a sample [s]: the first environment on a machine compiles its kernels, which may take minutes.
PATIENCE = 900.0


@dataclass(frozen=True)
class RllibRun:
    """Configuration of a run, the content of the JSON file.

    Fields:
        name: of the run's folder
        algorithm: of RLlib, such as "PPO" or "SAC"
        env_id, env_kwargs: the environment
        total_steps: environment steps, all workers together
        checkpoint_every: iterations
        normalize_observation: by a running mean and deviation that workers share
        seed: of everything
        sections: {"env_runners": {...}, "training": {...}, "rl_module": {...}, ...}
    """

    name: str
    algorithm: str
    env_id: str
    total_steps: int
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    checkpoint_every: int = 10
    normalize_observation: bool = True
    seed: int = 0
    sections: dict[str, dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> "RllibRun":
        """Read a file.

        Raises:
            ValueError: an unknown entry or section (lists the known).
        """
        table = json.loads(path.read_text(encoding="utf-8"))
        unknown = sorted(set(table) - set(cls.__dataclass_fields__))
        if unknown:
            raise ValueError(f"{path}: {unknown[0]!r} is unknown; known are {', '.join(cls.__dataclass_fields__)}")
        run = cls(**table)
        for section in run.sections:
            if not callable(getattr(AlgorithmConfig, section, None)):
                raise ValueError(f"{path}: section {section!r} is not a method of RLlib's AlgorithmConfig")
        return run


def register_environment(name: str, env_id: str, env_kwargs: dict[str, Any]) -> None:
    """Register the environment's factory with Ray: one environment, or `num_envs` of them in lanes.

    The function is pickled whole and runs in a worker process, so it imports what it needs.
    """

    def make(context: dict[str, Any]) -> Any:
        import gymnasium as gym

        import surgsim_env  # noqa: F401  (registers the ids here, in the worker)

        if "num_envs" not in context:
            return gym.make(env_id, **env_kwargs)
        # Ray assigns the worker's cores: one thread each.
        lanes = {"vectorization_mode": "vector_entry_point", "threads": 1}
        return gym.make_vec(env_id, num_envs=context["num_envs"], **lanes, **env_kwargs)

    register_env(name, make)


def configured(run: RllibRun) -> AlgorithmConfig:
    """RLlib's own configuration of a run."""

    def normalise(env: Any = None, spaces: Any = None, device: Any = None) -> MeanStdFilter:
        return MeanStdFilter()

    def note_success(*, episode: Any, metrics_logger: Any, **_: Any) -> None:
        success = episode.get_infos(-1).get("success")
        if success is not None:
            metrics_logger.log_value("success", float(success), window=100)

    register_environment(run.env_id, run.env_id, run.env_kwargs)
    config = get_trainable_cls(run.algorithm).get_default_config()
    config.framework("torch").environment(run.env_id).debugging(seed=run.seed, log_level="ERROR")
    config.callbacks(on_episode_end=note_success).env_runners(sample_timeout_s=PATIENCE)
    if run.normalize_observation:
        config.env_runners(env_to_module_connector=normalise)
    for section, entries in run.sections.items():
        getattr(config, section)(**entries)
    return config


def train(run: RllibRun, folder: Path, *, most_steps: int | None = None) -> int:
    """Train until `total_steps`, from the folder's checkpoint if there is one; returns the number of steps reached.

    Args:
        run: the configuration.
        folder: for `progress.csv`, `checkpoint` (complete or absent) and TensorBoard's files.
        most_steps: largest number of steps of this call; a later call continues.
    """
    from tensorboardX import SummaryWriter

    checkpoint = (folder / "checkpoint").resolve()
    folder.mkdir(parents=True, exist_ok=True)
    algorithm = configured(run).build_algo()
    if checkpoint.is_dir():
        algorithm.restore_from_path(str(checkpoint))
    steps = _steps_so_far(checkpoint)
    goal = run.total_steps if most_steps is None else min(run.total_steps, steps + most_steps)
    iteration = 0
    try:
        with SummaryWriter(str(folder)) as board:
            while steps < goal:
                row = _row(algorithm.train())
                steps, iteration = row["steps"], iteration + 1
                _write_row(folder / "progress.csv", row)
                for name, value in row.items():
                    board.add_scalar(name, value, steps)
                print(", ".join(f"{name} {value:g}" for name, value in row.items()), flush=True)
                if iteration % run.checkpoint_every == 0 or steps >= goal:
                    _save(algorithm, checkpoint, steps)
    finally:
        algorithm.stop()
    return steps


def _row(result: dict[str, Any]) -> dict[str, float]:
    """The recorded figures of an iteration; nan before the first episode ends."""
    runners = result.get("env_runners", {})
    if STEPS not in runners:
        raise RuntimeError(f"no worker returned a sample within {PATIENCE:g} s; see Ray's logs above")
    return {
        "steps": int(runners[STEPS]),
        "return": float(runners.get("episode_return_mean", float("nan"))),
        "episode_steps": float(runners.get("episode_len_mean", float("nan"))),
        "success": float(runners.get("success", float("nan"))),
    }


def _write_row(path: Path, row: dict[str, float]) -> None:
    new = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(row))
        if new:
            writer.writeheader()
        writer.writerow(row)


def _save(algorithm: Algorithm, checkpoint: Path, steps: int) -> None:
    """Write a checkpoint atomically: under another name first."""
    import shutil

    fresh, old = checkpoint.with_name("checkpoint-new"), checkpoint.with_name("checkpoint-old")
    for folder in (fresh, old):
        shutil.rmtree(folder, ignore_errors=True)
    algorithm.save_to_path(str(fresh))
    (fresh / "steps.json").write_text(json.dumps({"steps": steps}), encoding="utf-8")
    if checkpoint.is_dir():
        checkpoint.rename(old)
    fresh.rename(checkpoint)
    shutil.rmtree(old, ignore_errors=True)


def _steps_so_far(checkpoint: Path) -> int:
    file = checkpoint / "steps.json"
    return json.loads(file.read_text(encoding="utf-8"))["steps"] if file.is_file() else 0


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", type=Path, help="a JSON file, such as agents/configs/rllib_palpate.json")
    parser.add_argument("--out", type=Path, help="the run's folder; runs/NAME otherwise")
    parser.add_argument("--address", help='of a running Ray, such as "auto"; a local one is started otherwise')
    parser.add_argument("--most-steps", type=int, help="stop after this many steps; the same command continues")
    given = parser.parse_args(arguments)
    run = RllibRun.read(given.config)
    # Without an address Ray would join the cluster of RAY_ADDRESS or of an earlier file, and wait if that is gone.
    ray.init(address=given.address or "local", include_dashboard=False if given.address is None else None)
    try:
        steps = train(run, given.out or Path("runs") / run.name, most_steps=given.most_steps)
    finally:
        ray.shutdown()
    print(f"{steps} steps")


if __name__ == "__main__":
    with one_line_errors(__name__, "distributed"):
        main()
