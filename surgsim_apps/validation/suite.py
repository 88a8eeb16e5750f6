"""Cases in the order of the table, their run, and its verdict against the list of known shortfalls."""

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from surgsim_apps.validation import (
    bars,
    capsule,
    dynamics,
    friction,
    lattice,
    paper_tests,
    punch,
    tissue_law,
    touch,
    under_tip,
)
from surgsim_apps.validation.elements import MISSING, has_fem
from surgsim_apps.validation.row import Case, Curve, Drawing, Result, Row

LAW = tissue_law.STIFFENING
CASES: tuple[Case, ...] = (
    Case("Table I", lattice.table_one),
    Case("mass sum", lattice.mass_sum),
    Case("BCC constants", lattice.constants),
    Case("thick block 8^3", partial(lattice.thick_block, 8)),
    Case("thick block 12^3", partial(lattice.thick_block, 12), slow=True),
    Case("bar in tension", bars.tension),
    Case("clamped torsion", bars.torsion, needs_fem=True),
    Case("cantilever", bars.cantilever_case, needs_fem=True),
    Case("fixed-free rod", bars.rod_case),
    Case("fitted springs, tension", bars.fitted_tension),
    Case("fitted springs, torsion", bars.fitted_torsion, needs_fem=True),
    Case("fitted springs, cantilever", partial(bars.cantilever_case, "fitted"), needs_fem=True),
    Case("fitted springs, rod", partial(bars.rod_case, "fitted")),
    Case("lobe, free corner", bars.lobe_corner, slow=True, needs_fem=True),
    Case("capsule, faces", capsule.faces),
    Case("capsule, curved", capsule.curved),
    Case("capsule, pulled", capsule.pulled),
    Case("damping rate", bars.damping_case),
    Case("stable step", dynamics.stable_step),
    Case("energy", dynamics.energy_drift),
    Case("energy, stretched", dynamics.stretched_energy),
    Case("stable step, stretched", dynamics.strained_step, slow=True),
    Case("passivity, bounces", partial(dynamics.bounces, ((0.005, 0.0005),))),
    Case("passivity, more bounces", partial(dynamics.bounces, dynamics.OTHER_FALLS), slow=True),
    Case("passivity, presses", partial(dynamics.presses, 100)),
    Case("passivity, many presses", partial(dynamics.presses, 1000), slow=True),
    Case("Eshelby, coarse", partial(lattice.eshelby, (3.0,), 0.25, 16)),
    Case("lesion anywhere", lattice.anywhere),
    Case("Eshelby, nu 0.25", partial(lattice.eshelby, (3.0, 5.0, 8.0), 0.25), slow=True),
    Case("Eshelby, nu 0.45", partial(lattice.eshelby, (5.0,), 0.45), slow=True),
    Case("flat punch", partial(punch.hayes, (12, 18))),
    Case("flat punch, fine", partial(punch.hayes, (24,)), slow=True),
    Case("elements of reference", punch.reference_check, needs_fem=True),
    Case("contrast, coarse", partial(punch.contrast, 18, 0.25, punch.COARSE), needs_fem=True),
    Case("contrast, covers", partial(punch.contrast, 24, 0.25, punch.COVERS, "contrast"), slow=True, needs_fem=True),
    Case("contrast, sizes", partial(punch.contrast, 24, 0.25, punch.OTHERS), slow=True, needs_fem=True),
    Case("contrast, nu 0.45", partial(punch.contrast, 24, 0.45, punch.COVERS, "contrast"), slow=True, needs_fem=True),
    Case("graded block", lattice.graded_block),
    Case("graded prism", bars.graded_prism, needs_fem=True),
    Case("graded punch", punch.graded_punch, slow=True, needs_fem=True),
    Case("graded liver", lattice.graded_liver),
    Case("ball", partial(touch.ball_on_layer, 12, (0.001, 0.002, 0.003, 0.004)), slow=True, needs_fem=True),
    Case("ball, fine", partial(touch.ball_on_layer, 18, (0.0015, 0.002, 0.003, 0.004)), slow=True, needs_fem=True),
    Case("touch, 0.88", partial(touch.sites, 12, 0.008, 0.004, 100, 0.20, 0.03, 0.12), slow=True, needs_fem=True),
    Case("touch, 0.70", partial(touch.sites, 12, 0.010, 0.0051, 100, 0.20, 0.01, 0.04), slow=True, needs_fem=True),
    Case("touch, 0.50", partial(touch.sites, 20, 0.008, 0.0045, 8, 0.10, None, None), slow=True, needs_fem=True),
    *(
        Case(
            f"touch, contrast, {lesion.name}, {cells}",
            partial(touch.contrast, cells, lesion),
            slow=True,
            needs_fem=True,
        )
        for cells, lesion in touch.CONTRASTS
    ),
    Case("under the tip, block", under_tip.block_presses, slow=True, needs_fem=True),
    Case("under the tip, drags", under_tip.drags),
    Case("under the tip, dome", under_tip.dome_presses, slow=True, needs_fem=True),
    Case("under the tip, hidden", under_tip.hidden_by_contact, slow=True, needs_fem=True),
    Case("mesh bias", partial(touch.bias, 12, touch.BIAS_PRESSES), slow=True, needs_fem=True),
    Case("mesh bias, fine", partial(touch.bias, 16, touch.BIAS_PRESSES), slow=True, needs_fem=True),
    Case("liver, contrast", touch.liver_contrast, slow=True, needs_fem=True),
    Case("large strain, linear", partial(tissue_law.large_strain, "slide", 6, None)),
    Case("large strain, stiffening", partial(tissue_law.large_strain, "slide", 6, LAW)),
    Case("large strain, pull", partial(tissue_law.large_strain, "pull", 12, LAW), slow=True, needs_fem=True),
    Case("large strain, shear", partial(tissue_law.large_strain, "shear", 16, LAW), slow=True, needs_fem=True),
    Case("stiffening in all directions", tissue_law.all_directions),
    Case("stiffening, ellipticity", tissue_law.ellipticity),
    Case("step strain", partial(tissue_law.step_strain, tissue_law.ARMS)),
    Case("step strain, stiffening", partial(tissue_law.step_strain, tissue_law.ARMS, LAW)),
    Case("creep", partial(tissue_law.creep, tissue_law.ARMS, 0.25)),
    Case("creep, nu 0.45", partial(tissue_law.creep, tissue_law.ARMS, 0.45)),
    Case("press held", partial(tissue_law.held_press, 12), slow=True, needs_fem=True),
    Case("deep presses", touch.deep_presses),
    Case("sliding", friction.sliding, slow=True),
    Case("grasped strip", friction.grasped_strip),
    Case("on supports", friction.on_supports),
    Case("test A", paper_tests.run_test_a),
    Case("test B", paper_tests.run_test_b),
    Case("cosine load", partial(lattice.cosine_load, (3, 6))),
)
SHORTFALLS = Path(__file__).with_name("known_shortfalls.toml")


