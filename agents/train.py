"""Train an agent from a configuration file; the same command resumes a run that was stopped or killed.

    python -m agents.train agents/configs/palpate_phantom_ppo_formula.yaml
    python -m agents.train agents/configs/sites_ppo.yaml --seed 3     # the same with another seed
    python -m agents.train agents/configs/retract_ppo.yaml --warm-start runs/clone.safetensors
    tensorboard --logdir runs

The run's folder (runs/NAME-seedSEED unless --out names another) holds checkpoints, the best policy of the periodic
evaluations with its normalisation (best/STEPS/policy.safetensors and .json), the final one, csv files and those of
TensorBoard. A resumed run starts new episodes and ends with the same number of steps. Checkpoints are pickles: resume
only runs of your own.
"""

import argparse
import sys
from pathlib import Path

from agents.command_line import one_line_errors

with one_line_errors(__name__, "agents"):
    from agents.training.config import TrainingConfig, read_config
    from agents.training.run import BetweenRollouts, Run


def train(config: TrainingConfig, folder: Path, *, progress: bool = False, trust_pickle: bool = False) -> int:
    """Train up to the configuration's number of steps; returns the number reached."""
    run = Run(config, folder, trust_pickle=trust_pickle)
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
    parser.add_argument("--warm-start", help="a policy's file to begin with, instead of the configuration's")
    parser.add_argument(
        "--trust-pickle", action="store_true", help="let the warm start be a zip, which runs any code of its author"
    )
    parser.add_argument("--no-progress", action="store_true", help="no progress bar")
    arguments = parser.parse_args()
    changes = {name: getattr(arguments, name) for name in ("seed", "total_steps", "warm_start")}
    config = read_config(arguments.config, **changes)
    folder = arguments.out or Path("runs") / f"{config.name}-seed{config.seed}"
    progress = not arguments.no_progress and sys.stderr.isatty()
    steps = train(config, folder, progress=progress, trust_pickle=arguments.trust_pickle)
    print(f"{steps} steps; best and final policy in {folder}")


if __name__ == "__main__":
    with one_line_errors(__name__, "agents"):
        main()
