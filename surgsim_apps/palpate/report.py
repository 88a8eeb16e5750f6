"""Reports of a palpation: printed, and as a page."""

import itertools
import math
import platform
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from msdm_core.arithmetic import norm
from surgsim_apps.palpate.contrast_map import ContrastMap, LesionScore
from surgsim_apps.palpate.hold import place_text
from surgsim_apps.palpate.palpation import MODEL, MODEL_SITE_ERROR, PalpationResult
from surgsim_apps.palpate.results import surgsim_version
from surgsim_apps.reports.html_page import Picture, render_page

# Cells of a table, the first of which names the row.
Rows = list[tuple[str, ...]]


def print_report(palpation: PalpationResult, console: Console) -> None:
    """Print place, error and contrast of each lesion, the spread of healthy sites, misses and faults of the hold."""
    table = Table(title=f"stiffness of {palpation.anatomy.scene.name}, felt against two baselines")
    table.add_column("against", no_wrap=True)
    table.add_column("lesion")
    for heading in ("felt at\nx, y, z [mm]", "error\n[mm]", "contrast", "healthy\nsites"):
        table.add_column(heading, justify="right", no_wrap=True)
    for entry in palpation.maps:
        # Short enough for a terminal of 80 columns.
        name = "model" if entry.name == MODEL else "neighbours"
        healthy = _healthy_cell(entry)
        for score in entry.scores:
            table.add_row(name, score.truth.name, *_felt_cells(entry, score), healthy)
        if not entry.scores:
            table.add_row(name, "none hidden", f"{len(entry.estimates)} felt", "", "", healthy)
        table.add_section()
    console.print(table)
    for entry in palpation.maps:
        console.print(_verdict(entry))
        for miss in palpation.misses:
            if miss.map_name == entry.name:
                console.print(f"  {miss.lesion}: {miss.text}", highlight=False, markup=False)
    if palpation.hold is not None:
        console.print(f"held: {palpation.hold.text}", highlight=False)
        for fault in palpation.hold.faults:
            # Markup would take [[anchors]] for a style.
            console.print(f"not held well: {fault}", highlight=False, markup=False)
    for line in _extrapolation(palpation):
        console.print(line, highlight=False)
    console.print(_counts(palpation))


def write_report(
    palpation: PalpationResult, path: Path, *, maps: Path, organ: Path, fields: Path, command: str
) -> None:
    """Write the report page.

    Args:
        palpation: its result.
        path: of the page.
        maps: PNG file of `write_stiffness_map`.
        organ: PNG file of `write_organ_picture`.
        fields: PNG file of `record_press`, if it was written.
        command: the command line that repeats this report.
    """
    scene, entries = palpation.anatomy.scene, palpation.maps[::-1]
    map_caption = (
        "Left and middle: stiffness over that of the baseline, seen along the probe's approach. Dots are sites, "
        "squares sites left out, dashed circles the hidden lesions, crosses the felt places with their errors. Right: "
        "force on the tip over a lesion and over healthy tissue; dashed: at the same site of the pre-operative model."
    )
    organ_caption = (
        "The contrast against the pre-operative model as a glow, the sites as dots, and the probe on the place of "
        "the strongest contrast."
    )
    fields_caption = (
        "The surface below the tip (dashed) at the end of a press over the first lesion, or at the first site: the "
        "pressure of each triangle, and means at nodes, over about a cell."
    )
    page = render_page(
        "palpate.html.j2",
        generator="surgsim palpate",
        title=f"Palpation of {scene.name}: {scene.description}",
        verdict=" ".join(map(_sentence, entries)) + f" {_counts(palpation)}.",
        notes=_notes(palpation),
        lesions=_lesion_rows(palpation),
        maps=[
            (entry.name, f"{entry.felt_count} of {len(entry.scores)}", str(entry.false_alarms), _healthy_cell(entry))
            for entry in entries
        ],
        map_picture=Picture.of_file(maps, "Stiffness, and force over depth", map_caption),
        organ_picture=Picture.of_file(organ, "The organ with the probe", organ_caption),
        fields_picture=Picture.of_file(fields, "Fields of a press", fields_caption) if fields.exists() else None,
        settings=_settings(palpation),
        command=command,
    )
    path.write_text(page, encoding="utf-8", newline="\n")


def _sentence(contrast_map: ContrastMap) -> str:
    """The verdict of a map, with the errors of its lesions."""
    errors = ", ".join(f"{score.error * 1e3:.1f}" for score in contrast_map.scores if score.felt)
    return f"Against the {_verdict(contrast_map)}{f', errors {errors} mm' if errors else ''}."


def _notes(palpation: PalpationResult) -> list[str]:
    """Reasons of misses, faults of the organ's hold, and strains beyond the law's."""
    misses = [f"{miss.lesion}, against the {miss.map_name}: {miss.text}." for miss in palpation.misses]
    faults = [] if palpation.hold is None else [f"Not held well: {fault}." for fault in palpation.hold.faults]
    return [*misses, *faults, *(f"{line}." for line in _extrapolation(palpation))]


