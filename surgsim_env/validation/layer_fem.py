"""Reference for presses on a bonded layer: axisymmetric quadratic elements by scikit-fem, punch or ball."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import spsolve

from msdm_core.mesh.tet_mesh import FloatArray

Field = Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class Layer:
    """A disc z = -depth to 0, held below: stiffness [N/m], place (r, z) of each row's node [m] (n, 2), axis (n,)."""

    stiffness: csc_array
    place: FloatArray
    axis: NDArray[np.int64]
    basis: Any

    @property
    def held(self) -> NDArray[np.bool_]:
        """Rows that do not move: the bonded floor, and no motion across the axis."""
        on_axis = (self.place[:, 0] < 1e-12) & (self.axis == 0)
        return on_axis | (self.place[:, 1] <= self.place[:, 1].min() + 1e-12)


def layer(radius: float, depth: float, modulus: Field, poisson_ratio: float, *, fine: float = 4e-4) -> Layer:
    """A bonded disc of modulus E(r, z) [Pa], with `fine` elements [m] in the 16 mm around the press, and wider ones."""
    from skfem import Basis, BilinearForm, ElementQuad2, ElementVector, MeshQuad
    from skfem.helpers import ddot, sym_grad

    across = np.concatenate([np.arange(0.0, 0.016, fine), np.linspace(0.016, radius, 13)])
    down = np.concatenate([np.arange(0.0, 0.020, fine), np.linspace(0.020, depth, 9)])
    mesh = MeshQuad.init_tensor(across, -down[::-1])
    basis = Basis(mesh, ElementVector(ElementQuad2()), intorder=5)

    def energy(u: Any, v: Any, w: Any) -> Any:
        r, z = w.x
        shear = modulus(r, z) / (2.0 * (1.0 + poisson_ratio))
        lame = 2.0 * shear * poisson_ratio / (1.0 - 2.0 * poisson_ratio)
        hoop, hoop_v = u[0] / r, v[0] / r
        strain, strain_v = sym_grad(u), sym_grad(v)
        volume = strain[0, 0] + strain[1, 1] + hoop
        volume_v = strain_v[0, 0] + strain_v[1, 1] + hoop_v
        return 2.0 * np.pi * r * (lame * volume * volume_v + 2.0 * shear * (ddot(strain, strain_v) + hoop * hoop_v))

    matrix = BilinearForm(energy).assemble(basis)
    axis = np.zeros(basis.N, dtype=np.int64)
    for dofs in (basis.nodal_dofs, basis.facet_dofs, basis.interior_dofs):
        axis[np.asarray(dofs)[1::2]] = 1
    return Layer(csc_array(matrix), basis.doflocs.T, axis, basis)


def punch_stiffness(body: Layer, radius: float) -> float:
    """Force per depth of a flat frictionless punch [N/m]."""
    under = (body.place[:, 1] > -1e-12) & (body.place[:, 0] <= radius + 1e-9) & (body.axis == 1)
    displacement = np.where(under, -1.0, 0.0)
    free = np.flatnonzero(~(under | body.held))
    right = -(body.stiffness @ displacement)[free]
    displacement[free] = spsolve(body.stiffness[free][:, free].tocsc(), right)
    return float(displacement @ (body.stiffness @ displacement))


def ball_force(body: Layer, radius: float, depth: float, contact_stiffness: float) -> float:
    """Force of a frictionless ball pressed in [N], small strains, the contact law of this package.

    Pressure per undeformed area k_p g (s / R), g = s (s + t) / R, where s^2 = R^2 - r^2 and t is the height of the
    surface over the ball's centre; its points are engaged where s + t > 0 (Newton on the set of these).
    """
    from skfem import BilinearForm, FacetBasis, LinearForm

    surface = FacetBasis(
        body.basis.mesh, body.basis.elem, facets=body.basis.mesh.facets_satisfying(lambda x: np.abs(x[1]) < 1e-12),
        intorder=5,
    )  # fmt: skip

    def weight(w: Any) -> Any:
        chord = np.sqrt(np.maximum(radius**2 - w.x[0] ** 2, 0.0))
        overlap = chord + w.prev[1] - (radius - depth)
        touching = (overlap > 0.0) & (chord > 0.0)
        return 2.0 * np.pi * w.x[0] * contact_stiffness * (chord / radius) ** 2 * touching, chord

    stiff = BilinearForm(lambda u, v, w: weight(w)[0] * u[1] * v[1])
    push = LinearForm(lambda v, w: weight(w)[0] * (weight(w)[1] - (radius - depth)) * v[1])
    displacement = np.zeros(len(body.place))
    free = np.flatnonzero(~body.held)
    force = 0.0
    for _ in range(60):
        before = surface.interpolate(displacement)
        held_off, load = csc_array(stiff.assemble(surface, prev=before)), push.assemble(surface, prev=before)
        # The sum of sparse arrays is typed as their base, which has no indexing.
        whole = csc_array(body.stiffness + held_off)[free][:, free].tocsc()
        displacement[free] = np.asarray(spsolve(whole, -load[free]))
        previous, force = force, float((held_off @ displacement + load)[body.axis == 1].sum())
        if abs(force - previous) <= 1e-6 * abs(force):
            return force
    raise ValueError("the reference for the ball did not converge")
