"""Reference solutions by quadratic elements of scikit-fem, a development dependency imported where it is used.

Hexahedra for blocks; tets on an organ's mesh; axisymmetric quadrilaterals for the press of a punch on a bonded layer.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import eigsh, spsolve

from msdm_core.mesh import FloatArray, IntArray, TetMesh
from surgsim_apps.validation.statics import solve_displacement

MISSING = "scikit-fem is not installed (pip install 'surgsim[dev]')"
Size = tuple[float, float, float]
Cells = tuple[int, int, int]


def has_fem() -> bool:
    """True if scikit-fem can be imported."""
    return find_spec("skfem") is not None


@dataclass(frozen=True, eq=False)
class Elements:
    """Elements of a solid: stiffness [N/m], place of each row's node [m] (n, dimension) and its axis (n,).

    The place is (x, y, z) in a block; (r, z) in a layer, a disc z = -depth to 0 held below.
    """

    stiffness: csr_array
    place: FloatArray
    axis: NDArray[np.int64]
    basis: Any

    @classmethod
    def assembled(cls, form: Any, basis: Any) -> "Elements":
        """Elements of a basis with the stiffness of a bilinear form."""
        axis, dimension = np.zeros(basis.N, dtype=np.int64), len(basis.doflocs)
        for dofs in (basis.nodal_dofs, basis.edge_dofs, basis.facet_dofs, basis.interior_dofs):
            for component in range(dimension):
                axis[np.asarray(dofs)[component::dimension]] = component
        return cls(csr_array(form.assemble(basis)), basis.doflocs.T, axis, basis)

    def rows_at(self, height: float) -> NDArray[np.int64]:
        """Rows of nodes at a height z [m]."""
        return np.flatnonzero(np.abs(self.place[:, -1] - height) < 1e-9)

    @property
    def held(self) -> NDArray[np.bool_]:
        """Fixed rows of a layer: the bonded floor, and motion across the axis on it."""
        on_axis = (self.place[:, 0] < 1e-12) & (self.axis == 0)
        return on_axis | (self.place[:, 1] <= self.place[:, 1].min() + 1e-12)


def solid_block(size: Size, cells: Cells, youngs_modulus: float, poisson_ratio: float) -> Elements:
    """Block [0, sx] x [0, sy] x [0, sz] of an isotropic solid in quadratic hexahedra (27 nodes each)."""
    from skfem import Basis, ElementHex2, ElementVector, MeshHex
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    mesh = MeshHex.init_tensor(*(np.linspace(0.0, length, count + 1) for length, count in zip(size, cells)))
    basis = Basis(mesh, ElementVector(ElementHex2()), intorder=4)
    return Elements.assembled(linear_elasticity(*lame_parameters(youngs_modulus, poisson_ratio)), basis)


def tet_compliance(mesh: TetMesh, triangles: IntArray, youngs_modulus: float, poisson_ratio: float) -> FloatArray:
    """Mean displacement per force along x, y, z [m/N] of triangles that bear it evenly, (3,), of a body held at y = 0.

    Quadratic tets on the given mesh; `triangles` (n, 3) are of its surface.
    """
    from skfem import Basis, ElementTetP2, ElementVector, FacetBasis, LinearForm, MeshTet
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    tets = MeshTet(np.ascontiguousarray(mesh.points.T), np.ascontiguousarray(mesh.tets.T.astype(np.int64)))
    basis = Basis(tets, ElementVector(ElementTetP2()), intorder=2)
    body = Elements.assembled(linear_elasticity(*lame_parameters(youngs_modulus, poisson_ratio)), basis)
    loaded = {tuple(nodes) for nodes in np.sort(triangles, axis=1).tolist()}
    corners = np.sort(np.asarray(tets.facets), axis=0).T.tolist()
    facets = [facet for facet in tets.boundary_facets() if tuple(corners[facet]) in loaded]
    face = FacetBasis(tets, basis.elem, facets=np.array(facets), intorder=2)
    compliance = np.zeros(3)
    for axis in range(3):
        force = LinearForm(lambda v, w, axis=axis: v[axis]).assemble(face)
        force /= force.sum()
        displacement = solve_displacement(body.stiffness, np.flatnonzero(body.place[:, 1] < 1e-9), 0.0, force)
        compliance[axis] = force @ displacement
    return compliance


def clamped_torsion(size: Size, cells: Cells, modulus: float, nu: float) -> float:
    """Torque per angle about z of a block with ends turned as rigid plates [N m/rad]."""
    block = solid_block(size, cells, modulus, nu)
    top = block.rows_at(size[2])
    held = np.concatenate([block.rows_at(0.0), top])
    arm = block.place[top] - np.array([0.5 * size[0], 0.5 * size[1], 0.0])
    turn = np.select([block.axis[top] == 0, block.axis[top] == 1], [-arm[:, 1], arm[:, 0]], 0.0)
    value = np.concatenate([np.zeros(len(held) - len(top)), turn])
    displacement = solve_displacement(block.stiffness, held, value)
    return float(displacement @ (block.stiffness @ displacement))


def cantilever(size: Size, cells: Cells, modulus: float, nu: float, density: float) -> tuple[float, float]:
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


def layer(
    radius: float, depth: float, modulus: Callable[[FloatArray, FloatArray], FloatArray], poisson_ratio: float
) -> Elements:
    """Bonded disc of modulus E(r, z) [Pa]: elements of 0.4 mm in the 16 mm around the press, wider ones elsewhere."""
    from skfem import Basis, BilinearForm, ElementQuad2, ElementVector, MeshQuad
    from skfem.helpers import ddot, sym_grad

    across = np.concatenate([np.arange(0.0, 0.016, 4e-4), np.linspace(0.016, radius, 13)])
    down = np.concatenate([np.arange(0.0, 0.020, 4e-4), np.linspace(0.020, depth, 9)])
    basis = Basis(MeshQuad.init_tensor(across, -down[::-1]), ElementVector(ElementQuad2()), intorder=5)

    def energy(u: Any, v: Any, w: Any) -> Any:
        r, z = w.x
        shear = modulus(r, z) / (2.0 * (1.0 + poisson_ratio))
        lame = 2.0 * shear * poisson_ratio / (1.0 - 2.0 * poisson_ratio)
        hoop, hoop_v = u[0] / r, v[0] / r
        strain, strain_v = sym_grad(u), sym_grad(v)
        volume = strain[0, 0] + strain[1, 1] + hoop
        volume_v = strain_v[0, 0] + strain_v[1, 1] + hoop_v
        return 2.0 * np.pi * r * (lame * volume * volume_v + 2.0 * shear * (ddot(strain, strain_v) + hoop * hoop_v))

    return Elements.assembled(BilinearForm(energy), basis)


def punch_stiffness(body: Elements, radius: float) -> float:
    """Force per depth of a flat frictionless punch [N/m]."""
    under = (body.place[:, 1] > -1e-12) & (body.place[:, 0] <= radius + 1e-9) & (body.axis == 1)
    displacement = np.where(under, -1.0, 0.0)
    free = np.flatnonzero(~(under | body.held))
    stiffness = csc_array(body.stiffness)
    right = -(stiffness @ displacement)[free]
    displacement[free] = spsolve(stiffness[free][:, free].tocsc(), right)
    return float(displacement @ (stiffness @ displacement))


class BallContact:
    """Frictionless ball on the top of a layer, small strains, by the contact law of this package.

    Pressure per undeformed area k_p g (s / R), g = s (s + t) / R, with s^2 = R^2 - r^2 and the height t of the surface
    over the ball's centre; points with s + t > 0 are engaged.

    Args:
        body: the layer.
        radius: R of the ball [m].
        stiffness: k_p [N/m^3].
    """

    def __init__(self, body: Elements, radius: float, stiffness: float) -> None:
        from skfem import BilinearForm, FacetBasis, LinearForm

        self.surface = FacetBasis(
            body.basis.mesh, body.basis.elem,
            facets=body.basis.mesh.facets_satisfying(lambda x: np.abs(x[1]) < 1e-12), intorder=5,
        )  # fmt: skip
        self.radius, self.vertical = radius, body.axis == 1

        def weight(w: Any) -> tuple[Any, Any]:
            chord = np.sqrt(np.maximum(radius**2 - w.x[0] ** 2, 0.0))
            overlap = chord + w.prev[1] - (radius - w.depth)
            touching = (overlap > 0.0) & (chord > 0.0)
            return 2.0 * np.pi * w.x[0] * stiffness * (chord / radius) ** 2 * touching, chord

        self.stiff = BilinearForm(lambda u, v, w: weight(w)[0] * u[1] * v[1])
        self.push = LinearForm(lambda v, w: weight(w)[0] * (weight(w)[1] - (radius - w.depth)) * v[1])

    def engaged(self, displacement: FloatArray, depth: float) -> tuple[csc_array, FloatArray]:
        """Stiffness [N/m] and load [N] of the engaged points at a displacement and a depth of the ball [m].

        The ball exerts stiffness u + load.
        """
        state = {"prev": self.surface.interpolate(displacement), "depth": depth}
        return csc_array(self.stiff.assemble(self.surface, **state)), self.push.assemble(self.surface, **state)

    def pressed(
        self, stiffness: csc_array, load: FloatArray, held: NDArray[np.bool_], displacement: FloatArray, depth: float
    ) -> float:
        """Force of the ball [N] at a depth [m], on a body in equilibrium under a load; fills `displacement`.

        Newton's method on the set of engaged points, from the displacement.
        """
        free = np.flatnonzero(~held)
        force = 0.0
        for _ in range(60):
            held_off, push = self.engaged(displacement, depth)
            # The sum of sparse arrays is typed as their base, which has no indexing.
            whole = csc_array(stiffness + held_off)[free][:, free].tocsc()
            displacement[free] = np.asarray(spsolve(whole, (load - push)[free], permc_spec="MMD_AT_PLUS_A"))
            previous, force = force, float((held_off @ displacement + push)[self.vertical].sum())
            if abs(force - previous) <= 1e-6 * abs(force):
                return force
        raise ValueError("the reference for the ball did not converge")