def _extrapolation(palpation: PalpationResult) -> list[str]:
    """A sentence on presses that strain the tissue beyond its law's support; empty if none does."""
    supported = palpation.anatomy.scene.material.strain_supported
    strains = [press.load.equivalent_strain for press in palpation.presses]
    count = len([strain for strain in strains if strain > supported])
    if not count:
        return []
    return [
        f"at {count} of {len(strains)} sites the equivalent strain ({max(strains):.2f} at most) is beyond "
        f"{supported:.2g}, up to which recorded presses support the tissue's law"
    ]


def _lesion_rows(palpation: PalpationResult) -> Rows:
    """A row for each lesion: true place, then place, error and contrast on each map."""
    rows = Rows()
    for number, truth in enumerate(palpation.truths):
        depth = float(norm(truth.point - truth.centre))
        cells = [_felt_cells(entry, entry.scores[number]) for entry in palpation.maps[::-1]]
        place = f"{depth * 1e3:.1f}", f"{truth.radius * 1e3:.1f}", place_text(truth.point)
        rows.append((truth.name, *place, *itertools.chain(*cells)))
    return rows


def _settings(palpation: PalpationResult) -> Rows:
    """Rows of instrument, presses, organ and program."""
    scene, presses, mesh = palpation.anatomy.scene, palpation.presses, palpation.anatomy.mesh
    tip, depth, material = scene.instrument.tip_radius, scene.palpation.press_depth, scene.material
    forces = np.array([press.force for press in presses])[palpation.used]
    towards = ", ".join(f"{value:.3g}" for value in scene.instrument.approach)
    return [
        ("press", f"ball of {tip * 1e3:g} mm radius, {depth * 1e3:g} mm deep, towards {towards}"),
        ("sites", f"{len(presses)}, {scene.palpation.site_spacing * 1e3:g} mm apart"),
        ("force held at the end", f"{forces.min():.3f} to {forces.max():.3f} N, median {np.median(forces):.3f} N"),
        ("contrast over 1 that contact hides", f"about {palpation.hidden_share:.1%} at the largest force"),
        ("hold", "no complete press" if palpation.hold is None else palpation.hold.text),
        ("organ", f"{mesh.node_count} nodes, {mesh.tet_count} tets, healthy tissue of {material.youngs_modulus:g} Pa"),
        (
            "pre-operative model",
            f"modulus {palpation.model_modulus_factor:.3f} of the organ's, sites {MODEL_SITE_ERROR * 1e3:g} mm off",
        ),
        ("noise of the sensor", f"{scene.sensor.noise:g} N"),
        ("versions", f"surgsim {surgsim_version()}, Python {platform.python_version()}, numpy {np.__version__}"),
    ]


def _counts(palpation: PalpationResult) -> str:
    """Numbers of sites pressed and left out, and largest force, pressure and strain, in a sentence."""
    loads = [press.load for press in palpation.presses]
    return (
        f"{len(palpation.presses)} sites pressed, {int((~palpation.used).sum())} ended early and left out, "
        f"{palpation.support_count} not pressed near supports; "
        f"peak force {max(press.force_peak for press in palpation.presses):.2f} N, at the end of presses contact "
        f"pressure up to {max(load.pressure for load in loads) / 1e3:.1f} kPa, strain up to "
        f"{max(load.strain for load in loads):.2f}"
    )


def _healthy_cell(contrast_map: ContrastMap) -> str:
    if math.isnan(contrast_map.healthy_std):
        return "-"
    return f"1 ± {contrast_map.healthy_std:.2f} ({contrast_map.healthy_count})"


def _verdict(contrast_map: ContrastMap) -> str:
    """Numbers of lesions felt and missed on a map, and of its false alarms, in a sentence."""
    count, missed = len(contrast_map.scores), len(contrast_map.scores) - contrast_map.felt_count
    alarms = f", {contrast_map.false_alarms} false alarm{'s' if contrast_map.false_alarms != 1 else ''}"
    if count == 0:
        return f"{contrast_map.name}: no lesion was hidden{alarms}"
    if missed:
        return f"{contrast_map.name}: {missed} of {count} not felt{alarms}"
    return f"{contrast_map.name}: {'the lesion' if count == 1 else f'all {count} lesions'} felt{alarms}"


def _felt_cells(contrast_map: ContrastMap, score: LesionScore) -> tuple[str, str, str]:
    contrast = "" if math.isnan(score.contrast) else f"{score.contrast:.2f}"
    if score.estimate is None:
        return "not felt", "-", contrast
    x, y, z = contrast_map.estimates[score.estimate].point * 1e3
    mark = "" if score.felt else " miss"
    return f"{x:.1f}, {y:.1f}, {z:.1f}", f"{score.error * 1e3:.1f}{mark}", contrast
