"""`surgsim validate`: the tissue against closed forms and finite elements."""

from dataclasses import dataclass

from rich.console import Console

from surgsim_apps.cli.values import MaybePath, report_folder
from surgsim_apps.reports.output_folder import output_folder


@dataclass(frozen=True)
class Validate:
    """Compare the tissue with closed forms and finite elements; print the table, write it with its plots.

    Exit status 0: every row is met or is a known shortfall (surgsim_apps/validation/known_shortfalls.toml); else 1.
    """

    quick: bool = False
    """Only cases of some seconds."""
    out: MaybePath = None
    """Folder for validation.md, .csv and images/. Default: docs/ of a checkout; else, or --quick, runs/validation."""

    def run(self, console: Console) -> int:
        """Run the cases, print and write the report; returns the exit status.

        Raises:
            OSError: a read-only folder (checked before the work).
        """
        from surgsim_apps.validation import suite
        from surgsim_apps.validation.page import REPORT_NAME
        from surgsim_apps.validation.report import TABLE_NAME, print_report, write_report

        folder = report_folder(self.out, "validation", quick=self.quick)
        with output_folder(folder, [REPORT_NAME, TABLE_NAME]) as files:
            validation = suite.run_cases(quick=self.quick, console=console)
            print_report(validation, console)
            write_report(validation, files)
        console.print(f"written: {folder / REPORT_NAME}", highlight=False, soft_wrap=True)
        return 0 if validation.passed else 1
