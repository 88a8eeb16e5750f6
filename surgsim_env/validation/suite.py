"""Run the cases and judge them against the list of known shortfalls."""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from surgsim_env.validation.catalogue import CASES
from surgsim_env.validation.fem import MISSING, has_fem
from surgsim_env.validation.row import Case, Curve, Drawing, Outcome, Row, skipped

SHORTFALLS = Path(__file__).with_name("known_shortfalls.toml")


@dataclass(frozen=True)
class Shortfall:
    """A known shortfall: why a case is not met, and the largest error for which that reason holds."""

    reason: str
    error: float


@dataclass(frozen=True)
class Validation:
    """Results of a run: rows, curves and drawings of its cases, whether it was the quick subset, known shortfalls."""

    rows: tuple[Row, ...]
    curves: tuple[Curve, ...]
    drawings: tuple[Drawing, ...]
    quick: bool
    shortfalls: dict[str, Shortfall]

    def is_known(self, row: Row) -> bool:
        """Whether a row that is not met is listed, and no worse than listed."""
        listed = self.shortfalls.get(row.case)
        return listed is not None and row.verdict == "not met" and abs(row.error) <= listed.error

    @property
    def unexplained(self) -> list[Row]:
        """Rows that are not met and not listed, or worse than listed."""
        return [row for row in self.rows if row.verdict == "not met" and not self.is_known(row)]

    @property
    def outdated(self) -> list[str]:
        """Cases that are listed as shortfalls but met."""
        return [row.case for row in self.rows if row.verdict == "met" and row.case in self.shortfalls]

    @property
    def passed(self) -> bool:
        """Whether every row is met, skipped or a known shortfall."""
        return not self.unexplained

    def reason(self, row: Row) -> str:
        """The row's note, after the reason of its shortfall where it is a known one."""
        known = self.shortfalls[row.case].reason if self.is_known(row) else ""
        return "; ".join(part for part in (known, row.note) if part)


def load_shortfalls(path: Path = SHORTFALLS) -> dict[str, Shortfall]:
    """Known shortfalls by the case's name; ValueError for an entry without a reason."""
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    found: dict[str, Shortfall] = {}
    for entry in table.get("shortfall", []):
        reason = str(entry.get("reason", "")).strip()
        if not reason or not entry.get("cases"):
            raise ValueError(f"{path.name}: every [[shortfall]] needs `cases` and a `reason`; got {entry}")
        found.update({case: Shortfall(reason, float(error)) for case, error in entry["cases"].items()})
    return found


def run_case(case: Case) -> Outcome:
    """The results of one case, or a row with the reason why it was left out."""
    if case.needs_fem and not has_fem():
        return Outcome((skipped(case.name, "scikit-fem", MISSING),))
    return case.run()


def run_cases(*, quick: bool, console: Console, cases: Sequence[Case] = CASES) -> Validation:
    """Run the cases (without the slow ones for a quick run) with a progress bar."""
    shortfalls = load_shortfalls()
    chosen = [case for case in cases if not (quick and case.slow)]
    columns = (TextColumn("{task.description:24}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    outcomes: list[Outcome] = []
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("", total=len(chosen))
        for case in chosen:
            progress.update(task, description=case.name)
            outcomes.append(run_case(case))
            progress.advance(task)
    rows = tuple(row for outcome in outcomes for row in outcome.rows)
    curves = tuple(curve for outcome in outcomes for curve in outcome.curves)
    drawings = tuple(drawing for outcome in outcomes for drawing in outcome.drawings)
    return Validation(rows, curves, drawings, quick, shortfalls)
