"""Ball pressed into a bonded layer or dome at finite strains: axisymmetric finite elements of scikit-fem.

The ball is rigid and frictionless; it presses on the undeformed area with k_p times the penetration, as in the contact
law of this package. A large k_p leaves next to no penetration.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from msdm_core.material import Stiffening
from msdm_core.mesh import FloatArray
from surgsim_apps.validation.continuum import SpringSolid, sphere_directions

# Pressure per penetration of a rigid ball [N/m^3]: 5 kPa make 5 um.
RIGID = 1e9
# Poisson's ratio of a membrane on the top.
MEMBRANE_RATIO = 0.5
# Largest step of the depth [m], Newton's tolerance on the residual over the ball's force, numbers of its iterations, of
# halvings of its step, and of first iterations that may raise the residual.
DEPTH_STEP = 2.5e-4
TOLERANCE = 1e-6
ITERATIONS = 60
HALVINGS = 6
WILD = 6

# Directions of springs are exact to degree 11: an error of 5e-4 of the stress at 20 % strain.
SPRING_ORDER = 6
# Places of F_rr, F_rz, F_zr, F_zz and the stretch around the axis in a gradient along r, z and around.
ROWS, COLUMNS = np.array([0, 0, 1, 1, 2]), np.array([0, 1, 0, 1, 2])

Modulus = Callable[[FloatArray, FloatArray], FloatArray]
# First Piola stress (5, ...) and its slope (5, 5, ...) [Pa] at gradients F_rr, F_rz, F_zr, F_zz and the stretch around
# the axis (5, ...), for Lame's mu and lambda [Pa] (...).
Law = Callable[[NDArray, NDArray, NDArray], tuple[NDArray, NDArray]]


def neo_hookean(gradient: NDArray, shear: NDArray, lame: NDArray) -> tuple[NDArray, NDArray]:
    """`Law` of W = mu (J^(-2/3) I1 - 3) / 2 + K (J - 1)^2 / 2, K = lambda + 2 mu / 3.

    Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis (2008), 6.5.2: the compressible
    neo-Hookean solid with a volume term apart, of the organ's form. With G = J F^-T:
    P = mu J^(-2/3) (F - I1 G / (3 J)) + K (J - 1) G.
    """
    rr, rz, zr, zz, hoop = gradient
    ratio = _volume_ratio(gradient)
    cofactor = np.array([zz * hoop, -zr * hoop, -rz * hoop, rr * hoop, rr * zz - rz * zr])
    bulk, scaled = lame + 2.0 / 3.0 * shear, shear * ratio ** (-2.0 / 3.0)
    squared = (gradient**2).sum(axis=0)
    volume = bulk * (ratio - 1.0) - scaled * squared / (3.0 * ratio)
    stress = scaled * gradient + volume * cofactor
    mixed = _outer(gradient, cofactor)
    tangent = (bulk + 5.0 / 9.0 * scaled * squared / ratio**2) * _outer(cofactor, cofactor)
    tangent -= 2.0 / 3.0 * scaled / ratio * (mixed + np.swapaxes(mixed, 0, 1))
    for part in range(5):
        tangent[part, part] += scaled
    # dG / dF: the second derivatives of J.
    for row, column, slope in ((0, 3, hoop), (1, 2, -hoop), (0, 4, zz), (1, 4, -zr), (2, 4, -rz), (3, 4, rr)):
        tangent[row, column] += volume * slope
        tangent[column, row] += volume * slope
    return stress, tangent


def spring_law(stiffening: Stiffening | None = None) -> Law:
    """`Law` of springs in all directions with a volume term, `SpringSolid`."""
    normals, weights = sphere_directions(SPRING_ORDER)
    # Directions mirrored in the plane of r and z, or opposite, have the same springs: half of them do.
    half = normals[:, 1] > 0.0
    directions = normals[half], 2.0 * weights[half]

    def law(gradient: NDArray, shear: NDArray, lame: NDArray) -> tuple[NDArray, NDArray]:
        full = np.zeros((*gradient.shape[1:], 3, 3))
        full[..., ROWS, COLUMNS] = np.moveaxis(gradient, 0, -1)
        solid = SpringSolid(shear, lame - shear, stiffening, directions)
        stress = solid.first_piola(full)[..., ROWS, COLUMNS]
        tangent = solid.tangent(full)[..., ROWS[:, None], COLUMNS[:, None], ROWS, COLUMNS]
        return np.moveaxis(stress, -1, 0), np.moveaxis(tangent, (-2, -1), (0, 1))

    return law


def layer_mesh(
    radius: float, depth: float, fine: float, reach: tuple[float, float], *, curvature: float = math.inf
) -> Any:
    """Quadrilaterals of a disc r = 0 to radius, z = -depth to 0 [m], `fine` large within a reach (r, z), then wider.

    Its top is a spherical cap with a radius of curvature [m], highest on the axis.
    """
    from skfem import MeshQuad

    def line(length: float, near: float) -> FloatArray:
        inner = np.linspace(0.0, near, round(near / fine) + 1)
        widths = [fine]
        while inner[-1] + sum(widths[1:]) < length:
            widths.append(1.3 * widths[-1])
        outer = inner[-1] + np.cumsum(widths[1:]) * (length - inner[-1]) / sum(widths[1:])
        return np.concatenate([inner, outer])

    flat = MeshQuad.init_tensor(line(radius, reach[0]), -line(depth, reach[1])[::-1])
    flat = flat.with_boundaries({"top": lambda x: np.abs(x[1]) < 1e-12})
    r, z = flat.p
    return dataclasses.replace(
        flat, doflocs=np.array([r, z - (1.0 + z / depth) * r**2 / (curvature + np.sqrt(curvature**2 - r**2))])
    )


@dataclass(frozen=True)
class Press:
    """Equilibrium of a press.

    Attributes:
        force: of the ball [N].
        pressure: largest of the contact per undeformed area [Pa].
        strain: largest |lambda - 1| of the principal stretches.
        volume_ratio: smallest J.
        volume_lost: integral of 1 - J over the body at rest [m^3].
    """

    force: float
    pressure: float
    strain: float
    volume_ratio: float
    volume_lost: float


class PressedLayer:
    """Bonded layer of modulus E(r, z) [Pa] under a ball, quadratic elements at finite strain."""

    def __init__(
        self, mesh: Any, modulus: Modulus, poisson_ratio: float, *, law: Law = neo_hookean, membrane: float = 0.0
    ) -> None:
        """Make the layer at rest.

        Args:
            mesh: of `layer_mesh`.
            modulus: Young's modulus at places (r, z) [Pa].
            poisson_ratio: of the layer.
            law: of the layer.
            membrane: modulus times thickness of a membrane on its top [N/m].
        """
        from skfem import Basis, ElementQuad2, ElementVector, FacetBasis

        self._basis = Basis(mesh, ElementVector(ElementQuad2()), intorder=4)
        self._top = FacetBasis(mesh, self._basis.elem, facets="top", intorder=5)
        place, axis = self._basis.doflocs, np.zeros(self._basis.N, dtype=np.int64)
        for dofs in (self._basis.nodal_dofs, self._basis.facet_dofs, self._basis.interior_dofs):
            axis[np.asarray(dofs)[1::2]] = 1
        self._up = axis == 1
        held = ((place[0] < 1e-12) & ~self._up) | (place[1] <= place[1].min() + 1e-12)
        self._free = np.flatnonzero(~held)
        r, z = self._basis.global_coordinates()
        self._law = law
        shear = modulus(r, z) / (2.0 * (1.0 + poisson_ratio))
        self._moduli = shear, 2.0 * shear * poisson_ratio / (1.0 - 2.0 * poisson_ratio)
        self._weight = 2.0 * np.pi * r * self._basis.dx
        self._rates = _rates(self._basis, r)
        self._top_rates = _rates(self._top, self._top.global_coordinates()[0])
        self._membrane = membrane / (1.0 - MEMBRANE_RATIO**2)

    def forces(self, radius: float, depths: Sequence[float], contact_stiffness: float = RIGID) -> list[float]:
        """Forces of the ball at rising depths of its lowest point below the surface at rest [N].

        Raises:
            ValueError: Newton's method does not converge.
        """
        return [press.force for press in self.presses(radius, depths, contact_stiffness)]

    def presses(self, radius: float, depths: Sequence[float], contact_stiffness: float = RIGID) -> Iterator[Press]:
        """Presses at rising depths of the ball's lowest point below the surface at rest.

        Raises:
            ValueError: Newton's method does not converge.
        """
        for depth, u in self._pressed(radius, depths, contact_stiffness):
            gradient = self._strained(u)
            rr, rz, zr, zz, hoop = gradient
            across = np.linalg.svd(np.moveaxis(np.array([[rr, rz], [zr, zz]]), (0, 1), (-2, -1)), compute_uv=False)
            stretches = np.concatenate([across.ravel(), hoop.ravel()])
            ratio = _volume_ratio(gradient)
            yield Press(
                force=float(self._contact(u, radius, depth, contact_stiffness)[1][self._up].sum()),
                pressure=float(contact_stiffness * self._gaps(u, radius, depth)[1].max()),
                strain=float(np.abs(stretches - 1.0).max()),
                volume_ratio=float(ratio.min()),
                volume_lost=float((self._weight * (1.0 - ratio)).sum()),
            )

    def _pressed(
        self, radius: float, depths: Sequence[float], contact_stiffness: float
    ) -> Iterator[tuple[float, FloatArray]]:
        """Depths [m] with their displacements in equilibrium [m]."""
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
            yield depth, displacement

    def _balanced(self, start: FloatArray, radius: float, depth: float, stiffness: float) -> FloatArray | None:
        """Displacement in equilibrium [m] from a start, by Newton's method; None without convergence."""
        u, free = start.copy(), self._free
        matrix, force, push = self._forces(u, radius, depth, stiffness)
        for iteration in range(ITERATIONS):
            residual = (force + push)[free]
            size = float(np.abs(residual).sum())
            if size <= TOLERANCE * float(np.abs(push).sum()):
                return u
            # An ordering for nearly symmetric matrices takes a third of the time.
            factors = splu(matrix[free][:, free].tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
            change = factors.solve(-residual)
            # A long step may end in another equilibrium, with a crease in the surface.
            share = min(1.0, DEPTH_STEP / float(np.abs(change).max()))
            for _ in range(HALVINGS):
                trial = u.copy()
                trial[free] += share * change
                if _volume_ratio(self._strained(trial)).min() > 0.0:
                    matrix, force, push = self._forces(trial, radius, depth, stiffness)
                    # Later steps uphill would move points in and out of contact for ever.
                    if iteration < WILD or float(np.abs((force + push)[free]).sum()) < size:
                        break
                share *= 0.5
            else:
                return None
            u = trial
        return None

    def _forces(
        self, u: FloatArray, radius: float, depth: float, stiffness: float
    ) -> tuple[Any, FloatArray, FloatArray]:
        """Tangent stiffness of solid and contact [N/m], and the forces of each [N], at a displacement."""
        matrix, force = self._solid(u)
        held, push = self._contact(u, radius, depth, stiffness)
        return csc_array(matrix + held), force, push

    def _strained(self, u: FloatArray) -> NDArray:
        """Deformation gradient of a displacement: F_rr, F_rz, F_zr, F_zz and the stretch around the axis (5, n, m)."""
        return np.array([1.0, 0.0, 0.0, 1.0, 1.0])[:, None, None] + np.einsum(
            "inea,ie->nea", self._rates[:, :5], u[self._basis.element_dofs], optimize=True
        )

    def _solid(self, u: FloatArray) -> tuple[Any, FloatArray]:
        """Tangent stiffness [N/m] and forces of the solid and its membrane [N] at a displacement."""
        stress, tangent = self._law(self._strained(u), *self._moduli)
        matrix, vector = _assembled(self._basis, self._rates[:, :5], self._weight, stress, tangent)
        if self._membrane > 0.0:
            skin_matrix, pull = self._skin(u)
            matrix, vector = matrix + skin_matrix, vector + pull
        return matrix, vector

    def _skin(self, u: FloatArray) -> tuple[Any, FloatArray]:
        """Tangent stiffness and forces of the membrane: (C / 2) (e_s^2 + e_h^2 + 2 nu e_s e_h) per area, Green strains.

        Plane stress, C = E h / (1 - nu^2).
        """
        size, ratio = self._membrane, MEMBRANE_RATIO
        r, (across, up) = self._top.global_coordinates()[0], self._top.normals
        # Rates along the outline, whose tangent is (up, -across), and around the axis.
        functions = np.stack(
            [up * self._top_rates[:, part] - across * self._top_rates[:, part + 1] for part in (0, 2)], 1
        )
        functions = np.concatenate([functions, self._top_rates[:, 4:5]], axis=1)
        along, slope, hoop = np.einsum("inea,ie->nea", functions, u[self._top.element_dofs], optimize=True)
        along, slope, hoop = along + up, slope - across, hoop + 1.0
        strain, round_strain = 0.5 * (along**2 + slope**2 - 1.0), 0.5 * (hoop**2 - 1.0)
        pull, round_pull = size * (strain + ratio * round_strain), size * (round_strain + ratio * strain)
        first, second = np.array([along, slope, np.zeros_like(hoop)]), np.array([0.0 * hoop, 0.0 * hoop, hoop])
        stress = pull * first + round_pull * second
        tangent = size * (_outer(first, first) + _outer(second, second))
        tangent += size * ratio * (_outer(first, second) + _outer(second, first))
        for part, tension in enumerate((pull, pull, round_pull)):
            tangent[part, part] += tension
        weight = 2.0 * np.pi * r * self._top.dx
        return _assembled(self._top, functions, weight, stress, tangent)

    def _contact(self, u: FloatArray, radius: float, depth: float, stiffness: float) -> tuple[Any, FloatArray]:
        """Tangent stiffness and forces [N] of a ball `depth` below the surface at rest, on the surface, outward."""
        out, gap, distance = self._gaps(u, radius, depth)
        across = np.eye(2)[:, :, None, None] - _outer(out, out)
        tangent = stiffness * ((gap > 0.0) * _outer(out, out) - gap / distance * across)
        weight = 2.0 * np.pi * self._top.global_coordinates()[0] * self._top.dx
        return _assembled(self._top, self._top_rates[:, 5:], weight, -stiffness * gap * out, tangent)

    def _gaps(self, u: FloatArray, radius: float, depth: float) -> tuple[NDArray, NDArray, NDArray]:
        """Direction from the ball's centre, penetration and distance [m] of points of the top."""
        moved = np.einsum("inea,ie->nea", self._top_rates[:, 5:], u[self._top.element_dofs], optimize=True)
        place = self._top.global_coordinates() + moved - np.array([0.0, radius - depth])[:, None, None]
        distance = np.sqrt((place**2).sum(axis=0))
        return place / distance, np.maximum(radius - distance, 0.0), distance


def _volume_ratio(gradient: NDArray) -> NDArray:
    """J of gradients (5, ...)."""
    rr, rz, zr, zz, hoop = gradient
    return (rr * zz - rz * zr) * hoop


def _outer(left: NDArray, right: NDArray) -> NDArray:
    return left[:, None] * right[None]


def _rates(basis: Any, r: NDArray) -> NDArray:
    """Rates of an element's functions v: v_r,r, v_r,z, v_z,r, v_z,z, v_r / r, v_r, v_z (n_function, 7, n, m)."""
    rates = []
    for (shape,) in basis.basis:
        value, gradient = np.broadcast_to(np.array(shape), (2, *r.shape)), np.broadcast_to(shape.grad, (2, 2, *r.shape))
        rates.append([*gradient.reshape(4, *r.shape), value[0] / r, *value])
    return np.array(rates)


def _assembled(basis: Any, rates: NDArray, weight: NDArray, stress: NDArray, tangent: NDArray) -> tuple[Any, NDArray]:
    """Matrix and vector of the sum over places of stress and tangent on the functions' rates (n_function, k, n, m)."""
    vector = np.zeros(basis.N)
    loaded = np.einsum("inea,nea,ea->ie", rates, stress, weight, optimize=True)
    np.add.at(vector, basis.element_dofs, loaded)
    stiff = np.einsum("nkea,jkea->jnea", tangent * weight, rates, optimize=True)
    matrix = np.einsum("inea,jnea->ije", rates, stiff, optimize=True)
    count = len(rates)
    rows = np.repeat(basis.element_dofs[:, None], count, axis=1)
    columns = np.repeat(basis.element_dofs[None], count, axis=0)
    return csc_array((matrix.ravel(), (rows.ravel(), columns.ravel())), shape=(basis.N, basis.N)), vector
