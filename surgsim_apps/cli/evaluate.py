"""`surgsim evaluate`: score a method on fixed seeds, or compare two results."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from rich.console import Console

from surgsim_apps.cli.values import (
    AnyPath,
    MaybeCount,
    MaybePath,
    MaybeScene,
    MaybeText,
    Text,
    missing_packages,
    shown_as,
)
from surgsim_apps.reports.output_folder import output_folder
from surgsim_apps.scoring.options import ScoringOptions


@dataclass(frozen=True)
class Episodes(ScoringOptions):
    """Environment and episodes of a method; without an option they are the method's own."""

    # Types of values in the help.
    scene: MaybeScene = None
    level: MaybeText = None
    split: MaybeText = None
    motion: MaybeText = None
    instrument: MaybeText = None
    seeds: MaybeText = None
    episodes: MaybeCount = None
    budget: MaybeCount = None
    env: MaybeText = None
    env_arguments: Text = "{}"
    results: MaybePath = None


@dataclass(frozen=True)
class Evaluate:
    """Score a method on fixed seeds: a search or a script by name, a trained policy, or an agent of your own.

    Give one of --agent, --policy, --all and --compare. Results, the agents' interface and the rules for comparable
    scores: docs/own_agent.md. Reading a policy's files runs no code of its author.
    """

    agent: MaybeText = None
    """MODULE:CLASS, or a name such as gp_ucb, raster_4, sobol, random, oracle (an unknown one lists all)."""
    policy: MaybePath = None
    """A shipped policy by name, or NAME.json with NAME.safetensors beside it."""
    all: bool = False
    """Every search, and every shipped policy for this scene."""
    compare: Annotated[tuple[AnyPath, AnyPath] | None, shown_as("A B")] = None
    """Result files of two methods on the same episodes."""
    options: Episodes = field(default_factory=Episodes)

    def run(self, console: Console) -> int:
        """Play, print and write; returns 0.

        Raises:
            ValueError: not one of the four, an unsuitable option, a missing package, an unknown method.
        """
        modes = [
            f"--{name}" for name in ("agent", "policy", "all", "compare") if getattr(self, name) not in (None, False)
        ]
        if len(modes) != 1:
            raise ValueError(f"give one of --agent, --policy, --all, --compare; given: {' and '.join(modes) or 'none'}")
        options = self.options
        if (options.env or options.env_kwargs) and ":" not in (self.agent or ""):
            raise ValueError(
                "--env and --env-arguments are for --agent MODULE:CLASS; other methods have environments of their own"
            )
        if options.submit and self.policy is None and ":" not in (self.agent or ""):
            raise ValueError("--submit is for --policy and --agent MODULE:CLASS, whose files have a digest")
        if options.results is not None:
            with output_folder(options.results, option="--results"):
                pass
        from surgsim_apps.scoring import evaluate

        with missing_packages("evaluate", "agents"):
            if self.agent is not None:
                evaluate.evaluate(evaluate.find_player(self.agent, options), options, console)
            elif self.policy is not None:
                evaluate.evaluate(evaluate.policy_player(Path(self.policy), options), options, console)
            elif self.all:
                evaluate.evaluate_all(options, console)
            elif self.compare is not None:
                evaluate.print_comparison(self.compare, console)
        return 0
