"""Result files: one method on one environment, with everything for a comparison."""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass, field
from pathlib import Path
from typing import Any

from msdm_core.mesh_files import checked_content
from surgsim_apps.reports.output_folder import output_folder
from surgsim_apps.scoring.figures import ScoreEstimate
from surgsim_env.scene import STILL, agents_folder

# JSON has no infinity.
NEVER = "never"
SITES, SLIDE = "SurgSim/PalpateSites-v0", "SurgSim/Slide-v0"


@dataclass(frozen=True)
class Result:
    """One method on one environment, with the command that reproduces its figures.

    Fields:
        method: name of an agent or of a policy's file
        env_id, env_kwargs: the environment
        seeds: of the episodes; in a file as text, "FIRST:LAST" or "A,B,C"
        budget: largest number of steps of an episode
        figures: by name, each a value with its interval
        episodes: by name of a figure one number per episode, None if undefined; the figure is their mean
        command: the command line of the evaluation
        wall_time: of all episodes [s], on a machine with other load
        date: of its end
        physics_version: of the engine (`surgsim_env.scene.digest`)
        members: of a family of organs, one per episode; empty for a scene of one organ
        errors_mm: OSPA after each press of each episode (PalpateSites only)
        lesion_counts: lesions of each episode (PalpateSites only)
        sees_truth: True if the method declares that it sees hidden truth
        own_estimate: True if its own estimate is scored instead of the common estimator's
        agent_digest: SHA-256 of a submission's files, of which its seeds follow; "" for other seeds
    """

    method: str
    env_id: str
    env_kwargs: dict[str, Any]
    seeds: tuple[int, ...]
    budget: int
    figures: dict[str, ScoreEstimate]
    command: str
    wall_time: float
    date: str
    physics_version: int
    episodes: dict[str, list[float | None]] = field(default_factory=dict)
    members: list[str] = field(default_factory=list)
    errors_mm: list[list[float]] = field(default_factory=list)
    lesion_counts: list[int] = field(default_factory=list)
    sees_truth: bool = False
    own_estimate: bool = False
    agent_digest: str = ""

    @property
    def place(self) -> str:
        """Key for grouping tables: environment, scene, level, a split other than "test" and motion."""
        level, split = self.env_kwargs.get("level") or "", self.env_kwargs.get("split") or ""
        name = self.env_id.removeprefix("SurgSim/").removesuffix("-v0")
        parts = [name, self.scene, level, "" if split == "test" else split, self.motion]
        return "_".join(part for part in parts if part)

    @property
    def scene(self) -> str:
        """Name of the scene, without folder and ending of a file; "" for the environment's own."""
        return Path(self.env_kwargs.get("scene") or "").stem

    @property
    def motion(self) -> str:
        """The patient's motion; "" for a motionless one."""
        motion = self.env_kwargs.get("motion") or STILL
        return "" if motion == STILL else motion

    def save(self, folder: Path) -> Path:
        """Write it into a folder; replaces an older result of the same method and place, a submission an older one."""
        name = f"{self.place}_{self.method}{'_submission' * bool(self.agent_digest)}.json"
        table = asdict(self)
        table["seeds"] = seeds_text(self.seeds)
        table["figures"] = {key: [_written(value) for value in astuple(figure)] for key, figure in self.figures.items()}
        lines = [f" {json.dumps(key)}: {json.dumps(value)}" for key, value in table.items()]
        with output_folder(folder) as files:
            (files / name).write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
        return folder / name


def shipped_results() -> Path:
    """The folder of results of the project's own methods."""
    return agents_folder() / "results"


def load_result(path: Path) -> Result:
    """Read a file of `Result.save`.

    Raises:
        OSError: an unreadable file.
        ValueError: another content (names the file and the fault).
    """
    checked_content(path)
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        table["figures"] = {
            name: ScoreEstimate(*(math.inf if value == NEVER else value for value in values))
            for name, values in table["figures"].items()
        }
        return Result(**{**table, "seeds": read_seeds(table["seeds"])})
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"{path} is no result of surgsim evaluate: {type(error).__name__}: {reason}") from None


def load_results(folder: Path) -> list[Result]:
    """All results of a folder, by file name."""
    return [load_result(path) for path in sorted(folder.glob("*.json"))]


SEEDS_MOST = 1_000_000


def read_seeds(text: str) -> tuple[int, ...]:
    """The seeds of "FIRST:LAST", both included, or of a list "A,B,C".

    Raises:
        ValueError: another text, or a negative seed.
    """
    rule = (
        f"seeds are {text!r:.60}; the rule is FIRST:LAST, both included, or a list A,B,C of whole numbers, at least 0"
    )
    if not isinstance(text, str) or not re.fullmatch(r"\d+(:\d+|(,\d+)*)", text):
        raise ValueError(rule)
    if ":" in text:
        first, last = map(int, text.split(":"))
        if first > last:
            raise ValueError(f"{rule}; FIRST is at most LAST")
        if last - first >= SEEDS_MOST:
            raise ValueError(f"{rule}; at most {SEEDS_MOST} of them")
        return tuple(range(first, last + 1))
    return tuple(map(int, text.split(",")))


def seeds_text(seeds: Sequence[int]) -> str:
    """Seeds as `read_seeds` takes them."""
    if len(seeds) > 1 and list(seeds) == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]}:{seeds[-1]}"
    return ",".join(map(str, seeds))


def _written(value: float | None) -> float | str | None:
    if value is None:
        return None
    return NEVER if math.isinf(value) else float(f"{value:.5g}")
