"""Page of a validation, from the lines of its table: two plots, questions with their figures, shortfalls by cause."""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import groupby
from statistics import median
from typing import TYPE_CHECKING

from surgsim_apps.reports.output_folder import OutputFolder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REPORT_NAME = "validation.md"
# Line of the table by its headings.
Line = Mapping[str, str]

VERDICTS = {"met": "green", "known": "yellow", "not met": "red", "skipped": "dim"}
# Patterns of the cases of each group; the first match counts.
GROUPS = {
    "Force of a press": r", force over that|, force$|^ball|^touch, (?!contrast)|^flat|^added",
    "Contrast": r"contrast|^hidden",
    "Relaxation": r"^(step strain|creep|press held)",
    "Friction": r"^(sliding|sticking|grasped|block on)",
    "Energy": r"energy|^largest rise|^lowest",
    "Time step": r"stable",
    "References": r"^reference|force of the springs",
    "Strain, pressure, volume": r"^(phantom|dome|frictionless)",
    "Large strain": r"^(cube|springs of|compression)",
    "Lesions": r"^sphere",
    "Lattice": r"^(Table I|cap of|mass sum|BCC|block|graded block|cosine|`liver`)",
    "Bars": r"^(bar|clamped|cantilever|fixed|rod|damping|lobe|graded prism)",
    "Capsule": r"^(membrane|capsule|the paper)",
    "Tests of the paper": r"^test",
    "Others": "",
}
# Question and references of a group.
QUESTIONS = {
    "Force of a press": ("Has a press the right force?", "finite elements, Hayes, Hertz"),
    "Contrast": ("Does a lesion stand out as much as it should?", "finite elements"),
    "Relaxation": ("Does tissue relax as its law says?", "Maxwell arms, finite elements"),
    "Friction": ("Does it stick and slip as it should?", "Coulomb, statics"),
    "Energy": ("Does tissue gain energy?", "conservation, passivity"),
    "Time step": ("Is the largest stable step known?", "2 / omega_max"),
}
# Answers from other pages.
ELSEWHERE = """| Does a run repeat? | the same seed | 0 | 0: the same bits | `docs/reliability.md` |
| Does it fit recordings? | presses on pig liver, identified law | 1.6 to 4.9 % | 18 % (90th percentile) | \
`docs/real_tissue.md` |"""
PRESS = re.compile(r"(?P<body>.+) pressed (?P<depth>\d+) mm, (?P<kind>.+), force(?: over that of neo-Hooke)?$")
PAGE = """# Validation

{count} comparisons with closed forms and finite elements: {met} within their tolerance, {known} beyond it for a known
cause, {unknown} for an unknown one.

<div class="grid" markdown>
{pictures}
</div>

## Eight questions

| question | compared with | median error | largest error | rows |
|---|---|---:|---|---|
{answers}

## Known shortfalls

{shortfalls}

## Rows

[validation.csv](validation.csv) has the rows with their notes, `docs/validation_rows.md` folds them by group. No
reference comes from the code under test; finite elements are scikit-fem's, quadratic. Organs have springs of formula
(6) of Sala et al. 2011, and the volume term for nu above 1/4, unless a row says otherwise.

{written}

<details markdown>
<summary>More plots</summary>

{plots}

</details>
"""


def group(case: str) -> str:
    """Group of a case."""
    return next(name for name, pattern in GROUPS.items() if re.search(pattern, case))


def grouped(lines: Sequence[Line]) -> dict[str, list[Line]]:
    """Lines of each group."""
    names = {name: [line for line in lines if group(line["case"]) == name] for name in GROUPS}
    return {name: own for name, own in names.items() if own}


def number(text: str) -> float:
    """Number at the start of a cell; nan of an empty one."""
    return float(text.split()[0]) if text else math.nan


def use(line: Line) -> float:
    """Size of the error over the tolerance; 0 without both."""
    error, tolerance = abs(number(line["error"])), number(line["tolerance"])
    if math.isnan(error + tolerance) or not error:
        return 0.0
    return error / tolerance if tolerance else math.inf


def tally(lines: Sequence[Line]) -> str:
    """Number of lines of each verdict, without zeros."""
    count = Counter(line["verdict"] for line in lines)
    return ", ".join(f"{count[name]} {name}" for name in VERDICTS if count[name])


