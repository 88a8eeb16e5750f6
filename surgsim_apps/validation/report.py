"""Report of a validation: the table on the terminal, `validation.md`, its plots and `validation.csv`."""

import csv
import math
from collections import Counter
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from rich.console import Console
from rich.table import Table

from surgsim_apps.reports.output_folder import OutputFolder
from surgsim_apps.validation.row import Curve, Row
from surgsim_apps.validation.suite import Validation

REPORT_NAME = "validation.md"
TABLE_NAME = "validation.csv"
HEADINGS = ("case", "source", "expected", "measured", "error", "tolerance", "verdict")
PACKAGES = ("numpy", "numba", "mujoco", "scikit-fem")
# Labels of dashed lines begin with these.
REFERENCES = ("reference", "Eshelby")
ERROR_TICKS = (0.03, 0.05, 0.1, 0.2, 0.5)
COLOURS = {"met": "green", "known": "yellow", "not met": "red", "skipped": "dim"}
INTRODUCTION = """# Validation

{summary}.

Each row of [validation.csv](validation.csv) compares a measured value with an expected one.

References are closed forms, or solutions by scikit-fem on quadratic elements; none comes from the code under test.
Organs have springs of formula (6) of Sala et al. 2011, and the volume term for nu above 1/4, unless a row says
otherwise. Written by `surgsim validate{quick}` on {date} with {versions}.

## Comparisons

Rows of one subject and source; error and tolerance are those of the row that is nearest to its tolerance or beyond it.
Rows without a tolerance have a bound on one side.
"""


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
        table.add_row(*texts, f"[{COLOURS[last]}]{last}[/]")
    console.print(table)
    for row in validation.rows:
        if row.verdict in ("not met", "skipped"):
            console.print(f"{verdict(validation, row)}: {row.case}: {validation.reason(row)}", highlight=False)
    for name in validation.outdated:
        console.print(f"met again, take it out of known_shortfalls.toml: {name}", highlight=False)
    console.print(summary(validation), highlight=False)


def comparisons(validation: Validation) -> list[str]:
    """Lines of the page's table: rows with one subject, the case up to its first comma, and one source."""
    lines = ["| subject | source | error | tolerance | rows |", "|---|---|---:|---:|---|"]
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in validation.rows:
        groups.setdefault((row.case.partition(", ")[0], row.source), []).append(row)
    for (subject, source), rows in groups.items():
        nearest = max(rows, key=_use)
        count = Counter(verdict(validation, row) for row in rows)
        verdicts = ", ".join(f"{count[name]} {name}" for name in COLOURS if count[name])
        texts = (subject, source, *cells(validation, nearest)[4:6], verdicts)
        lines.append("| " + " | ".join(text.replace("|", "\\|") for text in texts) + " |")
    return lines


def _use(row: Row) -> float:
    """Size of the error over the tolerance; 0 for a skipped row or a bound on one side."""
    if not (math.isfinite(row.error) and math.isfinite(row.tolerance)):
        return 0.0
    if row.tolerance == 0.0:
        return math.inf if row.error else 0.0
    return abs(row.error) / row.tolerance


def shortfalls(validation: Validation) -> list[str]:
    """Lines of the page's list: each reason with the rows that it explains, and their errors."""
    reasons: dict[str, list[Row]] = {}
    for row in filter(validation.is_known, validation.rows):
        reasons.setdefault(validation.shortfalls[row.case].reason, []).append(row)
    lines = ["\n## Known shortfalls\n"] if reasons else []
    for reason, rows in reasons.items():
        lines.append(f"* {reason}")
        for row in rows:
            error, tolerance = cells(validation, row)[4:6]
            lines.append(f"    * {row.case}: {error}, tolerance {tolerance}")
    return lines


def write_table(validation: Validation, path: Path) -> None:
    """Write every row as CSV."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow((*HEADINGS, "note"))
        writer.writerows((*cells(validation, row), validation.reason(row)) for row in validation.rows)


def write_report(validation: Validation, folder: OutputFolder) -> None:
    """Write `validation.md`, `validation.csv` and images/validation_*.png into a folder."""
    introduction = INTRODUCTION.format(
        summary=summary(validation),
        quick=" --quick" if validation.quick else "",
        date=datetime.now(UTC).date().isoformat(),
        versions=", ".join(f"{package} {version(package)}" for package in PACKAGES),
    )
    write_table(validation, folder / TABLE_NAME)
    lines = [introduction, *comparisons(validation), *shortfalls(validation)]
    if validation.curves or validation.drawings:
        lines.append("\n## Plots")
    for figure in dict.fromkeys(curve.figure for curve in validation.curves):
        name = f"validation_{figure}.png"
        write_plot([curve for curve in validation.curves if curve.figure == figure], folder / f"images/{name}")
        lines.append(f"\n![{figure.replace('_', ' ')}](images/{name})")
    for drawing in validation.drawings:
        drawing.draw(folder / f"images/{drawing.name}.png")
        lines.append(f"\n{drawing.caption}\n\n![{drawing.name.replace('_', ' ')}](images/{drawing.name}.png)")
    (folder / REPORT_NAME).write_text("\n".join(lines) + "\n", encoding="utf-8")


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
