"""Quantities of an organ that tests alone compare: momentum, forces, energy and loss of Maxwell arms, work."""

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.kernels.structure_kernels import OrganModel, OrganState
from msdm_core.kernels.substep_kernels import evaluate_forces
from msdm_core.material.tissue_law import ARM_COUNT, Relaxation
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.measure import (
    element_energies,
    element_means,
    element_size,
    element_stiffness,
    element_strains,
    node_rises,
    node_strains,
)
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
    """Energy that all Maxwell arms store [J].

    Arms of tension g (T - z), which have given way to the tensions z, store g (U(e) - U(e_z) - z . (e - e_z)) with the
    energy U and tensions T of the elastic elements and T(e_z) = z: what they return where the elements go back to e_z
    at once. While they give way at constant strains, that energy only falls, because U is convex. Where g differs from
    element to element, each has its share.

    Raises:
        ValueError: strains with the tensions z were not found.
    """
    if not model.relaxes:
        return 0.0
    strain, size = element_strains(model, state.node_position), element_size(model)
    energy, total = element_energies(model, strain, node_strains(model, strain)), 0.0
    for modulus, given in zip(
        model.element_arm_modulus.reshape(ARM_COUNT, -1), state.element_arm_tension.reshape(ARM_COUNT, -1), strict=True
    ):
        reached = _strains_of(model, given)
        kept = element_energies(model, reached, node_strains(model, reached))
        total += float(modulus @ (energy - kept - size * given * (strain - reached)))
    return total


STRAIN_ROUNDS, STRAIN_TOLERANCE = 500, 1e-13


def _strains_of(model: OrganModel, tension: FloatArray) -> FloatArray:
    """Strains of the elements at some tensions, both (n_element,): the inverse of `element_tensions`.

    e = T / (K (1 + mean of the rises of its nodes)): a larger rise gives smaller strains and so a smaller rise. Each
    node goes the part of the way that one alone would need, tension over strain over tangent.
    """
    stiffness = element_stiffness(model)
    linear = np.divide(tension, stiffness, out=np.zeros_like(tension), where=stiffness > 0.0)
    if not model.stiffens:
        return linear
    rise = np.zeros(len(model.node_mass))
    for _ in range(STRAIN_ROUNDS):
        strain = linear / (1.0 + element_means(model, rise))
        equivalent = node_strains(model, strain)
        wanted = node_rises(model, equivalent)
        if (np.abs(wanted - rise) <= STRAIN_TOLERANCE * (1.0 + rise)).all():
            return strain
        ramp = np.clip((equivalent - model.node_onset) * model.node_growth, 0.0, 1.0)
        tangent = 1.0 + model.node_excess * model.node_growth * (ramp * ramp)
        rise = rise + (wanted - rise) * np.minimum((1.0 + wanted) / tangent, 1.0)
    raise ValueError(
        f"no strains were found for the tensions that the arms have given way to, in {STRAIN_ROUNDS} rounds"
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