def answer(name: str, lines: Sequence[Line]) -> str:
    """Row of a question: median and largest of the relative errors with a tolerance."""
    relative = [line for line in lines if line["error"].endswith("%") and number(line["tolerance"]) > 0.0]
    middle, largest = "", ""
    if relative:
        middle = f"{median(abs(number(line['error'])) for line in relative):.2g} %"
        worst = max(relative, key=lambda line: abs(number(line["error"])))
        largest = f"{worst['error']}: {worst['case']}"
    return "| " + " | ".join((*QUESTIONS[name], middle, largest, tally(lines))) + " |"


def shortfalls(lines: Sequence[Line], causes: Mapping[str, str]) -> list[str]:
    """Items of the causes of known shortfalls, each with the line that is farthest beyond its tolerance."""
    known = sorted((line for line in lines if line["verdict"] == "known"), key=lambda line: causes[line["case"]])
    items: list[str] = []
    for cause, own in groupby(known, key=lambda line: causes[line["case"]]):
        cases = list(own)
        worst = max(cases, key=use)
        text = f"{worst['case']}: {worst['error']}, tolerance {worst['tolerance']}"
        items.append(f"* {cause}. {len(cases)} rows, the worst: {text}.")
    return items or ["None."]


def write_page(
    lines: Sequence[Line], causes: Mapping[str, str], plots: Sequence[str], written: str, folder: OutputFolder
) -> None:
    """Write the page of a table and its two pictures.

    Args:
        lines: of the table.
        causes: cause of each known shortfall, by its case.
        plots: Markdown of the folded plots.
        written: command, date and versions.
        folder: of the page.
    """
    pictures = [f"\n![Error over tolerance of each row, by group]({write_errors(lines, folder)})"]
    if any(PRESS.match(line["case"]) for line in lines):
        pictures.insert(0, f"\n![Force over depth beside finite elements]({write_presses(lines, folder)})")
    count = Counter(line["verdict"] for line in lines)
    groups = grouped(lines)
    answers = [answer(name, groups[name]) for name in QUESTIONS if name in groups]
    text = PAGE.format(
        count=count.total() - count["skipped"], met=count["met"], known=count["known"], unknown=count["not met"],
        pictures="\n".join(pictures), answers="\n".join([*answers, ELSEWHERE]),
        shortfalls="\n".join(shortfalls(lines, causes)), written=written, plots="\n\n".join(plots),
    )  # fmt: skip
    (folder / REPORT_NAME).write_text(text, encoding="utf-8")


def write_presses(lines: Sequence[Line], folder: OutputFolder) -> str:
    """Write the plot of forces over depth beside finite elements; returns its path from the page."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.8, 4.0), layout="constrained")
    axes = figure.add_subplot(title="Force of a press", xlabel="depth [mm]", ylabel="force [N]")
    series: dict[str, list[tuple[float, float, float]]] = {}
    for line in lines:
        if match := PRESS.match(line["case"]):
            numbers = (float(match["depth"]), number(line["expected"]), number(line["measured"]))
            series.setdefault(f"{match['body']}, {match['kind']}", []).append(numbers)
    for label, points in series.items():
        depths, expected, measured = zip(*points)
        axes.plot(depths, measured, "o", label=label)
        axes.plot(depths, expected, "k--", linewidth=1, zorder=0)
    axes.plot([], [], "k--", linewidth=1, label="finite elements")
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return _saved(figure, folder, "images/validation_presses.png")


def write_errors(lines: Sequence[Line], folder: OutputFolder) -> str:
    """Write the plot of the errors over their tolerances, a dot a line; returns its path from the page."""
    from matplotlib.figure import Figure

    groups = grouped([line for line in lines if number(line["tolerance"]) > 0.0])
    figure = Figure(figsize=(4.8, 4.0), layout="constrained")
    axes = figure.add_subplot(title="All rows", xlabel="error / tolerance")
    for verdict, colour in (("met", "C0"), ("known", "C1"), ("not met", "C3")):
        points = [(use(line), y) for y, own in enumerate(groups.values()) for line in own if line["verdict"] == verdict]
        if points:
            axes.plot(*zip(*points), "o", color=colour, alpha=0.5, markersize=5, label=verdict)
    axes.axvline(1.0, color="k", linewidth=1)
    axes.set_yticks(range(len(groups)), list(groups))
    axes.invert_yaxis()
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return _saved(figure, folder, "images/validation_errors.png")


def _saved(figure: "Figure", folder: OutputFolder, name: str) -> str:
    figure.savefig(folder / name, dpi=200, metadata={"Software": None})
    return name
