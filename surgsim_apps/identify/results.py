"""Results of an identification: a material for scene files, sites as CSV, pictures, a summary, a table."""

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from rich.console import Console
from rich.table import Table
from tomlkit.items import Table as TomlTable

from surgsim_apps.identify.identification import Identification, SetResult

MATERIAL_NAME, SITES_NAME, CURVES_NAME, MAP_NAME, SUMMARY_NAME = (
    *("material.toml", "sites.csv", "curves.png", "modulus_map.png"),
    "summary.json",
)
RESULT_NAMES = (MATERIAL_NAME, SITES_NAME, CURVES_NAME, MAP_NAME, SUMMARY_NAME)
COLUMNS = (
    *("set", "site", "x", "y", "z", "half", "youngs_modulus", "contact_offset", "error"),
    *("linear_youngs_modulus", "linear_error"),
)
# Density in material.toml [kg/m^3].
DENSITY = 1060.0
# Digits of numbers in files.
DIGITS = 4
# Quantiles of the errors of sites with a curve of their own.
SHOWN_QUANTILES = (0.1, 0.3, 0.5, 0.7, 0.9)


def rounded(value: float) -> float:
    """A number with DIGITS significant digits."""
    return float(f"{value:.{DIGITS}g}")


def material_tables(result: Identification) -> dict[str, Any]:
    """Table `material` of a scene file, with its sub-tables, as plain values."""
    material: dict[str, Any] = {
        "youngs_modulus": rounded(float(np.median(result.moduli))),
        "density": DENSITY,
        "poisson_ratio": result.options.poisson_ratio,
    }
    if not result.is_linear:
        names = ("onset_strain", "cap_strain", "tangent_cap")
        law = {name: rounded(getattr(result.shape, name)) for name in names}
        material["stiffening"] = {**law, "strain_supported": rounded(result.strain_supported)}
    if result.relaxation is not None and result.relaxation.times:
        material["relaxation"] = {
            "relative_moduli": [rounded(modulus) for modulus in result.relaxation.relative_moduli],
            "times": [rounded(time) for time in result.relaxation.times],
        }
    return material


def write_material(result: Identification, path: Path, command_line: str) -> None:
    """Write the material as TOML, `[material]` with its sub-tables, for any scene file."""
    document = tomlkit.document()
    for line in _head(result, command_line):
        document.add(tomlkit.comment(line))
    document.add("material", _table(material_tables(result), _comments(result)))
    path.write_text(tomlkit.dumps(document), encoding="utf-8")


def _table(values: Mapping[str, Any], comments: Mapping[str, str]) -> TomlTable:
    table = tomlkit.table()
    for name, value in values.items():
        item = _table(value, comments) if isinstance(value, Mapping) else tomlkit.item(value)
        if name in comments:
            item.comment(comments[name])
        table.add(name, item)
    return table


def _head(result: Identification, command_line: str) -> list[str]:
    """Comment lines at the top of the material: its origin and its errors."""
    lines = [f"Written by: {command_line}"]
    for dataset in result.sets:
        lines.append(
            f"{dataset.recording.name}: {len(dataset.fits.samples)} of {len(dataset.recording.presses)} sites, "
            f"{int(dataset.is_training.sum())} of them chose the law; force error on the others {_shares(dataset)}"
        )
    lines.append(f"Thickness of the tissue in the model: {1e3 * result.shape.thickness:.3g} mm on a rigid bed.")
    return [*lines, *result.warnings]


def _shares(dataset: SetResult) -> str:
    return (
        f"{dataset.error.median:.1%} (median), {dataset.error.high:.1%} (90th percentile); "
        f"linear tissue {dataset.linear_error.median:.1%}, {dataset.linear_error.high:.1%}"
    )


def _comments(result: Identification) -> dict[str, str]:
    low, high = np.percentile(result.moduli, [25.0, 75.0])
    comments = {
        "youngs_modulus": f"[Pa] median of {len(result.moduli)} sites; quartiles {low:.4g} to {high:.4g}",
        "density": "[kg/m^3] of soft tissue, chosen: not identifiable by presses",
        "poisson_ratio": "given, not identified",
        "times": "[s]",
        "strain_supported": "largest strain of the model's tissue at half of the fitted sites or more",
    }
    for name, interval in result.best.intervals.items():
        doubt = "" if interval.is_identifiable else ", not identifiable"
        comments[name] = f"{interval.low:.3g} to {interval.high:.3g} describe the sites as well{doubt}"
    return comments


