"""Hide lesions in an organ at random, palpate it, and count the findings of each map.

    surgsim organ kidney.stl --length-unit mm --out kidney/organ.vtu
    python benchmarks/detection.py kidney/organ.toml --draws 5

A draw places lesions below random sites of the raster: their radius is 0.173 times the cube root of the organ's volume,
between 10 and 19 mm, their cover 3 to 6 mm, their modulus 8 times the healthy one. A lesion that sticks out of the
organ or touches another is drawn again. Prints a row for each draw and map and a table of all draws, and exits 1 at a
miss without a reason.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from msdm_core.material import Lesion
from msdm_core.mesh import FloatArray
from surgsim_apps.palpate.palpation import (
    MODEL_MODULUS_ERROR,
    PalpationResult,
    load_stable_anatomy,
    run_palpation,
)
from surgsim_apps.palpate.sites import plan_sites
from surgsim_env.scene import Anatomy, load_anatomy, load_scene
from surgsim_env.step_progress import StepProgress

RATIO = 8.0
RADIUS_SHARE, RADIUS_RANGE = 0.173, (0.010, 0.019)
COVER_RANGE = (0.003, 0.006)
TRIES = 2000


def draw_lesions(anatomy: Anatomy, count: int, rng: np.random.Generator) -> list[Lesion]:
    """Lesions below random sites, whole and apart.

    Raises:
        ValueError: no place for one of them in TRIES tries.
    """
    sites, _, _ = plan_sites(anatomy)
    volume = float(anatomy.mesh.volumes.sum())
    radius = float(np.clip(RADIUS_SHARE * np.cbrt(volume), *RADIUS_RANGE))
    lesions: list[Lesion] = []
    centres: list[FloatArray] = []
    for _ in range(TRIES):
        site = int(rng.integers(len(sites)))
        cover = float(rng.uniform(*COVER_RANGE))
        lesion = anatomy.lesion_below(sites[site], radius, cover, RATIO, f"lesion {len(lesions) + 1}")
        centre = np.array(lesion.centre)
        if any(np.linalg.norm(centre - other) < 2.0 * radius for other in centres):
            continue
        try:
            anatomy.check_inside(lesion)
        except ValueError:
            continue
        lesions.append(lesion)
        centres.append(centre)
        if len(lesions) == count:
            return lesions
    raise ValueError(f"{len(lesions)} of {count} lesions of radius {radius * 1e3:.1f} mm fit in {TRIES} tries")


def palpate(scene_file: Path, draw: int, count: int, console: Console) -> PalpationResult:
    """One draw: other lesions, another error of the model, other noise."""
    scene = load_scene(scene_file)
    lesions = draw_lesions(load_anatomy(scene), count, np.random.default_rng((draw, 1)))
    anatomy = load_stable_anatomy(scene, lesions, modulus_factor_largest=1.0 + MODEL_MODULUS_ERROR)
    with StepProgress(console) as progress:
        return run_palpation(anatomy, lesions=lesions, seed=draw, progress=progress)


def show(name: str, draw: int, result: PalpationResult, console: Console) -> int:
    """Print the findings of each map in a draw, and reasons of its misses; returns the misses without a reason."""
    unexplained = 0
    for contrast in result.maps:
        reasons = [miss.text for miss in result.misses if miss.map_name == contrast.name]
        unexplained += len(contrast.scores) - contrast.felt_count - len(reasons)
        console.print(
            f"{name}, draw {draw}, {contrast.name}: {contrast.felt_count} of {len(contrast.scores)}, "
            f"{contrast.false_alarms} false alarms, {result.wall_time:.0f} s"
            + "".join(f"\n    {text}" for text in reasons),
            markup=False, highlight=False, soft_wrap=True,
        )  # fmt: skip
    return unexplained


def add_rows(table: Table, name: str, results: Sequence[PalpationResult]) -> None:
    """Add a row for each map over the draws of an organ."""
    scene = results[0].anatomy.scene
    allowed = 0.5 * (scene.instrument.tip_radius + scene.palpation.site_spacing) * 1e3
    for maps in zip(*(result.maps for result in results), strict=True):
        scores = [score for contrast in maps for score in contrast.scores]
        errors = [score.error * 1e3 for score in scores if score.felt]
        table.add_row(
            name, maps[0].name, f"{len(errors)} of {len(scores)}", f"{np.median(errors):.1f}" if errors else "-",
            f"{allowed:.1f}", f"{np.mean([contrast.false_alarms for contrast in maps]):.2f}",
            str(len(results[0].presses)),
        )  # fmt: skip


def main() -> int:
    """Read the arguments, palpate, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, help="scene files, as `surgsim organ` writes them")
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--lesions", type=int, default=3)
    options = parser.parse_args()
    console = Console(width=120)
    table = Table("organ", "map", "found", "median error [mm]", "allowed [mm]", "false alarms a run", "sites")
    unexplained = 0
    for file in options.scenes:
        results = []
        for draw in range(options.draws):
            results.append(palpate(file, draw, options.lesions, console))
            unexplained += show(file.stem, draw, results[-1], console)
        add_rows(table, file.stem, results)
    console.print(table)
    return 1 if unexplained else 0


if __name__ == "__main__":
    sys.exit(main())
