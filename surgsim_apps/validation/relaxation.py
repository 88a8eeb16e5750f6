"""Relaxing springs: closed forms of step strain and creep, and exact steps of a quasi-linear viscoelastic body.

Fung's quasi-linear law with Maxwell arms, on the springs alone: T = T_e + sum g_i q_i, dq_i/dt = dT_e/dt - q_i / tau_i.
With r_i = T_e - q_i this is T = (1 + sum g_i) T_e - sum g_i r_i, dr_i/dt = (T_e - r_i) / tau_i. At small strain T_e is
K_s u and r_i = K_s u_i with displacements u_i of the arms, du_i/dt = (u - u_i) / tau_i; the volume terms K_v u stay
elastic.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import expm
from scipy.sparse import csc_array

from msdm_core.material import Relaxation
from msdm_core.mesh import FloatArray


def spring_creep(arms: Relaxation, time: FloatArray) -> FloatArray:
    """Strain of springs under a constant load over the final strain, at times [s], shape (n,).

    (1 + sum g) u - sum g_i u_i = 1, du_i/dt = (u - u_i) / tau_i, u_i = 0 at 0.
    """
    shares, times = np.asarray(arms.relative_moduli), np.asarray(arms.times)
    # u = first + weights (u_1, u_2, ...): a linear equation for the arms alone.
    first = 1.0 / (1.0 + shares.sum())
    weights, identity = first * shares, np.eye(len(times))
    rate, drive = (weights - identity) / times[:, None], first / times
    strains = [weights @ np.linalg.solve(rate, (expm(rate * moment) - identity) @ drive) for moment in time]
    return first + np.array(strains)


@dataclass(eq=False)
class ViscoelasticBody:
    """Body of relaxing springs at small strain, stepped exactly for displacements linear within a step.

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
        """Stiffness K and load f [N] at the end of a step: the body's forces are K u - f."""
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
