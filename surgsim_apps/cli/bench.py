"""`surgsim bench`: timings of the tissue, the environments and the start, beside other simulators."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.console import Console

from surgsim_apps.cli.values import MaybePath, report_folder
from surgsim_apps.reports.output_folder import output_folder

if TYPE_CHECKING:
    from surgsim_apps.bench.measurement import Effort
    from surgsim_apps.bench.report import Section


@dataclass(frozen=True)
class Bench:
    """Time the tissue, the environments and the start, beside MuJoCo flex and Newton.

    Prints the tables and writes them to benchmarks.md. Simulators without an installation are listed as absent.
    """

    quick: bool = False
    """Smaller blocks and fewer repetitions: minutes instead of a quarter of an hour."""
    out: MaybePath = None
    """Folder for benchmarks.md. Default: docs/ of a checkout; runs/benchmarks elsewhere or with --quick."""

    def run(self, console: Console) -> int:
        """Measure every part, print its figures at once, write the report; returns 0, also if peers are absent.

        Raises:
            OSError: a read-only folder (checked before the work).
        """
        from surgsim_apps.bench import measurement, page, report

        folder = report_folder(self.out, "benchmarks", quick=self.quick)
        with output_folder(folder, [page.REPORT_NAME]) as files:
            before = report.load()
            sections: list[report.Section] = []
            for measure in measured_parts():
                section = measure(measurement.QUICK if self.quick else measurement.FULL)
                sections.append(section)
                text = f"## {section.heading}\n\n{section.markdown()}"
                console.print(text, highlight=False, soft_wrap=True, markup=False)
            page.write_page(sections, report.describe(before), files, quick=self.quick)
        path = folder / page.REPORT_NAME
        console.print(f"written: {path}", highlight=False, soft_wrap=True)
        return 0


def measured_parts() -> "tuple[Callable[[Effort], Section], ...]":
    """Measurements of the sections, in the order of the report."""
    from surgsim_apps.bench import control, haptic, parts, side_by_side, start, substeps, training

    return (
        *(substeps.measure, substeps.measure_laws, haptic.measure, parts.measure),
        *(control.measure, training.measure, side_by_side.measure, start.measure),
    )
