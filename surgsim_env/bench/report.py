"""`benchmarks.md`, and the same figures as lines."""

from collections.abc import Sequence
from pathlib import Path

from surgsim_env.bench.figures import Section

REPORT_NAME = "benchmarks.md"
# Written by hand; kept where the report is written, and appended to it.
NOTES_NAME = "benchmarks_notes.md"
INTRODUCTION = """# Benchmarks

Written by `surgsim bench{quick}`; what follows the figures, if anything, is `{notes}`, kept by hand. Times are of this
machine and this run; what counts are the ratios within it. No test asserts any of them.
"""


def report_text(sections: Sequence[Section], machine: str, *, quick: bool, notes: str) -> str:
    """The whole report."""
    introduction = INTRODUCTION.format(quick=" --quick" if quick else "", notes=NOTES_NAME)
    parts = [introduction, f"{machine}\n", *(section.markdown() for section in sections), notes]
    return "\n".join(part for part in parts if part).rstrip() + "\n"


def write_report(sections: Sequence[Section], machine: str, folder: Path, *, quick: bool) -> Path:
    """Write the report into a folder, the notes that lie there at its end; its path."""
    kept = folder / NOTES_NAME
    notes = kept.read_text(encoding="utf-8") if kept.is_file() else ""
    path = folder / REPORT_NAME
    path.write_text(report_text(sections, machine, quick=quick, notes=notes), encoding="utf-8")
    return path
