"""`surgsim validate`: the tissue against closed forms and finite elements, or against recordings of real tissue."""

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from surgsim_env.cli.values import MaybePath, command_text, report_folder
from surgsim_env.reports.output_folder import output_folder


@dataclass(frozen=True)
class Validate:
    """Compare the tissue with closed forms and finite elements, print the table, and write it with its plots.

    With --measured, the tissue is compared with recorded presses instead (docs/identify.md). Exit status 0: every row
    is met or is a known shortfall (surgsim_env/validation/known_shortfalls.toml); 1 otherwise.
    """

    quick: bool = False
    """Only the cases that take seconds."""
    measured: MaybePath = None
    """Folder with your copy of recordings (CSV): errors on held-out sites, beside those of the best linear tissue."""
    out: MaybePath = None
    """Folder for validation.md and images/. Default: docs/ of a checkout; runs/validation elsewhere or with --quick.
    With --measured: for validation_measured.md; default: runs/measured."""

    def run(self, console: Console) -> int:
        """Run the cases, print and write the report; returns the exit status.

        Raises:
            OSError: the folder cannot be written (checked before the work).
        """
        if self.measured is not None:
            return self._run_measured(self.measured, console)
        from surgsim_env.validation import suite
        from surgsim_env.validation.report import REPORT_NAME, print_report, write_report

        folder = report_folder(self.out, "validation", quick=self.quick)
        with output_folder(folder, [REPORT_NAME]) as files:
            validation = suite.run_cases(quick=self.quick, console=console)
            print_report(validation, console)
            write_report(validation, files)
        console.print(f"written: {folder / REPORT_NAME}", highlight=False, soft_wrap=True)
        return 0 if validation.passed else 1

    def _run_measured(self, recordings: Path, console: Console) -> int:
        """Identify every set of a folder, print and write the errors."""
        from surgsim_env.identify.identification import IdentifyOptions
        from surgsim_env.validation import measured

        if self.quick:
            raise ValueError("--quick goes without --measured: every set is identified, which takes minutes")
        measured.read_folder(recordings)
        folder = self.out or Path("runs") / "measured"
        with output_folder(folder, [measured.REPORT_NAME]) as files:
            found = measured.identify_folder(recordings, IdentifyOptions(), console)
            measured.print_measured(found, console)
            measured.write_measured(found, files, command_text(["surgsim", "validate"], {"measured": recordings.name}))
        console.print(f"written: {folder / measured.REPORT_NAME}", highlight=False, soft_wrap=True)
        return 0 if all(row.verdict == "met" for row in measured.rows_of(found)) else 1