@dataclass(frozen=True)
class Shortfall:
    """Known shortfall: reason of a case that is not met, the largest error for that reason, and its cause."""

    reason: str
    error: float
    cause: str


@dataclass(frozen=True)
class Validation:
    """Results of a run: rows, curves and drawings of its cases, true for the quick subset, known shortfalls."""

    rows: tuple[Row, ...]
    curves: tuple[Curve, ...]
    drawings: tuple[Drawing, ...]
    quick: bool
    shortfalls: dict[str, Shortfall]

    def is_known(self, row: Row) -> bool:
        """True for a row that is not met, listed, and no worse than listed."""
        listed = self.shortfalls.get(row.case)
        return listed is not None and row.verdict == "not met" and abs(row.error) <= listed.error

    @property
    def unexplained(self) -> list[Row]:
        """Rows not met and not listed, or worse than listed."""
        return [row for row in self.rows if row.verdict == "not met" and not self.is_known(row)]

    @property
    def outdated(self) -> list[str]:
        """Met cases among the listed shortfalls."""
        return [row.case for row in self.rows if row.verdict == "met" and row.case in self.shortfalls]

    @property
    def passed(self) -> bool:
        """True if every row is met, skipped or a known shortfall."""
        return not self.unexplained

    def reason(self, row: Row) -> str:
        """Note of a row, after the reason of a known shortfall."""
        known = self.shortfalls[row.case].reason if self.is_known(row) else ""
        return "; ".join(part for part in (known, row.note) if part)


def load_shortfalls() -> dict[str, Shortfall]:
    """Known shortfalls by the case's name."""
    table = tomllib.loads(SHORTFALLS.read_text(encoding="utf-8"))
    return {
        case: Shortfall(entry["reason"], error, table["causes"][entry["cause"]])
        for entry in table["shortfall"]
        for case, error in entry["cases"].items()
    }


def run_case(case: Case) -> list[Result]:
    """Results of a case, or a skipped row with the reason."""
    if case.needs_fem and not has_fem():
        return [Row(case.name, "scikit-fem", math.nan, math.nan, math.nan, math.nan, "skipped", note=MISSING)]
    return list(case.run())


def run_cases(*, quick: bool, console: Console, cases: Sequence[Case] = CASES) -> Validation:
    """Run the cases, for a quick run without the slow ones, with a progress bar."""
    shortfalls = load_shortfalls()
    chosen = [case for case in cases if not (quick and case.slow)]
    columns = (TextColumn("{task.description:24}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    results: list[Result] = []
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("", total=len(chosen))
        for case in chosen:
            progress.update(task, description=case.name)
            results += run_case(case)
            progress.advance(task)
    rows = tuple(result for result in results if isinstance(result, Row))
    curves = tuple(result for result in results if isinstance(result, Curve))
    drawings = tuple(result for result in results if isinstance(result, Drawing))
    return Validation(rows, curves, drawings, quick, shortfalls)
