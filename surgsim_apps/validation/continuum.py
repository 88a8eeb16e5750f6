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
    """Affine springs and a volume term that stiffen together: W = E w(s).

    E s^2 / 2 = (15 mu / 2) <(|F N| - 1)^2> + (K_t / 2) (J - 1)^2, the energy of linear springs with their volume term:
    s, the strain of `Stiffening`, is that of a bar of Young's modulus E with the same linear energy. The stress is that
    of linear tissue times w'(s) / s, so that Poisson's ratio is the same at every strain.

    Args:
        shear_modulus: mu at small strain [Pa], one or (...).
        volume_modulus: K_t = lambda - mu [Pa], one or (...).
        stiffening: w; None: s^2 / 2.
        directions: N, (n, 3), and their weights (n,); by default the whole sphere.
    """

    shear_modulus: FloatArray | float
    volume_modulus: FloatArray | float
    stiffening: Stiffening | None = None
    directions: tuple[FloatArray, FloatArray] = sphere_directions()

    def first_piola(self, gradient: FloatArray) -> FloatArray:
        """P = (w' / s) (15 mu <(1 - 1 / l) (F N) N^T> + K_t (J - 1) dJ/dF) [Pa], l = |F N|, (..., 3, 3)."""
        strain, linear = self._linear(gradient)
        return linear * self._factors(strain)[0][..., None, None]

    def tangent(self, gradient: FloatArray) -> FloatArray:
        """dP/dF [Pa], (..., 3, 3, 3, 3)."""
        directions, weights = self.directions
        spans, stretch = self._springs(gradient)
        share = 15.0 * np.asarray(self.shear_modulus)[..., None] * weights
        dyads = np.einsum("...ai,aj->...aij", spans, directions).reshape(*stretch.shape, 9)
        tangent = np.swapaxes(dyads * (share / stretch**3)[..., None], -1, -2) @ dyads
        tangent = tangent.reshape(*gradient.shape[:-2], 3, 3, 3, 3)
        across = np.einsum("...a,aj,al->...jl", share * (1.0 - 1.0 / stretch), directions, directions, optimize=True)
        tangent += np.einsum("ik,...jl->...ijkl", np.eye(3), across)
        # K (dJ dJ + (J - 1) d2J), where d2J/dF_ij dF_kl = e_ikm e_jln F_mn, e being the permutation symbol.
        volume, cofactor = determinant_and_cofactor(gradient)
        second = np.einsum("ikm,jln,...mn->...ijkl", _PERMUTATION, _PERMUTATION, gradient, optimize=True)
        second = _outer(cofactor, cofactor) + (volume - 1.0)[..., None, None, None, None] * second
        tangent += np.asarray(self.volume_modulus)[..., None, None, None, None] * second
        # ds/dF is the stress of linear tissue over E s.
        strain, linear = self._linear(gradient)
        secant, slope = self._factors(strain)
        rise = (slope - secant) / (self._youngs_modulus * strain**2)
        return secant[..., None, None, None, None] * tangent + rise[..., None, None, None, None] * _outer(
            linear, linear
        )

    @property
    def _youngs_modulus(self) -> FloatArray | float:
        """E = mu (3 lambda + 2 mu) / (lambda + mu) with lambda = mu + K_t [Pa]."""
        shear, volume = self.shear_modulus, self.volume_modulus
        return shear * (5.0 * shear + 3.0 * volume) / (2.0 * shear + volume)

    def _springs(self, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
        """F N (..., n, 3) and its length |F N|, (..., n)."""
        spans = np.einsum("...ij,aj->...ai", gradient, self.directions[0], optimize=True)
        return spans, np.sqrt(np.einsum("...ai,...ai->...a", spans, spans))

    def _linear(self, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Strain s (...), at least STRAIN_LEAST, and the stress of linear tissue [Pa], (..., 3, 3)."""
        directions, weights = self.directions
        spans, stretch = self._springs(gradient)
        volume, cofactor = determinant_and_cofactor(gradient)
        pull = 15.0 * np.asarray(self.shear_modulus)
        pressure = self.volume_modulus * (volume - 1.0)
        energy = pull * ((stretch - 1.0) ** 2 @ weights) + pressure * (volume - 1.0)
        scale = pull[..., None] * weights * (1.0 - 1.0 / stretch)
        stress = np.einsum("...a,...ai,aj->...ij", scale, spans, directions, optimize=True)
        strain = np.maximum(np.sqrt(energy / self._youngs_modulus), STRAIN_LEAST)
        return strain, stress + pressure[..., None, None] * cofactor

    def _factors(self, strain: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Secant w' / s and slope w'' of the law."""
        if self.stiffening is None:
            return np.ones_like(strain), np.ones_like(strain)
        return self.stiffening.tension(strain) / strain, self.stiffening.tangent(strain)


def _outer(left: FloatArray, right: FloatArray) -> FloatArray:
    return np.einsum("...ij,...kl->...ijkl", left, right)


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
