"""Train an agent from a configuration file; the same command resumes a run that was stopped or killed.

    python -m agents.train agents/configs/palpate_phantom_small_ppo.yaml
    python -m agents.train agents/configs/sites_ppo.yaml --seed 3     # the same with another seed
    tensorboard --logdir runs

The run's folder (runs/NAME-seedSEED unless --out names another) holds checkpoints, the best policy of the periodic
evaluations with its normalisation (best/STEPS/policy.zip and .json), the final one, csv files and TensorBoard's.
A resumed run starts new episodes and ends with the same number of steps.
"""

import argparse
import sys
from pathlib import Path

from agents.training.config import TrainingConfig, read_config
from agents.training.run import BetweenRollouts, Run


def train(config: TrainingConfig, folder: Path, *, progress: bool = False) -> int:
    """Train up to the configuration's number of steps; returns the number reached."""
    run = Run(config, folder)
    model, start = run.model, run.model.num_timesteps
    if run.resumed_from is not None:
        print(f"resuming from {run.resumed_from} ({start} of {config.total_steps} steps)", flush=True)
    if start >= config.total_steps:
        return start
    # A resumed run trains for the remaining steps.
    left = config.total_steps - start
    model.learn(left, BetweenRollouts(run), reset_num_timesteps=start == 0, progress_bar=progress)
    run.finish()
    return model.num_timesteps


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", type=Path, help="a YAML file, such as those in agents/configs")
    parser.add_argument("--out", type=Path, help="the run's folder")
    parser.add_argument("--seed", type=int, help="instead of the configuration's")
    parser.add_argument("--total-steps", type=int, help="instead of the configuration's")
    parser.add_argument("--no-progress", action="store_true", help="no progress bar")
    arguments = parser.parse_args()
    try:
        config = read_config(arguments.config, seed=arguments.seed, total_steps=arguments.total_steps)
        folder = arguments.out or Path("runs") / f"{config.name}-seed{config.seed}"
        steps = train(config, folder, progress=not arguments.no_progress and sys.stderr.isatty())
    except ValueError as error:
        sys.exit(f"train: {error}")
    print(f"{steps} steps; best and final policy in {folder}")


if __name__ == "__main__":
    main()
