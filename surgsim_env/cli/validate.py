"""`surgsim validate`: the tissue against closed forms and finite elements."""

from dataclasses import dataclass

from rich.console import Console

from surgsim_env.cli.values import MaybePath, report_folder


@dataclass(frozen=True)
class Validate:
    """Compare the tissue with closed forms and finite elements, print the table, and write it with its plots.

    Exit status 0: every row is met or is a known shortfall (surgsim_env/validation/known_shortfalls.toml); 1 otherwise.
    """

    quick: bool = False
    """Only the cases that take seconds."""
    out: MaybePath = None
    """Folder for validation.md and images/. Default: docs/ of a checkout; runs/validation elsewhere or with --quick."""

    def run(self, console: Console) -> int:
        """Run the cases, print and write the report; returns the exit status."""
        from surgsim_env.validation import suite
        from surgsim_env.validation.report import print_report, write_report

        validation = suite.run_cases(quick=self.quick, console=console)
        print_report(validation, console)
        path = write_report(validation, report_folder(self.out, "validation", quick=self.quick))
        console.print(f"written: {path}", highlight=False, soft_wrap=True)
        return 0 if validation.passed else 1
