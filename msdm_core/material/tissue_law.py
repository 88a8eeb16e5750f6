"""Stiffening of soft tissue with strain and relaxation with time."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.arithmetic import exp
from msdm_core.errors import OrganError
from msdm_core.mesh.tet_mesh import FloatArray

# Validated up to here (`stability.HELD_TANGENT`).
TANGENT_CAP_LARGEST = 100.0
# Maxwell arms of a spring or a volume.
ARM_COUNT = 3


@dataclass(frozen=True)
class Stiffening:
    """Linear tissue up to an onset strain, then a rising tangent up to a cap.

    A node a has the equivalent strain s, s^2 = 2 U_a / (E_a V_a): that of a bar in tension or compression with the
    same linear energy U_a, half of its springs', a quarter of its tets' and that of the volume averaged at it, with
    E_a V_a = (E / (3 mu)) sum k l0^2 / 10 over its springs. The energy is the sum of E_a V_a w(s_a) in place of
    E_a V_a s_a^2 / 2: linear tensions are multiplied by w'(s) / s, that of a spring by the mean over its two ends, of a
    tet over its four corners, so that Poisson's ratio is the same at every strain. The tangent is
    w'' = 1 + (c - 1) v^2, v = (s - e0) / (e1 - e0) within 0 and 1: a short toe and a steep rise as in Fung's
    exponential law (1967), as a piecewise polynomial, which has the same bits on every machine. The strain of a node
    includes all directions, so stiffening tissue stays nearly isotropic; if each spring stiffened by its own strain,
    the seven directions of a lattice would make a cubic solid with buckling columns. The barrier of squeezed tets does
    not stiffen.

    Args:
        onset_strain: e0, the end of linear tissue, at least 0.
        cap_strain: e1, the beginning of the constant tangent, above e0.
        tangent_cap: c, the largest tangent over that at rest, from 1 to 100.
        strain_supported: largest s in the recorded presses that support the law, above 0; None: not known.

    Raises:
        OrganError: names the field, its value and its range.
    """

    onset_strain: float
    cap_strain: float
    tangent_cap: float
    strain_supported: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.onset_strain < 1.0:
            raise OrganError(f"stiffening: onset_strain is {self.onset_strain}; it must be at least 0 and below 1")
        if not self.onset_strain < self.cap_strain <= 10.0:
            raise OrganError(
                f"stiffening: cap_strain is {self.cap_strain}; it must be above onset_strain {self.onset_strain} and "
                "at most 10"
            )
        if self.width < 1e-3:
            raise OrganError(
                f"stiffening: cap_strain {self.cap_strain} is {self.width:.2g} above onset_strain; it must be at least "
                "0.001 above it"
            )
        if not 1.0 <= self.tangent_cap <= TANGENT_CAP_LARGEST:
            raise OrganError(
                f"stiffening: tangent_cap is {self.tangent_cap}; it must be from 1 to {TANGENT_CAP_LARGEST:g}"
            )
        if self.strain_supported is not None and not 0.0 < self.strain_supported <= 10.0:
            raise OrganError(
                f"stiffening: strain_supported is {self.strain_supported}; it must be above 0 and at most 10"
            )

    @property
    def width(self) -> float:
        """e1 - e0."""
        return self.cap_strain - self.onset_strain

    def tension(self, strain: ArrayLike) -> FloatArray:
        """w'(s) at strains s, s + (c - 1) (e1 - e0) (v^3 / 3 + (u - v)) with u = (s - e0) / (e1 - e0); odd in s."""
        strain = np.asarray(strain, dtype=np.float64)
        beyond = np.maximum((np.abs(strain) - self.onset_strain) / self.width, 0.0)
        ramp = np.minimum(beyond, 1.0)
        excess = (self.tangent_cap - 1.0) * self.width * ((ramp * ramp * ramp) / 3.0 + (beyond - ramp))
        return strain + np.sign(strain) * excess

    def tangent(self, strain: ArrayLike) -> FloatArray:
        """w''(s) at strains s, 1 + (c - 1) v^2."""
        ramp = np.clip((np.abs(np.asarray(strain, dtype=np.float64)) - self.onset_strain) / self.width, 0.0, 1.0)
        return 1.0 + (self.tangent_cap - 1.0) * (ramp * ramp)


@dataclass(frozen=True)
class Relaxation:
    """Up to three Maxwell arms beside each spring and volume term: Prony terms of a quasi-linear solid (Fung 1993).

    The tension at time t is T_e(t) + sum_i g_i int exp(-(t - s) / tau_i) dT_e/ds ds with the elastic tension T_e: after
    a step of strain it starts at (1 + sum g_i) T_e and ends at T_e, the static equilibrium. The tension of volumes
    relaxes likewise, so that Poisson's ratio is the same at all times.

    Args:
        relative_moduli: g_i, at least 0, up to three; relative to the tissue at equilibrium.
        times: tau_i [s], from 1 ms to 10^6 s, as many, increasing.

    Raises:
        OrganError: names the field, its value and its range.
    """

    relative_moduli: tuple[float, ...]
    times: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "relative_moduli", tuple(self.relative_moduli))
        object.__setattr__(self, "times", tuple(self.times))
        if not 1 <= len(self.times) <= ARM_COUNT or len(self.relative_moduli) != len(self.times):
            raise OrganError(
                f"relaxation: {len(self.relative_moduli)} relative_moduli and {len(self.times)} times; give as many of "
                f"both, 1 to {ARM_COUNT}"
            )
        for modulus in self.relative_moduli:
            if not 0.0 <= modulus <= 10.0:
                raise OrganError(f"relaxation: a relative modulus is {modulus}; it must be from 0 to 10")
        if not all(1e-3 <= time <= 1e6 for time in self.times) or list(self.times) != sorted(set(self.times)):
            raise OrganError(f"relaxation: times are {self.times} s; they must increase and lie between 0.001 and 1e6")

    @property
    def instantaneous(self) -> float:
        """Tension immediately after a step of strain, over that at equilibrium: 1 + sum g_i."""
        return 1.0 + math.fsum(self.relative_moduli)

    def remaining(self, time: ArrayLike) -> FloatArray:
        """Tension at times t [s] after a step of strain, over that at equilibrium: 1 + sum_i g_i exp(-t / tau_i)."""
        time = np.asarray(time, dtype=np.float64)
        return 1.0 + sum(
            (modulus * exp(-time / tau) for modulus, tau in zip(self.relative_moduli, self.times, strict=True)),
            start=np.zeros_like(time),
        )