def write_sites(result: Identification, path: Path) -> None:
    """Write modulus [Pa], offset [m] and error of every usable site; places in metres."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        for dataset in result.sets:
            errors, linear_errors = dataset.fits.site_errors, dataset.linear_fits.site_errors
            for row, site in enumerate(dataset.fits.samples.sites):
                place = [f"{value:.6g}" if np.isfinite(value) else "" for value in site.place]
                half = "training" if dataset.is_training[row] else "held out"
                values = (
                    *(dataset.fits.modulus[row], dataset.fits.offset[row], errors[row]),
                    *(dataset.linear_fits.modulus[row], linear_errors[row]),
                )
                writer.writerow(
                    [dataset.recording.name, site.site, *place, half, *(f"{value:.6g}" for value in values)]
                )


def summary(result: Identification, command_line: str) -> dict[str, Any]:
    """Plain values of an identification, for `summary.json`."""
    return {
        "command": command_line,
        "material": material_tables(result),
        "thickness": rounded(result.shape.thickness),
        "intervals": {
            name: {
                **{end: rounded(getattr(interval, end)) for end in ("value", "low", "high")},
                "told": interval.is_identifiable,
            }
            for name, interval in result.best.intervals.items()
        },
        "linear": {"thickness": rounded(result.linear.thickness), "is_as_good": result.is_linear},
        "mean_error": {name: rounded(value) for name, value in vars(result.gain).items()},
        "sets": {
            dataset.recording.name: {
                "sites": len(dataset.recording.presses),
                "used": len(dataset.fits.samples),
                "training": int(dataset.is_training.sum()),
                "left_out": dataset.left_out,
                "error_with_left_out": {
                    reason: {"median": rounded(error.median), "high": rounded(error.high)}
                    for reason, error in dataset.kept_in.items()
                },
                "modulus_median": rounded(float(np.median(dataset.fits.modulus))),
                "offset_median": rounded(float(np.median(dataset.fits.offset))),
                "held_out_error": {"median": rounded(dataset.error.median), "high": rounded(dataset.error.high)},
                "held_out_error_linear": {
                    "median": rounded(dataset.linear_error.median),
                    "high": rounded(dataset.linear_error.high),
                },
            }
            for dataset in result.sets
        },
        "relaxation": None
        if result.relaxation is None
        else {
            "held_out_error": rounded(result.relaxation.error),
            "held_out_error_elastic": rounded(result.relaxation.elastic_error),
            "time_range": [rounded(time) for time in result.relaxation.time_range],
        },
        "other_poisson_ratios": {
            f"{ratio:g}": {"training_error": rounded(error), "modulus_factor": rounded(factor)}
            for ratio, (error, factor) in result.other_ratios.items()
        },
        "warnings": list(result.warnings),
        "press_count": result.best.press_count,
        "seconds": rounded(result.seconds),
    }


def write_summary(result: Identification, path: Path, command_line: str) -> None:
    """Write `summary` as JSON."""
    path.write_text(json.dumps(summary(result, command_line), indent=2) + "\n", encoding="utf-8")


def error_table(sets: Sequence[SetResult]) -> Table:
    """Errors of sets on held-out sites, beside the best linear tissue."""
    table = Table()
    for heading in ("set", "sites", "held out", "error", "90 %", "linear", "90 %", "E [kPa]", "offset [mm]"):
        table.add_column(heading, justify="left" if heading == "set" else "right", overflow="fold")
    for dataset in sets:
        table.add_row(
            dataset.recording.name,
            str(len(dataset.recording.presses)),
            str(int((~dataset.is_training).sum())),
            *(f"{value:.1%}" for value in (dataset.error.median, dataset.error.high)),
            *(f"{value:.1%}" for value in (dataset.linear_error.median, dataset.linear_error.high)),
            f"{1e-3 * np.median(dataset.fits.modulus):.3g}",
            f"{1e3 * np.median(dataset.fits.offset):.2f}",
        )
    return table


def print_result(result: Identification, console: Console) -> None:
    """Print the errors, the shape, the arms and the warnings."""
    console.print(error_table(result.sets))
    shape = result.shape
    console.print(f"thickness {1e3 * shape.thickness:.3g} mm, " + _law_text(result), highlight=False)
    if result.relaxation is not None:
        arms = ", ".join(
            f"{g:.3g} at {tau:.3g} s" for g, tau in zip(result.relaxation.relative_moduli, result.relaxation.times)
        )
        console.print(
            f"relaxation {arms or 'none'}; error of held presses {result.relaxation.error:.1%}, "
            f"{result.relaxation.elastic_error:.1%} without",
            highlight=False,
        )
    for line in result.warnings:
        console.print(f"note: {line}", highlight=False, markup=False)


def _law_text(result: Identification) -> str:
    if result.is_linear:
        return "linear springs"
    shape = result.shape
    return (
        f"onset_strain {shape.onset_strain:.3g}, cap_strain {shape.cap_strain:.3g}, "
        f"tangent_cap {shape.tangent_cap:.3g}, supported up to a strain of {result.strain_supported:.2g}"
    )


def write_curves(result: Identification, path: Path) -> None:
    """Draw measured and simulated force over depth: single held-out sites, and all of them over their moduli."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 4.6 * len(result.sets)), layout="constrained")
    panels = figure.subplots(len(result.sets), 2, squeeze=False)
    for dataset, (left, right) in zip(result.sets, panels):
        _draw_sites(left, dataset)
        _draw_all(right, dataset, result)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _draw_sites(axes: Any, dataset: SetResult) -> None:
    """Draw held-out sites at quantiles of their errors."""
    rows = np.flatnonzero(~dataset.is_training)
    order = rows[np.argsort(dataset.fits.site_errors[rows])]
    chosen = dict.fromkeys(order[round(share * (len(order) - 1))] for share in SHOWN_QUANTILES)
    for number, row in enumerate(chosen):
        samples = dataset.fits.samples
        used = samples.weight[row] > 0.0
        depth, colour = 1e3 * samples.depth[row][used], f"C{number}"
        label = f"site {samples.sites[row].site}, error {dataset.fits.site_errors[row]:.1%}"
        axes.plot(depth, samples.force[row][used], "o", color=colour, markersize=4, label=label)
        axes.plot(depth, dataset.fits.force[row][used], "-", color=colour)
        axes.plot(depth, dataset.linear_fits.force[row][used], ":", color=colour)
    axes.set(xlabel="depth since first contact [mm]", ylabel="force [N]")
    axes.set_title(
        f"{dataset.recording.name}: held-out sites, measured (dots), identified (lines), linear (dotted)", size=9
    )
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _draw_all(axes: Any, dataset: SetResult, result: Identification) -> None:
    """Draw force over modulus of all held-out sites on their common curve."""
    rows = np.flatnonzero(~dataset.is_training)
    samples = dataset.fits.samples
    used = samples.weight[rows] > 0.0
    depth = (samples.depth[rows] + dataset.fits.offset[rows, None])[used]
    area = (samples.force[rows] / dataset.fits.modulus[rows, None])[used]
    axes.plot(1e3 * depth, 1e6 * area, ".", color="0.6", markersize=3, label="measured, all held-out sites")
    grid = np.linspace(0.0, depth.max(), 200)
    axes.plot(1e3 * grid, 1e6 * result.curve.at(grid), color="C3", label="identified")
    axes.set(xlabel="depth with offset [mm]", ylabel="force / Young's modulus [mm²]")
    axes.set_title(f"force error {_shares(dataset)}", size=9)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def write_map(result: Identification, path: Path) -> bool:
    """Draw the moduli of the sites over x and y; false without a set with places."""
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    sets = [dataset for dataset in result.sets if dataset.recording.has_places]
    if not sets:
        return False
    figure = Figure(figsize=(6.4 * len(sets), 5.2), layout="constrained")
    for dataset, axes in zip(sets, figure.subplots(1, len(sets), squeeze=False)[0]):
        place = np.array([site.place for site in dataset.fits.samples.sites])
        low, high = np.percentile(dataset.fits.modulus, [2.0, 98.0])
        norm = LogNorm(low, max(high, 1.01 * low))
        dots = axes.scatter(1e3 * place[:, 0], 1e3 * place[:, 1], c=dataset.fits.modulus, norm=norm, cmap="magma", s=40)
        axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
        axes.set_title(f"{dataset.recording.name}: Young's modulus of each site", size=9)
        figure.colorbar(dots, ax=axes, label="Young's modulus [Pa]")
    figure.savefig(path, dpi=110, metadata={"Software": None})
    return True
