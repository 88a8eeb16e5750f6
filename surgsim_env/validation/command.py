"""What `surgsim validate` does."""

from pathlib import Path

from rich.console import Console

from surgsim_env.validation import suite
from surgsim_env.validation.report import print_report, write_report

ROOT = Path(__file__).resolve().parents[2]


def validate(*, quick: bool, folder: Path | None, console: Console) -> int:
    """Run the cases, print and write the report; 0 where every row is met or a known shortfall, 1 otherwise.

    The folder is docs/ of a checkout where none is given; elsewhere, and for a quick run, runs/validation.
    """
    checkout = (ROOT / "pyproject.toml").is_file()
    default = ROOT / "docs" if checkout and not quick else Path("runs") / "validation"
    validation = suite.run_cases(quick=quick, console=console)
    print_report(validation, console)
    path = write_report(validation, folder or default)
    console.print(f"written: {path}", highlight=False, soft_wrap=True)
    return 0 if validation.passed else 1
