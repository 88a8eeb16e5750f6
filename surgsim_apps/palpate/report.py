"""Printed report of a palpation."""

import math

from rich.console import Console
from rich.table import Table

from surgsim_apps.palpate.contrast_map import ContrastMap, LesionScore
from surgsim_apps.palpate.palpation import MODEL, PalpationResult


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
        healthy = "-" if math.isnan(entry.healthy_std) else f"1 ± {entry.healthy_std:.2f} ({entry.healthy_count})"
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
    early = int((~palpation.used).sum())
    console.print(
        f"{len(palpation.presses)} sites pressed, {early} ended early and left out, {palpation.support_count} not "
        f"pressed near supports; peak force {max(press.force_peak for press in palpation.presses):.2f} N"
    )


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
