"""Options of `surgsim evaluate`: environment, episodes and results."""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from surgsim_apps.scoring.figures import EVALUATION_SEEDS
from surgsim_apps.scoring.results import read_seeds


@dataclass(frozen=True)
class ScoringOptions:
    """Environment and episodes of a method; without an option they are the method's own."""

    scene: str | None = None
    """A shipped scene or a scene file (TOML); default: phantom; for a policy, that of its training."""
    level: str | None = None
    """Default: standard; for a policy, that of its training."""
    split: str | None = None
    """Of a family of organs: train, validation or test (the default)."""
    motion: str | None = None
    """Motion of the patient; default: the scene's."""
    instrument: str | None = None
    """Such as tactile_probe, or an arm; default: the scene's, for a policy that of its training."""
    no_tracking: bool = False
    """Presses and oracles go where the surface is at rest, as it moves."""
    seeds: str | None = None
    """FIRST:LAST or A,B,C; default: the evaluation seeds, of a family as many of each member."""
    submit: bool = False
    """Play seeds that follow from the digest of the agent's or policy's files (docs/own_agent.md)."""
    episodes: int | None = None
    """Number of episodes: the first of the seeds."""
    budget: int | None = None
    """Presses of an episode, in place of the environment's own."""
    envs: int = 16
    """Environments side by side."""
    threads: int = 1
    """Threads that share them."""
    dtype: Literal["float32", "float64"] = "float32"
    """Of the lanes."""
    env: str | None = None
    """The environment of --agent MODULE:CLASS; default: SurgSim/PalpateSites-v0."""
    env_arguments: str = "{}"
    """Of the environment of --agent MODULE:CLASS, as a JSON object."""
    results: Path | None = None
    """Folder of result files; default: agents/results of a checkout."""

    def __post_init__(self) -> None:
        for name in ("envs", "threads"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name.replace('_', '-')} is {getattr(self, name)}; it must be at least 1")
        if self.submit and self.seeds is not None:
            raise ValueError(f"--seeds is {self.seeds!r}, and those of --submit follow from the agent: leave one out")
        seeds = self._seeds
        if self.episodes is not None and not 1 <= self.episodes <= len(seeds):
            raise ValueError(f"--episodes is {self.episodes}; there are 1 to {len(seeds)} seeds")
        # Refuses another text.
        _ = self.env_kwargs

    @cached_property
    def played_seeds(self) -> tuple[int, ...]:
        """Seeds of the episodes; of a submission only their number counts."""
        return self._seeds[: self.episodes]

    @property
    def _seeds(self) -> tuple[int, ...]:
        return tuple(EVALUATION_SEEDS) if self.seeds is None else read_seeds(self.seeds)

    @property
    def standard(self) -> bool:
        """True for results as shipped: of all evaluation seeds, with the default presses and lanes."""
        all_seeds = self.seeds is None and len(self.played_seeds) == len(EVALUATION_SEEDS)
        return all_seeds and not self.submit and self.budget is None and self.dtype == type(self).dtype

    @cached_property
    def env_kwargs(self) -> dict[str, Any]:
        """`env_arguments` as a dictionary."""
        try:
            arguments = json.loads(self.env_arguments)
        except ValueError:
            arguments = None
        if not isinstance(arguments, dict):
            raise ValueError(f"--env-arguments is {self.env_arguments!r}; it must be a JSON object")
        return arguments
