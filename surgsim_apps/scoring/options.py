"""Options of `surgsim evaluate`: environment, episodes and results."""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from surgsim_apps.scoring.figures import EVALUATION_SEEDS
from surgsim_apps.scoring.results import read_seeds

# Optional values, shown in the help without a default.
MaybeText = Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint="")]
MaybeCount = Annotated[int | None, tyro.conf.arg(metavar="COUNT", help_behavior_hint="")]
MaybePath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]


@dataclass(frozen=True)
class ScoringOptions:
    """Environment and episodes of a method; without an option they are the method's own."""

    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE", help_behavior_hint="")] = None
    """A shipped scene (see `surgsim scenes`) or a scene file of your own (TOML); default: phantom; for a policy, that of
    its training."""
    level: MaybeText = None
    """Default: standard; for a policy, that of its training."""
    split: MaybeText = None
    """Of a family of organs: train, validation or test (the default)."""
    motion: MaybeText = None
    """Motion of the patient; default: the scene's."""
    no_tracking: bool = False
    """Presses and oracles go where the surface is at rest, as it moves."""
    seeds: MaybeText = None
    """FIRST:LAST or A,B,C; default: the evaluation seeds."""
    episodes: MaybeCount = None
    """Number of episodes: the first of the seeds."""
    budget: MaybeCount = None
    """Presses of an episode, in place of the environment's own."""
    envs: int = 16
    """Environments side by side."""
    threads: int = 1
    """Threads that share them."""
    dtype: Literal["float32", "float64"] = "float32"
    """Of the lanes."""
    env: MaybeText = None
    """The environment of --agent MODULE:CLASS; default: SurgSim/PalpateSites-v0."""
    env_arguments: Annotated[str, tyro.conf.arg(metavar="JSON")] = "{}"
    """Of the environment of --agent MODULE:CLASS, as a JSON object."""
    results: MaybePath = None
    """Folder of result files; default: agents/results of a checkout."""

    def __post_init__(self) -> None:
        for name in ("envs", "threads"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name.replace('_', '-')} is {getattr(self, name)}; it must be at least 1")
        seeds = self._seeds
        if self.episodes is not None and not 1 <= self.episodes <= len(seeds):
            raise ValueError(f"--episodes is {self.episodes}; there are 1 to {len(seeds)} seeds")
        if not isinstance(self.env_kwargs, dict):
            raise ValueError(f"--env-arguments is {self.env_arguments!r}; it must be a JSON object")

    @cached_property
    def played_seeds(self) -> tuple[int, ...]:
        """Seeds of the episodes."""
        return self._seeds[: self.episodes]

    @property
    def _seeds(self) -> tuple[int, ...]:
        return tuple(EVALUATION_SEEDS) if self.seeds is None else read_seeds(self.seeds)

    @property
    def standard(self) -> bool:
        """True for results as shipped: of all evaluation seeds, with the default presses and lanes."""
        all_seeds = self.played_seeds == tuple(EVALUATION_SEEDS)
        return all_seeds and self.budget is None and self.dtype == type(self).dtype

    @cached_property
    def env_kwargs(self) -> dict[str, Any]:
        """`env_arguments` as a dictionary."""
        return json.loads(self.env_arguments)
