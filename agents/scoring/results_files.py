"""Result files agents/results/*.json: an evaluation's figures, with the command that reproduces them."""

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from surgsim_env.palpation.scores import Figure

RESULTS = Path(__file__).resolve().parents[1] / "results"
# JSON has no infinity.
NEVER = "never"


@dataclass(frozen=True)
class Result:
    """One method on one environment.

    Fields:
        method: name of an agent or of a policy's file
        env_id, env_kwargs: the environment
        seeds: first and last of the range
        budget: largest number of steps of an episode
        figures: by name, each a value with its interval
        errors_mm: OSPA after each press of each episode (PalpateSites only)
        lesion_counts: lesions of each episode (PalpateSites only)
        command: that produced it
        wall_time: of all episodes [s], on a machine with other load
        date: of its end
    """

    method: str
    env_id: str
    env_kwargs: dict[str, Any]
    seeds: tuple[int, int]
    budget: int
    figures: dict[str, Figure]
    command: str
    wall_time: float
    date: str
    errors_mm: list[list[float]] = field(default_factory=list)
    lesion_counts: list[int] = field(default_factory=list)

    @property
    def place(self) -> str:
        """Environment, scene and level: the key that groups tables."""
        parts = [self.env_id.removeprefix("SurgSim/").removesuffix("-v0"), self.env_kwargs.get("scene", "")]
        return "_".join(part for part in [*parts, self.env_kwargs.get("level") or ""] if part)

    def save(self, folder: Path = RESULTS) -> Path:
        """Write it; replaces an older result of the same method and place."""
        table = asdict(self)
        table["figures"] = {name: _written(figure) for name, figure in self.figures.items()}
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.place}_{self.method}.json"
        lines = [f" {json.dumps(name)}: {json.dumps(value)}" for name, value in table.items()]
        path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
        return path


def load_result(path: Path) -> Result:
    """Read a file of `Result.save`."""
    table = json.loads(path.read_text(encoding="utf-8"))
    table["figures"] = {name: _read(values) for name, values in table["figures"].items()}
    return Result(**{**table, "seeds": tuple(table["seeds"])})


def load_results(folder: Path = RESULTS) -> list[Result]:
    """All results of a folder, by file name, without `reach_*.json`."""
    return [load_result(path) for path in sorted(folder.glob("*.json")) if not path.name.startswith("reach_")]


def _written(figure: Figure) -> list[Any]:
    values = [figure.value, figure.low, figure.high]
    return [NEVER if value is not None and math.isinf(value) else _short(value) for value in values]


def _short(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.5g}")


def _read(values: list[Any]) -> Figure:
    return Figure(*(math.inf if value == NEVER else value for value in values))
