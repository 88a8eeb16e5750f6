"""Quantities of an organ that tests alone compare: momentum, forces, energy and loss of Maxwell arms, work."""

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.kernels.structure_kernels import OrganModel, OrganState
from msdm_core.kernels.substep_kernels import evaluate_forces
from msdm_core.material.tissue_law import ARM_COUNT, Relaxation
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.measure import node_rises, node_strains, spring_energies
from msdm_core.organ.motion import RATE, SIGNAL, WORK


def momentum(model: OrganModel, state: OrganState) -> FloatArray:
    """Linear momentum, p = sum_i m_i v_i [kg m/s], shape (3,)."""
    return model.node_mass @ state.node_velocity


def angular_momentum(model: OrganModel, state: OrganState, point: ArrayLike) -> FloatArray:
    """Angular momentum about a point [m], L = sum_i m_i (x_i - point) x v_i [kg m^2/s], shape (3,)."""
    arm = state.node_position - np.asarray(point, dtype=np.float64)
    return model.node_mass @ np.cross(arm, state.node_velocity)


def ground_work(state: OrganState) -> FloatArray:
    """Work that each motion of the ground has done on the organ [J], shape (n_motion,)."""
    return state.motion[:, WORK].copy()


def internal_forces(model: OrganModel, state: OrganState) -> FloatArray:
    """Forces of springs and volume term with their beta damping on each node [N], shape (n_node, 3).

    f = -dU/dx without gravity and contact, plus the damping of beta; the state does not change.
    """
    no_gravity = np.zeros(3)
    no_gravity.setflags(write=False)
    scratch = state._replace(
        node_force=np.empty_like(state.node_force),
        node_tension=np.empty_like(state.node_tension),
        row_position=np.zeros_like(state.row_position),
        row_velocity=np.zeros_like(state.row_velocity),
        row_force=np.zeros_like(state.row_force),
        volume_ratio_smallest=np.ones(1),
    )
    evaluate_forces(model._replace(gravity=no_gravity), scratch)
    return scratch.node_force


def arm_energy(model: OrganModel, state: OrganState) -> float:
    """Energy that the Maxwell arms of all springs store [J].

    Arms of tension g (T - z), which have given way to the tensions z, store g (U(l) - U(l_z) - z . (l - l_z)) with the
    energy U and tensions T of the elastic springs and T(l_z) = z: what they return where the springs go back to l_z at
    once. While they give way at constant lengths, that energy only falls, because U is convex. Where g differs from
    spring to spring, each has its share.

    Raises:
        ValueError: lengths with the tensions z were not found.
    """
    if not model.relaxes:
        return 0.0
    ends = state.node_position[model.spring_nodes]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    energy, total = spring_energies(model, length), 0.0
    for modulus, given in zip(
        model.spring_arm_modulus.reshape(ARM_COUNT, -1),
        state.spring_arm_tension.reshape(ARM_COUNT, -1) * model.spring_rest_length,
        strict=True,
    ):
        reached = _lengths_of(model, given)
        total += float(modulus @ (energy - spring_energies(model, reached) - given * (length - reached)))
    return total


LENGTH_ROUNDS, LENGTH_TOLERANCE = 500, 1e-13


def _lengths_of(model: OrganModel, tension: FloatArray) -> FloatArray:
    """Lengths of the springs at some tensions [N] (n_spring,) [m], (n_spring,): the inverse of `spring_tensions`.

    l - l0 = T / (k (1 + mean of the rises of both ends)): a larger rise gives shorter springs and so a smaller rise.
    Each node goes the part of the way that one alone would need, tension over strain over tangent.
    """
    linear = tension / model.spring_stiffness
    if not model.stiffens:
        return model.spring_rest_length + linear
    rise = np.zeros(len(model.node_mass))
    for _ in range(LENGTH_ROUNDS):
        length = model.spring_rest_length + linear / (1.0 + rise[model.spring_nodes].mean(axis=1))
        strain = node_strains(model, length)
        wanted = node_rises(model, strain)
        if (np.abs(wanted - rise) <= LENGTH_TOLERANCE * (1.0 + rise)).all():
            return length
        ramp = np.clip((strain - model.node_onset) * model.node_growth, 0.0, 1.0)
        tangent = 1.0 + model.node_excess * model.node_growth * (ramp * ramp)
        rise = rise + (wanted - rise) * np.minimum((1.0 + wanted) / tangent, 1.0)
    raise ValueError(
        f"no lengths were found for the tensions that the arms have given way to, in {LENGTH_ROUNDS} rounds"
    )


def loss_tangent(arms: Relaxation, frequency: float) -> float:
    """Loss over storage modulus of the springs at a frequency [Hz].

    G* = 1 + sum g_i (i w tau_i) / (1 + i w tau_i), w = 2 pi f.
    """
    turn = 2.0j * np.pi * frequency * np.asarray(arms.times)
    modulus = 1.0 + np.sum(np.asarray(arms.relative_moduli) * turn / (1.0 + turn))
    return float(modulus.imag / modulus.real)


def steer(state: OrganState, signal: ArrayLike, duration: float) -> None:
    """Let each motion's signal change evenly to a value (n_motion,) over the next `duration` [s] of steps."""
    state.motion[:, RATE] = (np.asarray(signal, dtype=np.float64) - state.motion[:, SIGNAL]) / duration
