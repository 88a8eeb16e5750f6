"""Report of a validation: the table on the terminal, `validation.md`, its plots and `validation.csv`."""

import csv
import math
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from rich.console import Console
from rich.table import Table

from surgsim_apps.reports.output_folder import OutputFolder
from surgsim_apps.validation.page import VERDICTS, write_page
from surgsim_apps.validation.row import Curve, Row
from surgsim_apps.validation.suite import Validation

TABLE_NAME = "validation.csv"
HEADINGS = ("case", "source", "expected", "measured", "error", "tolerance", "verdict")
PACKAGES = ("numpy", "numba", "mujoco", "scikit-fem")
# Labels of dashed lines begin with these.
REFERENCES = ("reference", "Eshelby")
ERROR_TICKS = (0.03, 0.05, 0.1, 0.2, 0.5)
WRITTEN = "Written by `surgsim validate{quick}` on {date} with {versions}."


def verdict(validation: Validation, row: Row) -> str:
    """Verdict of a row, "known" for a listed shortfall."""
    return "known" if validation.is_known(row) else row.verdict


def cells(validation: Validation, row: Row) -> tuple[str, ...]:
    """Texts of a row, in the order of HEADINGS."""
    return (
        row.case,
        row.source,
        _number(row.expected, row.unit),
        _number(row.measured, row.unit),
        _share(row.error, row),
        _share(row.tolerance, row).lstrip("+"),
        verdict(validation, row),
    )


def _number(value: float, unit: str) -> str:
    return "" if math.isnan(value) else f"{value:.5g} {unit}".rstrip()


def _share(value: float, row: Row) -> str:
    if not math.isfinite(value):
        return ""
    if row.absolute:
        return f"{value:+.3g} {row.unit}".rstrip()
    return f"{100.0 * value:+.3g} %"


def summary(validation: Validation) -> str:
    """Number of rows of each verdict, in one line."""
    count: dict[str, int] = dict.fromkeys(("met", "known", "not met", "skipped"), 0)
    for row in validation.rows:
        count[verdict(validation, row)] += 1
    return (
        f"{len(validation.rows)} rows: {count['met']} met, {count['known']} known shortfalls, "
        f"{count['not met']} not met, {count['skipped']} skipped"
    )


def print_report(validation: Validation, console: Console) -> None:
    """Print the table, the reasons of rows not met, and the summary."""
    table = Table()
    for heading in HEADINGS:
        table.add_column(heading, justify="right" if heading in HEADINGS[2:6] else "left", overflow="fold")
    for row in validation.rows:
        *texts, last = cells(validation, row)
        table.add_row(*texts, f"[{VERDICTS[last]}]{last}[/]")
    console.print(table)
    for row in validation.rows:
        if row.verdict in ("not met", "skipped"):
            console.print(f"{verdict(validation, row)}: {row.case}: {validation.reason(row)}", highlight=False)
    for name in validation.outdated:
        console.print(f"met again, take it out of known_shortfalls.toml: {name}", highlight=False)
    console.print(summary(validation), highlight=False)


def table_lines(validation: Validation) -> list[dict[str, str]]:
    """Lines of the table by their headings, with the note."""
    return [
        dict(zip((*HEADINGS, "note"), (*cells(validation, row), validation.reason(row)))) for row in validation.rows
    ]


def write_report(validation: Validation, folder: OutputFolder) -> None:
    """Write `validation.md`, `validation.csv` and images/validation_*.png into a folder."""
    lines = table_lines(validation)
    with (folder / TABLE_NAME).open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow((*HEADINGS, "note"))
        writer.writerows(line.values() for line in lines)
    plots: list[str] = []
    for figure in dict.fromkeys(curve.figure for curve in validation.curves):
        name = f"images/validation_{figure}.png"
        write_plot([curve for curve in validation.curves if curve.figure == figure], folder / name)
        plots.append(f"![{figure.replace('_', ' ')}]({name})")
    for drawing in validation.drawings:
        name = f"images/{drawing.name}.png"
        drawing.draw(folder / name)
        plots += [drawing.caption, f"![{drawing.name.replace('_', ' ')}]({name})"]
    written = WRITTEN.format(
        quick=" --quick" if validation.quick else "",
        date=datetime.now(UTC).date().isoformat(),
        versions=", ".join(f"{package} {version(package)}" for package in PACKAGES),
    )
    causes = {case: shortfall.cause for case, shortfall in validation.shortfalls.items()}
    write_page(lines, causes, plots, written, folder)


def write_plot(curves: list[Curve], path: Path) -> None:
    """Write a plot of curves."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    colour = "C0"
    for curve in curves:
        # A reference is dashed and has the colour of the compared line before it.
        dashed = curve.label.startswith(REFERENCES)
        style, chosen = ("--", colour) if dashed else ("o-", None)
        (line,) = axes.plot(curve.x, curve.y, style, color=chosen, label=curve.label, markersize=4)
        colour = line.get_color()
    if curves[0].logarithmic:
        axes.set_xscale("log")
        axes.set_yscale("log")
        x_ticks = sorted({x for curve in curves for x in curve.x})
        axes.set_xticks(x_ticks, [f"{x:.3g}" for x in x_ticks])
        axes.set_yticks(ERROR_TICKS, [f"{100.0 * tick:g} %" for tick in ERROR_TICKS])
        axes.minorticks_off()
    axes.set_xlabel(curves[0].x_label)
    axes.set_ylabel(curves[0].y_label)
    axes.set_title(curves[0].figure.replace("_", " "))
    axes.grid(alpha=0.3)
    figure.legend(fontsize=8, loc="outside lower center", ncols=2)
    figure.savefig(path, dpi=110, metadata={"Software": None})
