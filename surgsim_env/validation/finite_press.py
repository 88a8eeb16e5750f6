"""A ball pressed into a bonded layer at finite strains: axisymmetric neo-Hookean finite elements of scikit-fem.

The ball is rigid and frictionless; what holds the surface off it is a pressure per undeformed area, k_p times the
penetration, as in the contact law of this package. With a large k_p this is a rigid ball without penetration.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from msdm_core.mesh.tet_mesh import FloatArray

# Pressure per penetration that stands for a rigid ball [N/m^3]: 5 kPa make 2.5 um.
RIGID = 2e9
# Largest step of the depth [m], Newton's tolerance on the residual over the ball's force, and its most iterations.
DEPTH_STEP = 5e-4
TOLERANCE = 1e-6
ITERATIONS = 40
HALVINGS = 6

Modulus = Callable[[FloatArray, FloatArray], FloatArray]


def neo_hookean(gradient: NDArray, hoop: NDArray, shear: NDArray, lame: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """First Piola stress P and hoop stress [Pa] of W = mu (I1 - 3 - 2 ln J) / 2 + lambda (J - 1)^2 / 2, and J.

    Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis (2008), 6.4.3, with (J - 1)^2 in place of
    (ln J)^2, as the volume term of the organ has it.

    Args:
        gradient: in-plane deformation gradient F (2, 2, ...).
        hoop: stretch around the axis (...).
        shear: mu [Pa] (...).
        lame: lambda [Pa] (...).
    """
    flat = gradient[0, 0] * gradient[1, 1] - gradient[0, 1] * gradient[1, 0]
    ratio = flat * hoop
    inverse = np.array([[gradient[1, 1], -gradient[1, 0]], [-gradient[0, 1], gradient[0, 0]]]) / flat
    volume = lame * (ratio - 1.0) * ratio - shear
    return shear * gradient + volume * inverse, shear * hoop + volume / hoop, ratio


def layer_mesh(radius: float, depth: float, fine: float, reach: tuple[float, float]) -> Any:
    """Quadrilaterals of a disc r = 0 to radius, z = -depth to 0 [m], `fine` large within a reach (r, z), then wider."""
    from skfem import MeshQuad

    def line(length: float, near: float) -> FloatArray:
        inner = np.linspace(0.0, near, round(near / fine) + 1)
        widths = [fine]
        while inner[-1] + sum(widths[1:]) < length:
            widths.append(1.3 * widths[-1])
        outer = inner[-1] + np.cumsum(widths[1:]) * (length - inner[-1]) / sum(widths[1:])
        return np.concatenate([inner, outer])

    return MeshQuad.init_tensor(line(radius, reach[0]), -line(depth, reach[1])[::-1])


class PressedLayer:
    """A bonded layer of modulus E(r, z) [Pa] under a ball, quadratic elements at finite strain."""

    def __init__(
        self, mesh: Any, modulus: Modulus, poisson_ratio: float, *, membrane: float = 0.0, membrane_ratio: float = 0.5
    ) -> None:
        """Make the layer at rest.

        Args:
            mesh: of `layer_mesh`.
            modulus: Young's modulus at places (r, z) [Pa].
            poisson_ratio: of all of it.
            membrane: modulus times thickness of a membrane on its top [N/m].
            membrane_ratio: Poisson's ratio of the membrane.
        """
        from skfem import Basis, ElementQuad2, ElementVector, FacetBasis

        self._basis = Basis(mesh, ElementVector(ElementQuad2()), intorder=4)
        self._top = FacetBasis(
            mesh, self._basis.elem, facets=mesh.facets_satisfying(lambda x: np.abs(x[1]) < 1e-12), intorder=5
        )
        place, axis = self._basis.doflocs, np.zeros(self._basis.N, dtype=np.int64)
        for dofs in (self._basis.nodal_dofs, self._basis.facet_dofs, self._basis.interior_dofs):
            axis[np.asarray(dofs)[1::2]] = 1
        self._up = axis == 1
        held = ((place[0] < 1e-12) & ~self._up) | (place[1] <= place[1].min() + 1e-12)
        self._free = np.flatnonzero(~held)
        r, z = self._basis.global_coordinates().value
        shear = modulus(r, z) / (2.0 * (1.0 + poisson_ratio))
        self._moduli = shear, 2.0 * shear * poisson_ratio / (1.0 - 2.0 * poisson_ratio)
        self._membrane = membrane / (1.0 - membrane_ratio**2), membrane_ratio
        self._displacement = np.zeros(self._basis.N)

    def forces(self, radius: float, depths: Sequence[float], contact_stiffness: float = RIGID) -> list[float]:
        """Force of the ball at each of some rising depths of its lowest point below the surface at rest [N].

        Raises:
            ValueError: Newton's method does not converge.
        """
        found: list[float] = []
        displacement = np.zeros(self._basis.N)
        reached, target = 0.0, 0.0
        for depth in depths:
            step = DEPTH_STEP
            while reached < depth - 1e-12:
                target = min(depth, reached + step)
                after = self._balanced(displacement, radius, target, contact_stiffness)
                if after is None:
                    step *= 0.5
                    if step < DEPTH_STEP / 2**HALVINGS:
                        raise ValueError(f"the reference for the ball did not converge at {target * 1e3:.3g} mm")
                    continue
                displacement, reached = after, target
            _, push = self._contact(displacement, radius, reached, contact_stiffness)
            found.append(float(push[self._up].sum()))
        self._displacement = displacement
        return found

    def _balanced(self, start: FloatArray, radius: float, depth: float, stiffness: float) -> FloatArray | None:
        """Displacement in equilibrium [m] from a start, by Newton's method; None where it does not converge."""
        u, free = start.copy(), self._free
        for _ in range(ITERATIONS):
            matrix, force = self._solid(u)
            held, push = self._contact(u, radius, depth, stiffness)
            residual = (force + push)[free]
            size = float(np.abs(residual).sum())
            if not np.isfinite(size):
                return None
            if size <= TOLERANCE * float(np.abs(push).sum()) and size < 1e-3:
                return u
            change = splu(csc_array(matrix + held)[free][:, free].tocsc()).solve(-residual)
            share = 1.0
            for _ in range(HALVINGS):
                trial = u.copy()
                trial[free] += share * change
                if self._smallest_ratio(trial) > 0.0:
                    break
                share *= 0.5
            else:
                return None
            u = trial
        return None

    def _smallest_ratio(self, u: FloatArray) -> float:
        gradient, hoop = self._strained(self._basis.interpolate(u), self._basis.global_coordinates().value[0])
        return float(neo_hookean(gradient, hoop, *self._moduli)[2].min())

    @staticmethod
    def _strained(u: Any, r: NDArray) -> tuple[NDArray, NDArray]:
        """In-plane deformation gradient and hoop stretch of a displacement."""
        gradient = np.array(u.grad)
        gradient[0, 0] += 1.0
        gradient[1, 1] += 1.0
        return gradient, 1.0 + np.array(u)[0] / r

    def _solid(self, u: FloatArray) -> tuple[Any, FloatArray]:
        """Tangent stiffness [N/m] and forces of the solid and its membrane [N] at a displacement."""
        from skfem import BilinearForm, LinearForm

        before, r = self._basis.interpolate(u), self._basis.global_coordinates().value[0]
        shear, lame = self._moduli
        gradient, hoop = self._strained(before, r)
        stress, around, ratio = neo_hookean(gradient, hoop, shear, lame)
        flat = ratio / hoop
        inverse = np.array([[gradient[1, 1], -gradient[1, 0]], [-gradient[0, 1], gradient[0, 0]]]) / flat
        volume, slope = lame * (ratio - 1.0) * ratio - shear, lame * (2.0 * ratio - 1.0) * ratio
        weight = 2.0 * np.pi * r

        def force(v: Any, w: Any) -> Any:
            return weight * (np.einsum("ij...,ij...->...", stress, v.grad) + around * v[0] / r)

        def tangent(a: Any, b: Any, w: Any) -> Any:
            # dP = mu dF + slope (F^-T : dF) F^-T - volume F^-T dF^T F^-T, the hoop direction a third axis of its own.
            grown = np.einsum("ij...,ij...->...", inverse, a.grad) + a[0] / r / hoop
            grown_b = np.einsum("ij...,ij...->...", inverse, b.grad) + b[0] / r / hoop
            twisted = np.einsum("il...,kl...,kj...,ij...->...", inverse, a.grad, inverse, b.grad)
            twisted = twisted + (a[0] / r / hoop) * (b[0] / r / hoop)
            plain = np.einsum("ij...,ij...->...", a.grad, b.grad) + a[0] * b[0] / r**2
            return weight * (shear * plain + slope * grown * grown_b - volume * twisted)

        matrix, vector = BilinearForm(tangent).assemble(self._basis), LinearForm(force).assemble(self._basis)
        if self._membrane[0] > 0.0:
            more, pull = self._skin(u)
            matrix, vector = matrix + more, vector + pull
        return matrix, vector

    def _skin(self, u: FloatArray) -> tuple[Any, FloatArray]:
        """Tangent stiffness and forces of the membrane: (C / 2) (e_r^2 + e_h^2 + 2 nu e_r e_h) per area, Green strains.

        Plane stress, C = E h / (1 - nu^2).
        """
        from skfem import BilinearForm, LinearForm

        before, r = self._top.interpolate(u), self._top.global_coordinates().value[0]
        size, ratio = self._membrane
        along = np.array([1.0 + before.grad[0, 0], before.grad[1, 0]])
        hoop = 1.0 + np.array(before)[0] / r
        strain, round_strain = 0.5 * (along[0] ** 2 + along[1] ** 2 - 1.0), 0.5 * (hoop**2 - 1.0)
        pull, round_pull = size * (strain + ratio * round_strain), size * (round_strain + ratio * strain)
        weight = 2.0 * np.pi * r

        def force(v: Any, w: Any) -> Any:
            rate = along[0] * v.grad[0, 0] + along[1] * v.grad[1, 0]
            return weight * (pull * rate + round_pull * hoop * v[0] / r)

        def tangent(a: Any, b: Any, w: Any) -> Any:
            rate, rate_b = (along[0] * one.grad[0, 0] + along[1] * one.grad[1, 0] for one in (a, b))
            turn, turn_b = hoop * a[0] / r, hoop * b[0] / r
            stiff = size * (rate * rate_b + turn * turn_b + ratio * (rate * turn_b + turn * rate_b))
            across = a.grad[0, 0] * b.grad[0, 0] + a.grad[1, 0] * b.grad[1, 0]
            return weight * (stiff + pull * across + round_pull * a[0] * b[0] / r**2)

        return BilinearForm(tangent).assemble(self._top), LinearForm(force).assemble(self._top)

    def _contact(self, u: FloatArray, radius: float, depth: float, stiffness: float) -> tuple[Any, FloatArray]:
        """Tangent stiffness and forces [N] of a ball `depth` below the surface at rest, on the surface, outward."""
        from skfem import BilinearForm, LinearForm

        before, (r, _) = self._top.interpolate(u), self._top.global_coordinates().value
        x, z = r + np.array(before)[0], np.array(before)[1] - (radius - depth)
        distance = np.sqrt(x**2 + z**2)
        gap = np.maximum(radius - distance, 0.0)
        out = np.array([x, z]) / distance
        weight = 2.0 * np.pi * r * stiffness

        def force(v: Any, w: Any) -> Any:
            return -weight * gap * (out[0] * v[0] + out[1] * v[1])

        def tangent(a: Any, b: Any, w: Any) -> Any:
            along = (out[0] * a[0] + out[1] * a[1]) * (out[0] * b[0] + out[1] * b[1])
            plain = a[0] * b[0] + a[1] * b[1]
            return weight * ((gap > 0.0) * along - gap / distance * (plain - along))

        return BilinearForm(tangent).assemble(self._top), LinearForm(force).assemble(self._top)
