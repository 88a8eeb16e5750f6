"""Springs fitted to the mesh: test A's prism, pulled and twisted, at three Poisson's ratios."""

from msdm_core.material.fitting import spring_fit
from surgsim_env.validation.fem import clamped_torsion
from surgsim_env.validation.prism import (
    MODULUS,
    SIZE,
    cell_size,
    prism_mesh,
    tension_stiffness,
    torsion_stiffness,
)
from surgsim_env.validation.row import Outcome, Row, compare

RATIOS = (0.25, 0.40, 0.45)
# By cells along the thickness: 2 and 4 are the paper's resolution and half of it; at 6 that of formula (6).
TENSION_TOLERANCE = {2: 0.02, 4: 0.02, 6: 0.07}
TORSION_TOLERANCE = 0.20


def tension() -> Outcome:
    """E of the pulled prism."""
    expected = MODULUS * SIZE[0] * SIZE[1] / SIZE[2]
    rows: list[Row] = []
    for across, tolerance in TENSION_TOLERANCE.items():
        report = spring_fit(prism_mesh(across)).report
        rows += [
            compare(
                f"bar in tension, cell {1e3 * cell_size(across):.1f} mm, nu {nu:.2f}, fitted springs", "E A / L",
                expected=expected, measured=tension_stiffness(across, "fitted", nu), tolerance=tolerance,
                unit="N/m", note=f"{prism_mesh(across).node_count} nodes; node forces are {report.residual_after:.0%} "
                f"from the solid's, those of formula (6) {report.residual_before:.0%}",
            )
            for nu in RATIOS
        ]  # fmt: skip
    return Outcome(tuple(rows))


def torsion(counts: tuple[int, ...] = (2, 4)) -> Outcome:
    """Clamped torsion against quadratic hexahedra, formula (6) in the note."""
    rows: list[Row] = []
    for nu in RATIOS:
        expected = clamped_torsion(SIZE, (4, 8, 16), MODULUS, nu)
        rows += [
            compare(
                f"clamped torsion, cell {1e3 * cell_size(across):.1f} mm, nu {nu:.2f}, fitted springs",
                "scikit-fem, quadratic hexahedra", expected=expected,
                measured=torsion_stiffness(across, "fitted", nu), tolerance=TORSION_TOLERANCE, unit="N m/rad",
                note=f"formula (6): {torsion_stiffness(across, nu=nu) / expected - 1.0:+.1%}",
            )
            for across in counts
        ]  # fmt: skip
    return Outcome(tuple(rows))
