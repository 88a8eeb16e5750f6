"""What `surgsim bench` does."""

from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from surgsim_env.bench import control, effort, haptic, machine, side_by_side, start, substeps
from surgsim_env.bench.effort import Effort
from surgsim_env.bench.figures import Section
from surgsim_env.bench.report import REPORT_NAME, write_report

ROOT = Path(__file__).resolve().parents[2]
# In the order of the report.
PARTS: tuple[Callable[[Effort], Section], ...] = (
    substeps.measure,
    haptic.measure,
    control.measure,
    side_by_side.measure,
    start.measure,
)


def bench(*, quick: bool, folder: Path | None, console: Console) -> int:
    """Measure every part, print its figures as they come, write the report; 0, also where peers are absent.

    The folder is docs/ of a checkout where none is given; elsewhere, and for a quick run, runs/benchmarks.

    Raises:
        ValueError: the folder cannot be written (known before the work).
    """
    checkout = (ROOT / "pyproject.toml").is_file()
    default = ROOT / "docs" if checkout and not quick else Path("runs") / "benchmarks"
    target = _writable(folder or default)
    before = machine.load()
    sections: list[Section] = []
    for measure in PARTS:
        section = measure(effort.QUICK if quick else effort.FULL)
        sections.append(section)
        for line in section.lines():
            console.print(line, highlight=False, soft_wrap=True, markup=False)
    path = write_report(sections, machine.describe(before), target, quick=quick)
    console.print(f"written: {path}", highlight=False, soft_wrap=True)
    return 0


def _writable(folder: Path) -> Path:
    """The folder, made if need be, in which the report can be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / REPORT_NAME).open("a", encoding="utf-8"):
            pass
    except OSError as error:
        raise ValueError(f"--out {folder}: cannot be written ({error.strerror}); choose another folder") from None
    return folder
