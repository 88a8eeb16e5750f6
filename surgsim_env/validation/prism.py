"""Test A of the paper, the 2 x 5 x 10 cm prism: pulled, and twisted with its ends held."""

from functools import lru_cache

import numpy as np
from scipy.sparse import csr_array

from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.meshing.lattice_meshing import box_mesh
from surgsim_env.validation.fem import clamped_torsion
from surgsim_env.validation.row import Curve, Outcome, Row, compare, falling
from surgsim_env.validation.statics import (
    assemble_stiffness,
    linear_organ,
    nodal_dofs,
    solve_displacement,
    twice_energy,
)

SIZE = (0.02, 0.05, 0.10)
MODULUS = 20e3  # [Pa]
# Cells along the thickness of 2 cm, and what facts section 7 gives: tension, torsion by formula (6).
CELLS = (2, 4, 6)
TENSION_TOLERANCE = (0.15, 0.07, 0.07)
# Section 7 gives +55 % and +31 %; at 3.3 mm nothing is given, so two thirds of the 31 % at 5 mm (errors are O(cell)).
TORSION_TOLERANCE = (0.55, 0.31, 0.31 * 2.0 / 3.0)


def cell_size(across: int) -> float:
    """Edge of a cell [m] with `across` cells across the thickness."""
    return SIZE[0] / across


@lru_cache(maxsize=4)
def prism_mesh(across: int) -> TetMesh:
    """The prism with `across` cubic cells across its thickness."""
    return box_mesh(SIZE, np.array((2, 5, 10)) * across // 2)


@lru_cache(maxsize=4)
def _prism(across: int, rule: str, nu: float) -> tuple[TetMesh, csr_array]:
    mesh = prism_mesh(across)
    return mesh, assemble_stiffness(linear_organ(mesh, MODULUS, nu, stiffness_rule=rule))


def _ends(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.flatnonzero(points[:, 2] < 1e-9), np.flatnonzero(points[:, 2] > SIZE[2] - 1e-9)


def tension_stiffness(across: int, rule: str = "lloyd", nu: float = 0.25) -> float:
    """Force per elongation along the 10 cm, ends free to contract [N/m]."""
    return pulled(*_prism(across, rule, nu))


def pulled(mesh: TetMesh, stiffness: csr_array) -> float:
    """The same of any mesh of the prism."""
    low, high = _ends(mesh.points)
    held = nodal_dofs(np.concatenate([low, high]), (2,))
    value = np.repeat([0.0, 1.0], [len(low), len(high)])
    return twice_energy(stiffness, solve_displacement(stiffness, held, value))


def torsion_stiffness(across: int, rule: str = "lloyd", nu: float = 0.25) -> float:
    """Torque per angle with both ends held as rigid plates [N m/rad]."""
    return twisted(*_prism(across, rule, nu))


def twisted(mesh: TetMesh, stiffness: csr_array) -> float:
    """The same of any mesh of the prism."""
    low, high = _ends(mesh.points)
    arm = mesh.points[high] - 0.5 * np.array(SIZE)
    turn = np.stack([-arm[:, 1], arm[:, 0], np.zeros(len(high))], axis=1)
    value = np.concatenate([np.zeros(3 * len(low)), turn.ravel()])
    held = nodal_dofs(np.concatenate([low, high]))
    return twice_energy(stiffness, solve_displacement(stiffness, held, value))


def tension() -> Outcome:
    """The bar's stiffness E A / L = 200 N/m."""
    expected = MODULUS * SIZE[0] * SIZE[1] / SIZE[2]
    rows = [
        compare(
            f"bar in tension, cell {1e3 * cell_size(across):.1f} mm", "E A / L", expected=expected,
            measured=tension_stiffness(across), tolerance=tolerance, unit="N/m",
        )
        for across, tolerance in zip(CELLS, TENSION_TOLERANCE, strict=True)
    ]  # fmt: skip
    return _with_order("bar in tension", rows)


def torsion() -> Outcome:
    """Clamped torsion against quadratic hexahedra."""
    expected = clamped_torsion(SIZE, (4, 8, 16), MODULUS, 0.25)
    rows = [
        compare(
            f"clamped torsion, cell {1e3 * cell_size(across):.1f} mm", "scikit-fem, quadratic hexahedra",
            expected=expected, measured=torsion_stiffness(across), tolerance=tolerance, unit="N m/rad",
        )
        for across, tolerance in zip(CELLS, TORSION_TOLERANCE, strict=True)
    ]  # fmt: skip
    return _with_order("clamped torsion", rows)


def _with_order(name: str, rows: list[Row]) -> Outcome:
    sizes, errors = [cell_size(across) for across in CELLS], [row.error for row in rows]
    curve = Curve("convergence", name, tuple(1e3 * size for size in sizes), tuple(abs(error) for error in errors))
    return Outcome((*rows, falling(f"{name}, order of the error", sizes, errors)), (curve,))
