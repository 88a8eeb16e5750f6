"""Continuum of stiffening springs at finite strain, in a bar and in simple shear.

Springs of all directions in affine deformation are the affine micro-sphere model (Miehe, Göktepe and Lulei 2004, doi
10.1016/j.jmps.2004.03.011): W = c <psi(l)>, the mean over directions N of the energy psi at the stretch l = |F N|.
Linear springs give Lame's lambda = mu = c / 15 at small strain. Here the mean stiffens, not each spring (`Stiffening`).
The springs of a BCC lattice have seven directions: the quadrature of degree 5 of the mean. Each node is a centre of
symmetry, so that a homogeneous deformation of the lattice is affine for any law.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from msdm_core.material import Stiffening
from msdm_core.mesh import FloatArray

# Lower bound of strain in quotients.
STRAIN_LEAST = 1e-12
# Directions of a quadrature over the sphere: exact to degree 2 DIRECTION_ORDER - 1.
DIRECTION_ORDER = 12


@lru_cache(maxsize=4)
def sphere_directions(order: int = DIRECTION_ORDER) -> tuple[FloatArray, FloatArray]:
    """Directions (n, 3) and weights (n,) of a mean over the sphere, one of each pair of opposite directions.

    The product of Gauss's rule along z and even steps around z: exact for polynomials up to degree 2 order - 1.
    """
    height, weight = np.polynomial.legendre.leggauss(order)
    half = height > 0.0
    height, weight = height[half], weight[half]
    turn = np.pi * (np.arange(2 * order) + 0.5) / order
    across = np.sqrt(1.0 - height**2)
    directions = np.stack(np.broadcast_arrays(
        across[:, None] * np.cos(turn), across[:, None] * np.sin(turn), height[:, None]), axis=-1)  # fmt: skip
    return directions.reshape(-1, 3), np.repeat(weight / (2 * order), 2 * order)


@lru_cache(maxsize=1)
def lattice_directions() -> tuple[FloatArray, FloatArray]:
    """Directions of the springs of a BCC lattice, and their shares of its stiffness by formula (6)."""
    diagonals = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, -1.0], [1.0, -1.0, 1.0], [-1.0, 1.0, 1.0]]) / np.sqrt(3.0)
    return np.vstack([np.eye(3), diagonals]), np.array([2.0 / 15.0] * 3 + [3.0 / 20.0] * 4)


def determinant_and_cofactor(gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
    """J = det F, shape (...), and dJ/dF = J F^-T, shape (..., 3, 3)."""
    a, b, c = gradient[..., 0, :], gradient[..., 1, :], gradient[..., 2, :]
    cofactor = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-2)
    return np.einsum("...j,...j->...", a, cofactor[..., 0, :]), cofactor


@dataclass(frozen=True, eq=False)
class SpringSolid:
    """Affine springs with a common stiffening, and a volume term: W = 3 mu w(s) + (K_t / 2) (J - 1)^2.

    s^2 = 5 <(|F N| - 1)^2> is the equivalent strain of `Stiffening`, and w' its tension; linear springs have
    3 mu s^2 / 2.

    Args:
        shear_modulus: mu at small strain [Pa].
        volume_modulus: K_t = lambda - mu [Pa].
        stiffening: of the springs; None: linear.
        directions: N, (n, 3), and their weights (n,); by default the whole sphere.
    """

    shear_modulus: float
    volume_modulus: float
    stiffening: Stiffening | None = None
    directions: tuple[FloatArray, FloatArray] = sphere_directions()

    def _springs(self, gradient: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """F N (..., n, 3), its length |F N|, (..., n), and the stress of linear springs [Pa], (..., 3, 3)."""
        directions, weights = self.directions
        spans = np.einsum("...ij,aj->...ai", gradient, directions)
        stretch = np.sqrt(np.einsum("...ai,...ai->...a", spans, spans))
        scale = 15.0 * self.shear_modulus * weights * (1.0 - 1.0 / stretch)
        return spans, stretch, np.einsum("...a,...ai,aj->...ij", scale, spans, directions, optimize=True)

    def _rise(self, stretch: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Equivalent strain s, and the relative rise of tension and of tangent over linear springs."""
        strain = np.sqrt(5.0 * np.einsum("a,...a->...", self.directions[1], (stretch - 1.0) ** 2))
        if self.stiffening is None:
            return strain, np.zeros_like(strain), np.zeros_like(strain)
        strain = np.maximum(strain, STRAIN_LEAST)
        return strain, self.stiffening.tension(strain) / strain - 1.0, self.stiffening.tangent(strain) - 1.0

    def first_piola(self, gradient: FloatArray) -> FloatArray:
        """P = 15 mu (w' / s) <(1 - 1 / l) (F N) N^T> + K_t (J - 1) dJ/dF [Pa], l = |F N|, (..., 3, 3)."""
        _, stretch, linear = self._springs(gradient)
        volume, cofactor = determinant_and_cofactor(gradient)
        rise = self._rise(stretch)[1]
        return (
            linear * (1.0 + rise)[..., None, None] + (self.volume_modulus * (volume - 1.0))[..., None, None] * cofactor
        )

    def tangent(self, gradient: FloatArray) -> FloatArray:
        """dP/dF [Pa], (..., 3, 3, 3, 3)."""
        directions, weights = self.directions
        spans, stretch, linear = self._springs(gradient)
        share = 15.0 * self.shear_modulus * weights
        dyads = np.einsum("...ai,aj->...aij", spans, directions).reshape(*stretch.shape, 9)
        tangent = np.einsum("...a,...ax,...ay->...xy", share / stretch**3, dyads, dyads, optimize=True)
        tangent = tangent.reshape(*gradient.shape[:-2], 3, 3, 3, 3)
        across = np.einsum("...a,aj,al->...jl", share * (1.0 - 1.0 / stretch), directions, directions, optimize=True)
        tangent += np.einsum("ik,...jl->...ijkl", np.eye(3), across)
        strain, rise, tangent_rise = self._rise(stretch)
        tangent *= (1.0 + rise)[..., None, None, None, None]
        # dw/dF is the stress of linear springs over 3 mu s.
        slope = (tangent_rise - rise) / (3.0 * self.shear_modulus * np.maximum(strain, STRAIN_LEAST) ** 2)
        tangent += slope[..., None, None, None, None] * np.einsum("...ij,...kl->...ijkl", linear, linear)
        return tangent + volume_tangent(gradient, self.volume_modulus)


