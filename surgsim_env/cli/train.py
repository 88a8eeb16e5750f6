"""`surgsim train`: train an agent from a configuration file."""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from surgsim_env.cli.values import MaybeCount, MaybePath, MaybeText, missing_packages
from surgsim_env.scene.load import agents_folder


@dataclass(frozen=True)
class Train:
    """Train an agent from a configuration file; the same command resumes a run that was stopped or killed.

    The run's folder holds checkpoints, the best policy of the periodic evaluations (best/STEPS/policy.safetensors and
    .json), the final one, csv files and those of TensorBoard. A resumed run starts new episodes and ends with the same
    number of steps. Checkpoints are pickles: resume only runs of your own.
    """

    config: tyro.conf.Positional[Path]
    """A YAML file, or the name of a shipped configuration (`surgsim train list` prints them)."""
    out: MaybePath = None
    """The run's folder; default: runs/NAME-seedSEED."""
    seed: MaybeCount = None
    """Instead of the configuration's."""
    total_steps: MaybeCount = None
    """Instead of the configuration's."""
    warm_start: MaybeText = None
    """A policy's file to begin with, instead of the configuration's."""
    trust_pickle: bool = False
    """Let the warm start be a zip, which runs any code of its author."""
    no_progress: bool = False
    """No progress bar."""

    def run(self, console: Console) -> int:
        """Train up to the configured number of steps; returns 0.

        Raises:
            ValueError: an unknown configuration, a wrong entry, a missing package.
        """
        shipped = {path.stem: path for path in sorted((agents_folder() / "configs").glob("*.yaml"))}
        if str(self.config) == "list":
            for name in shipped:
                console.print(name, highlight=False)
            return 0
        path = self.config if self.config.exists() else shipped.get(str(self.config), self.config)
        with missing_packages("train", "agents"):
            from surgsim_env.training.config import read_config
            from surgsim_env.training.run import train
        changes = {name: getattr(self, name) for name in ("seed", "total_steps", "warm_start")}
        config = read_config(path, **changes)
        folder = self.out or Path("runs") / f"{config.name}-seed{config.seed}"
        progress = not self.no_progress and sys.stderr.isatty()
        steps = train(config, folder, progress=progress, trust_pickle=self.trust_pickle)
        console.print(f"{steps} steps; best and final policy in {folder}", highlight=False, soft_wrap=True)
        return 0
