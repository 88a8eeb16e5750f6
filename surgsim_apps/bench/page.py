"""The benchmark page: two charts, what the figures mean, and the folded tables."""

import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from surgsim_apps.bench.report import Section
from surgsim_apps.reports.output_folder import OutputFolder

if TYPE_CHECKING:
    from matplotlib.axes import Axes

REPORT_NAME = "benchmarks.md"
PAGE = """# Benchmarks

<div class="grid" markdown>
{charts}
</div>

{meaning}

Written by `surgsim bench{quick}`. Times hold for this machine and this run; compare the ratios.

{machine}

{tables}
"""
FAMILIES = ("surgsim", "MuJoCo flex full", "MuJoCo flex trilinear", "Newton")


def write_page(sections: Sequence[Section], machine: str, folder: OutputFolder, *, quick: bool) -> None:
    """Write the page with its charts into a folder; each section is folded."""
    folds = [
        f"<details markdown>\n<summary>{section.heading}</summary>\n\n{section.markdown()}\n</details>\n"
        for section in sections
    ]
    text = PAGE.format(
        charts="\n".join(write_charts(sections, folder)), meaning=meaning(sections), quick=" --quick" if quick else "",
        machine=machine, tables="\n".join(folds).rstrip(),
    )  # fmt: skip
    (folder / REPORT_NAME).write_text(text, encoding="utf-8")


def measured(sections: Sequence[Section], key: str, quantity: str) -> dict[str, float]:
    """Values of a quantity of a section by their cases; none if absent."""
    figures = [figure for section in sections if section.key == key for figure in section.figures]
    return {figure.case: figure.value for figure in figures if figure.quantity == quantity and figure.value is not None}


def two_digits(value: float) -> str:
    """A value with two digits, without an exponent."""
    return np.format_float_positional(value, 2, unique=False, fractional=False, trim="-")


def span(values: Sequence[float]) -> str:
    """Smallest and largest of some values."""
    return " to ".join(dict.fromkeys(map(two_digits, (min(values), max(values)))))


def rates(sections: Sequence[Section]) -> dict[str, dict[int, float]]:
    """Control steps a second of each way, by the number of environments."""
    figures = [figure for section in sections if section.key == "control_steps" for figure in section.figures]
    table: dict[str, dict[int, float]] = {}
    for figure in figures:
        if figure.value is not None:
            table.setdefault(figure.case, {})[int(figure.quantity.split()[0])] = figure.value
    return table


def meaning(sections: Sequence[Section]) -> str:
    """List of what the figures of a run mean."""
    times, errors = (measured(sections, "side_by_side", quantity) for quantity in ("processor", "error"))
    presses: list[str] = []
    for family in FAMILIES:
        own = [case for case in times if case.startswith(family)]
        off = [abs(errors[case]) for case in own if case in errors]
        if own:
            text = f"{family} {span([times[case] for case in own])} s"
            presses.append(text + (f" (force {span(off)} % off)" if off else ""))
    ways = rates(sections)
    count = max((count for own in ways.values() for count in own), default=0)
    together = [f"{way}: {two_digits(own[count])}" for way, own in ways.items() if count in own]
    halves, tails = (measured(sections, "haptic_step", quantity) for quantity in ("p50", "p99"))
    steps = [
        f"{two_digits(1e-3 * half)} ms on `{case}` (99th percentile {two_digits(1e-3 * tails[case])} ms)"
        for case, half in halves.items()
    ]
    learning = measured(sections, "training", "PPO, wall")
    trained = [f"{case}: {two_digits(rate)}" for case, rate in learning.items()]
    cold, warm = (measured(sections, "start", quantity).get("start", np.nan) for quantity in ("cold", "warm"))
    lines = (
        f"A simulated second of the same press takes one core: {', '.join(presses)}.",
        f"Control steps a second of {count} environments: {'; '.join(together)} (side by side in vector registers).",
        f"A haptic step of 1 ms in contact takes {', '.join(steps)}; above 1 ms it lags behind real time.",
        f"Control steps a second of 16 environments while PPO learns: {'; '.join(trained)}.",
        f"The first start compiles for {two_digits(cold)} s, later ones take {two_digits(warm)} s.",
    )
    return "\n".join(f"* {line}" for line in lines)


def write_charts(sections: Sequence[Section], folder: OutputFolder) -> list[str]:
    """Write the two charts; returns their Markdown."""
    charts = {
        "benchmarks_presses": ("Time per simulated second and error of the force of a press", draw_presses),
        "benchmarks_rates": ("Control steps a second over the number of environments", draw_rates),
    }
    return [
        f"\n![{text}]({_written(folder, f'images/{name}.png', draw, sections)})"
        for name, (text, draw) in charts.items()
    ]


def draw_presses(axes: "Axes", sections: Sequence[Section]) -> None:
    """Draw the presses: processor time over error of the force, a colour for each simulator."""
    times, errors = (measured(sections, "side_by_side", quantity) for quantity in ("processor", "error"))
    names = {case: re.sub(r" \d+x\d+x\d+$", "", case.partition(",")[0]) for case in times if case in errors}
    for name in dict.fromkeys(names.values()):
        own = [case for case in names if names[case] == name]
        marker = "*" if name == "surgsim" else "o"
        axes.plot([times[case] for case in own], [abs(errors[case]) for case in own], marker, markersize=9, label=name)
    axes.axvline(1.0, color="k", linewidth=1, linestyle="--", label="real time")
    axes.set(title="A press, beside others", xlabel="seconds per simulated second", ylabel="error of the force [%]")
    axes.set(xscale="log", yscale="log")


def draw_rates(axes: "Axes", sections: Sequence[Section]) -> None:
    """Draw the control steps a second over the number of environments."""
    ways = rates(sections)
    for way, own in ways.items():
        axes.plot(list(own), list(own.values()), "o-", label=way)
    axes.set(title="Environments together", xlabel="environments", ylabel="control steps a second", xscale="log")
    counts = sorted({count for own in ways.values() for count in own})
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.minorticks_off()
    axes.set_ylim(bottom=0.0)


def _written(
    folder: OutputFolder, name: str, draw: Callable[["Axes", Sequence[Section]], None], sections: Sequence[Section]
) -> str:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.8, 4.2), layout="constrained")
    axes = figure.add_subplot()
    draw(axes, sections)
    axes.grid(alpha=0.3)
    figure.legend(fontsize=8, loc="outside lower center", ncols=2)
    figure.savefig(folder / name, dpi=200, metadata={"Software": None})
    return name
