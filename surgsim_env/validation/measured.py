"""Recordings of real tissue against this organ: `surgsim validate --measured FOLDER`.

Every set is identified by itself: half of its sites choose thickness and law, the error is that of the other half, each
site with its own modulus and contact offset. Nothing of the recordings is kept but these errors.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console

from surgsim_env.identify.identification import Identification, IdentifyOptions, identify, make_library
from surgsim_env.identify.recordings import read_recording
from surgsim_env.identify.results import error_table
from surgsim_env.reports.output_folder import AnyFolder
from surgsim_env.validation.row import Row, bounded

REPORT_NAME = "validation_measured.md"
INTRODUCTION = """# Recorded presses

Written by `{command}`. Each set is identified by itself: half of its sites, drawn by seed {seed}, choose thickness and
law of the tissue; errors are |F_model - F| / F over the deeper two thirds of the press on the other sites, each with
its own modulus and contact offset by least squares of the force. The linear tissue is the best of all thicknesses. A
row is met where the identified law is not worse than linear tissue. `docs/identify.md` says where recordings are to be
had.
"""
HEADINGS = (
    *("set", "sites used", "held out", "error, median", "90 %", "linear, median", "90 %"),
    *("thickness [mm]", "onset strain", "cap strain", "tangent cap", "verdict"),
)


def read_folder(folder: Path) -> list[Path]:
    """The CSV files of a folder, by name; a ValueError if there is none."""
    if not folder.is_dir():
        raise ValueError(f"--measured {folder}: there is no such folder; give the one with your copy of recordings")
    found = sorted(folder.glob("*.csv"))
    if not found:
        raise ValueError(f"--measured {folder}: no CSV file is there; docs/identify.md tells the columns")
    return found


def identify_folder(folder: Path, options: IdentifyOptions, console: Console) -> list[Identification]:
    """Every set of a folder, identified by itself; they share the presses of the model."""
    recordings = [read_recording(path) for path in read_folder(folder)]
    library = make_library(recordings, options)
    found = []
    for recording in recordings:
        console.print(f"{recording.name}: {len(recording.presses)} sites", highlight=False)
        found.append(identify([recording], options, library=library, console=console))
    return found


def rows_of(found: Sequence[Identification]) -> Iterator[Row]:
    """Two rows for each set: median and 90th percentile of the force error, bounded by that of linear tissue."""
    for result in found:
        for one in result.sets:
            for what, measured, most in (
                ("median", one.error.median, one.linear_error.median),
                ("90th percentile", one.error.high, one.linear_error.high),
            ):
                yield bounded(
                    f"{one.recording.name}, force error, {what}", "recorded, held-out sites; bound: linear tissue",
                    measured=measured, most=most * (1.0 + 1e-9), note=f"{int((~one.is_training).sum())} sites",
                )  # fmt: skip


def print_measured(found: Sequence[Identification], console: Console) -> None:
    """Print the errors of all sets, and what is to be known of them."""
    console.print(error_table([one for result in found for one in result.sets]))
    for result in found:
        for line in result.warnings:
            if "left out" in line:
                console.print(f"note: {line}", highlight=False, markup=False)


def write_measured(found: Sequence[Identification], folder: AnyFolder, command: str) -> None:
    """Write the table as `validation_measured.md`."""
    seed = found[0].options.seed
    lines = [
        INTRODUCTION.format(command=command, seed=seed),
        f"| {' | '.join(HEADINGS)} |",
        "|---" * len(HEADINGS) + "|",
    ]
    verdicts = {row.case.split(", force error")[0]: row.verdict for row in rows_of(found) if "median" in row.case}
    for result in found:
        shape = result.shape
        law = (
            ("linear", "", "")
            if result.is_linear
            else tuple(f"{value:.3g}" for value in (shape.onset_strain, shape.cap_strain, shape.tangent_cap))
        )
        for one in result.sets:
            cells = (
                one.recording.name,
                f"{len(one.fits.samples)} of {len(one.recording.presses)}",
                str(int((~one.is_training).sum())),
                *(f"{value:.1%}" for value in (one.error.median, one.error.high)),
                *(f"{value:.1%}" for value in (one.linear_error.median, one.linear_error.high)),
                f"{1e3 * shape.thickness:.3g}",
                *law,
                verdicts[one.recording.name],
            )
            lines.append(f"| {' | '.join(cells)} |")
    (folder / REPORT_NAME).write_text("\n".join(lines) + "\n", encoding="utf-8")