def volume_tangent(gradient: FloatArray, modulus: float) -> FloatArray:
    """Second derivative of (K / 2) (J - 1)^2 [Pa], (..., 3, 3, 3, 3).

    K dJ dJ + K (J - 1) d2J, where d2J/dF_ij dF_kl = e_ikm e_jln F_mn, e being the permutation symbol.
    """
    volume, cofactor = determinant_and_cofactor(gradient)
    second = np.einsum("ikm,jln,...mn->...ijkl", _PERMUTATION, _PERMUTATION, gradient, optimize=True)
    both = np.einsum("...ij,...kl->...ijkl", cofactor, cofactor)
    return modulus * (both + (volume - 1.0)[..., None, None, None, None] * second)


_PERMUTATION = np.zeros((3, 3, 3))
_PERMUTATION[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0
_PERMUTATION[[0, 2, 1], [2, 1, 0], [1, 0, 2]] = -1.0


def uniaxial_stress(solid: SpringSolid, stretch: FloatArray) -> FloatArray:
    """Force over the area at rest [Pa] of a bar with free sides at stretches along it, both (n,).

    Raises:
        ValueError: as `stretch_across`.
    """
    stretch = np.asarray(stretch, dtype=np.float64)
    return solid.first_piola(bar_gradient(stretch, stretch_across(solid, stretch)))[..., 0, 0]


def stretch_across(solid: SpringSolid, stretch: FloatArray) -> FloatArray:
    """Stretch across a bar with free sides at stretches along it, both (n,), by Newton's method.

    Raises:
        ValueError: no convergence; names the stretch along the bar.
    """
    stretch = np.asarray(stretch, dtype=np.float64)
    across, change, step = stretch**-0.45, np.zeros_like(stretch), 1e-6
    for _ in range(60):
        stress = solid.first_piola(bar_gradient(stretch, across))[..., 1, 1]
        slope = (solid.first_piola(bar_gradient(stretch, across + step))[..., 1, 1] - stress) / step
        # At most halved, so that no bar turns inside out.
        change = np.clip(-stress / slope, -0.5 * across, 0.5 * across)
        across = across + change
        if np.abs(change).max(initial=0.0) < 1e-12:
            return across
    worst = stretch[int(np.argmax(np.abs(change)))]
    raise ValueError(f"no equilibrium of the bar at the stretch {worst:g}: use smaller strains, or other parameters")


def bar_gradient(along: FloatArray, across: FloatArray) -> FloatArray:
    """Deformation gradients of bars along x with stretches along and across, (n,) each, shape (n, 3, 3)."""
    gradient = np.zeros((*along.shape, 3, 3))
    gradient[..., 0, 0], gradient[..., 1, 1], gradient[..., 2, 2] = along, across, across
    return gradient


def simple_shear_stress(solid: SpringSolid, amount: FloatArray) -> FloatArray:
    """Shear stress P_12 [Pa] in simple shear x = X + g Y of amounts g, both (n,)."""
    amount = np.asarray(amount, dtype=np.float64)
    gradient = np.broadcast_to(np.eye(3), (*amount.shape, 3, 3)).copy()
    gradient[..., 0, 1] = amount
    return solid.first_piola(gradient)[..., 0, 1]
