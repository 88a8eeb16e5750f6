"""Reference solutions by scikit-fem: quadratic hexahedra for blocks, a development dependency imported where used."""

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.linalg import eigsh

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.validation.statics import solve_displacement

MISSING = "scikit-fem is not installed (pip install 'surgsim[dev]')"


def has_fem() -> bool:
    """Whether scikit-fem can be imported."""
    return find_spec("skfem") is not None


@dataclass(frozen=True, eq=False)
class SolidBlock:
    """Quadratic hexahedra of a block: stiffness [N/m], place of each row's node [m] (n, 3) and its axis (n,)."""

    stiffness: csr_array
    place: FloatArray
    axis: NDArray[np.int64]
    basis: Any

    def rows_at(self, height: float) -> NDArray[np.int64]:
        """Rows whose node lies at a height z [m]."""
        return np.flatnonzero(np.abs(self.place[:, 2] - height) < 1e-9)


def solid_block(
    size: tuple[float, float, float], cells: tuple[int, int, int], youngs_modulus: float, poisson_ratio: float
) -> SolidBlock:
    """The block [0, sx] x [0, sy] x [0, sz] of an isotropic solid in quadratic hexahedra (27 nodes each)."""
    from skfem import Basis, ElementHex2, ElementVector, MeshHex
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    mesh = MeshHex.init_tensor(*(np.linspace(0.0, length, count + 1) for length, count in zip(size, cells)))
    basis = Basis(mesh, ElementVector(ElementHex2()), intorder=4)
    matrix = linear_elasticity(*lame_parameters(youngs_modulus, poisson_ratio)).assemble(basis)
    axis = np.zeros(basis.N, dtype=np.int64)
    for dofs in (basis.nodal_dofs, basis.edge_dofs, basis.facet_dofs, basis.interior_dofs):
        for component in range(3):
            axis[np.asarray(dofs)[component::3]] = component
    return SolidBlock(csr_array(matrix), basis.doflocs.T, axis, basis)


def clamped_torsion(size: tuple[float, float, float], cells: tuple[int, int, int], modulus: float, nu: float) -> float:
    """Torque per angle about z of a block whose ends are turned as rigid plates [N m/rad]."""
    block = solid_block(size, cells, modulus, nu)
    top = block.rows_at(size[2])
    held = np.concatenate([block.rows_at(0.0), top])
    arm = block.place[top] - np.array([0.5 * size[0], 0.5 * size[1], 0.0])
    turn = np.select([block.axis[top] == 0, block.axis[top] == 1], [-arm[:, 1], arm[:, 0]], 0.0)
    value = np.concatenate([np.zeros(len(held) - len(top)), turn])
    displacement = solve_displacement(block.stiffness, held, value)
    return float(displacement @ (block.stiffness @ displacement))


def cantilever(
    size: tuple[float, float, float], cells: tuple[int, int, int], modulus: float, nu: float, density: float
) -> tuple[float, float]:
    """Deflection of the end face per force spread over it [m/N], and first frequency [Hz], of a block held at z = 0."""
    from skfem import BilinearForm, FacetBasis, LinearForm
    from skfem.helpers import dot

    block = solid_block(size, cells, modulus, nu)
    end = FacetBasis(block.basis.mesh, block.basis.elem, facets=block.basis.mesh.facets_satisfying(
        lambda x: np.abs(x[2] - size[2]) < 1e-9, boundaries_only=True), intorder=4)  # fmt: skip
    load = LinearForm(lambda v, w: v[0] / (size[0] * size[1])).assemble(end)
    root = block.rows_at(0.0)
    displacement = solve_displacement(block.stiffness, root, 0.0, load)
    mass = BilinearForm(lambda u, v, w: density * dot(u, v)).assemble(block.basis)
    free = np.setdiff1d(np.arange(len(block.place)), root)
    inner, weight = block.stiffness[free][:, free].tocsc(), mass[free][:, free].tocsc()
    value = eigsh(inner, k=1, M=weight, sigma=0.0, return_eigenvectors=False)[0]
    return float(load @ displacement), float(np.sqrt(value)) / (2.0 * np.pi)
