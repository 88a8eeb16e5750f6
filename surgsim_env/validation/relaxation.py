"""Springs that relax: closed forms of step strain and creep, and exact steps of a quasi-linear viscoelastic body.

Fung's quasi-linear law with Maxwell arms, on the springs alone: T = T_e + sum g_i q_i, dq_i/dt = dT_e/dt - q_i / tau_i.
With r_i = T_e - q_i this is T = (1 + sum g_i) T_e - sum g_i r_i, dr_i/dt = (T_e - r_i) / tau_i. At small strain T_e is
K_s u and r_i = K_s u_i with displacements u_i of the arms, du_i/dt = (u - u_i) / tau_i; the volume terms K_v u stay
elastic.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import expm
from scipy.sparse import csc_array

from msdm_core.material.tissue_law import Relaxation
from msdm_core.mesh.tet_mesh import FloatArray


def loss_tangent(arms: Relaxation, frequency: float) -> float:
    """Loss over storage modulus of the springs at a frequency [Hz].

    G* = 1 + sum g_i (i w tau_i) / (1 + i w tau_i), w = 2 pi f.
    """
    turn = 2.0j * np.pi * frequency * np.asarray(arms.times)
    modulus = 1.0 + np.sum(np.asarray(arms.relative_moduli) * turn / (1.0 + turn))
    return float(modulus.imag / modulus.real)


def spring_creep(arms: Relaxation, time: FloatArray) -> FloatArray:
    """Strain of springs under a constant load over the final one, of times [s], shape (n,)."""
    return _crept(np.ones((1, 1)), np.zeros((1, 1)), np.ones(1), arms, time)[:, 0]


def bar_creep(poisson_ratio: float, arms: Relaxation, time: FloatArray) -> FloatArray:
    """Strain of a bar with free sides under a constant load over the final one, of times [s], shape (n,).

    Springs have lambda = mu, their volume term adds K_t = mu (4 nu - 1) / (1 - 2 nu) and stays elastic. In strains
    (along, across) the stresses are mu [[3, 2], [1, 4]] and K_t [[1, 2], [1, 2]].
    """
    added = (4.0 * poisson_ratio - 1.0) / (1.0 - 2.0 * poisson_ratio)
    springs, volume = np.array([[3.0, 2.0], [1.0, 4.0]]), added * np.array([[1.0, 2.0], [1.0, 2.0]])
    strain = _crept(springs, volume, np.array([1.0, 0.0]), arms, time)[:, 0]
    return strain / np.linalg.solve(springs + volume, [1.0, 0.0])[0]


def _crept(springs: FloatArray, volume: FloatArray, load: FloatArray, arms: Relaxation, time: FloatArray) -> FloatArray:
    """The u(t) with ((1 + sum g) S + V) u - sum g_i S u_i = f, du_i/dt = (u - u_i) / tau_i, u_i = 0 at 0, (n, m)."""
    shares, times = np.asarray(arms.relative_moduli), np.asarray(arms.times)
    width = len(load)
    inverse = np.linalg.inv((1.0 + shares.sum()) * springs + volume)
    # u = inverse f + taken (u_1, u_2, ...): a linear equation for the arms alone.
    taken = np.hstack([share * inverse @ springs for share in shares])
    rate = np.vstack([(taken - np.eye(width, width * len(times), width * arm)) / tau for arm, tau in enumerate(times)])
    drive = np.concatenate([inverse @ load / tau for tau in times])
    found = []
    for moment in np.asarray(time, dtype=np.float64):
        arm = np.linalg.solve(rate, (expm(rate * moment) - np.eye(len(rate))) @ drive)
        found.append(inverse @ load + taken @ arm)
    return np.array(found)


@dataclass(eq=False)
class ViscoelasticBody:
    """A body at small strain whose springs relax, stepped exactly for displacements that are linear within a step.

    Over a step h: u_i <- a u_i + (1 - b) u_new + (b - a) u_old, a = exp(-h / tau), b = (1 - a) tau / h.

    Args:
        springs: K_s [N/m], elastic.
        volume: K_v [N/m].
        arms: of the springs.
    """

    springs: csc_array
    volume: csc_array
    arms: Relaxation
    displacement: FloatArray = field(init=False)
    arm_displacement: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        count = len(self.springs.indptr) - 1
        self.displacement = np.zeros(count)
        self.arm_displacement = np.zeros((len(self.arms.times), count))

    def step(self, duration: float) -> tuple[csc_array, FloatArray]:
        """Stiffness K and load f [N] of the step's end: the body's forces there are K u - f."""
        decay, rise = self._factors(duration)
        shares = np.asarray(self.arms.relative_moduli)
        stiffness = csc_array((1.0 + shares @ rise) * self.springs + self.volume)
        kept = decay[:, None] * self.arm_displacement + (rise - decay)[:, None] * self.displacement
        # K_s ((1 + sum g) u - sum g_i u_i) with u_i = kept_i + (1 - b_i) u.
        return stiffness, self.springs @ (shares @ kept)

    def accept(self, displacement: FloatArray, duration: float) -> None:
        """End a step at a displacement [m]."""
        decay, rise = self._factors(duration)
        self.arm_displacement = (
            decay[:, None] * self.arm_displacement
            + (1.0 - rise)[:, None] * displacement
            + (rise - decay)[:, None] * self.displacement
        )
        self.displacement = displacement.copy()

    def _factors(self, duration: float) -> tuple[FloatArray, FloatArray]:
        times = np.asarray(self.arms.times)
        decay = np.exp(-duration / times)
        return decay, (1.0 - decay) * times / duration
