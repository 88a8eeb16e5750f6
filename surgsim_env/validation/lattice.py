"""Springs and elastic constants of the BCC lattice, and the moduli of thick blocks."""

import numpy as np
from scipy.sparse import csr_array

from msdm_core.material.stiffness import spring_network
from msdm_core.mesh.tet_mesh import FloatArray, TetMesh
from msdm_core.meshing.lattice_meshing import box_mesh
from surgsim_env.validation.row import Outcome, Row, compare
from surgsim_env.validation.statics import (
    assemble_stiffness,
    linear_organ,
    nodal_dofs,
    solve_displacement,
    twice_energy,
)

MODULUS = 20e3  # [Pa]
CELL = 0.01  # [m]
CUBE_ROOT_2 = 2.0 ** (1.0 / 3.0)
FORMULA = "formula (6) on tets of volume a^3/12, by hand"


def constants() -> Outcome:
    """k_cube, k_diag of formula (6), and C11, C12, C44 of the two nodes that fill one cell."""
    mesh = box_mesh((5 * CELL,) * 3, (5,) * 3)
    edges, stiffness = spring_network(mesh, MODULUS)
    length = np.linalg.norm(mesh.points[edges[:, 1]] - mesh.points[edges[:, 0]], axis=1)
    middle = np.abs(mesh.points[edges].mean(axis=1) - 2.5 * CELL).max(axis=1) < 1.1 * CELL
    rows: list[Row] = []
    for name, edge, factor in (("cube", CELL, 8.0 / 25.0), ("diagonal", np.sqrt(0.75) * CELL, 12.0 / 25.0)):
        springs = stiffness[middle & (np.abs(length - edge) < 1e-9)] / (MODULUS * CELL)
        expected = factor * CUBE_ROOT_2
        worst = float(springs[np.argmax(np.abs(springs - expected))])
        rows.append(compare(f"BCC {name} spring / (E a)", FORMULA, expected=expected, measured=worst, tolerance=1e-6))
    tensor = _cell_tensor(mesh, edges, stiffness) / MODULUS
    for name, measured, factor in (
        ("C11", tensor[0, 0, 0, 0], 0.96),
        ("C12", tensor[0, 0, 1, 1], 0.32),
        ("C44", tensor[0, 1, 0, 1], 0.32),
    ):
        rows.append(
            compare(
                f"BCC {name} / E", "sum of k l^2 nnnn over a cell, by hand", expected=factor * CUBE_ROOT_2,
                measured=float(measured), tolerance=1e-6,
            )
        )  # fmt: skip
    return Outcome(tuple(rows))


def _cell_tensor(mesh: TetMesh, edges: np.ndarray, stiffness: FloatArray) -> FloatArray:
    """C_ijkl = (1 / a^3) sum k l^2 n_i n_j n_k n_l over the springs of one corner and one centre node, halved."""
    distance = np.linalg.norm(mesh.points - 2.5 * CELL, axis=1)
    centre = int(np.argmin(distance))
    corner = int(np.argsort(distance, kind="stable")[1])
    share = 0.5 * np.isin(edges, [centre, corner]).sum(axis=1)
    span = mesh.points[edges[:, 1]] - mesh.points[edges[:, 0]]
    weight = share * stiffness / (span * span).sum(axis=1)
    return np.einsum("s,si,sj,sk,sl->ijkl", weight, span, span, span, span) / CELL**3


def thick_block(cells: int) -> Outcome:
    """Uniaxial, shear and bulk modulus of a cube of cells^3 cells at nu 0.25, 0.40 and 0.45."""
    tolerance = 0.03 if cells >= 12 else 0.04
    size = cells * CELL
    mesh = box_mesh((size,) * 3, (cells,) * 3)
    rows: list[Row] = []
    for nu in (0.25, 0.40, 0.45):
        stiffness = assemble_stiffness(linear_organ(mesh, MODULUS, nu))
        shear = np.array([[0.0, 0.5, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.0]])
        found = (
            ("E", uniaxial_modulus(mesh, stiffness, size), MODULUS),
            # W = G gamma^2 / 2 and W = 9 K e^2 / 2.
            ("G", affine_modulus(mesh, stiffness, shear), MODULUS / (2.0 * (1.0 + nu))),
            ("K", affine_modulus(mesh, stiffness, np.eye(3)) / 9.0, MODULUS / (3.0 * (1.0 - 2.0 * nu))),
        )
        rows += [
            compare(
                f"block {cells}^3, nu {nu:.2f}, {name}", "isotropic solid of (E, nu)", expected=expected,
                measured=measured, tolerance=tolerance, unit="Pa",
            )
            for name, measured, expected in found
        ]  # fmt: skip
    return Outcome(tuple(rows))


def uniaxial_modulus(mesh: TetMesh, stiffness: csr_array, size: float, axis: int = 2) -> float:
    """Young's modulus of a cube from a stretch whose ends slide freely [Pa]."""
    place = mesh.points[:, axis]
    low, high = np.flatnonzero(place < 1e-9), np.flatnonzero(place > size - 1e-9)
    held = nodal_dofs(np.concatenate([low, high]), (axis,))
    value = np.repeat([0.0, 1.0], [len(low), len(high)])
    return twice_energy(stiffness, solve_displacement(stiffness, held, value)) / size


def affine_modulus(mesh: TetMesh, stiffness: csr_array, gradient: FloatArray) -> float:
    """Twice the energy per volume of an affine displacement of the whole boundary [Pa]."""
    boundary = np.asarray(mesh.boundary_nodes)
    value = (mesh.points[boundary] @ gradient.T).ravel()
    displacement = solve_displacement(stiffness, nodal_dofs(boundary), value)
    return twice_energy(stiffness, displacement) / float(mesh.volumes.sum())
