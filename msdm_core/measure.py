"""What an organ's state amounts to: energy, momentum, volume ratios, inverted tets, internal forces."""

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.contact_kernels import QUADRATURE_BARYCENTRIC, QUADRATURE_COUNT, QUADRATURE_WEIGHT
from msdm_core.element_kernels import SQUEEZED_RATIO
from msdm_core.kernels import (
    ContactLaw,
    ContactShapes,
    OrganModel,
    OrganState,
    evaluate_forces,
)
from msdm_core.mesh import FloatArray, IntArray, tet_volumes


def kinetic_energy(model: OrganModel, state: OrganState) -> float:
    """Energy of motion, T = sum_i m_i |v_i|^2 / 2 [J]."""
    return 0.5 * float(model.node_mass @ np.einsum("ij,ij->i", state.node_velocity, state.node_velocity))


def potential_energy(model: OrganModel, state: OrganState) -> float:
    """Energy of springs, volume term and gravity, zero at the undeformed position [J].

    U = sum_s k_s (l_s - l0_s)^2 / 2 + sum_t K_t V0_t (J_t - 1)^2 / 2 + sum_a K_a V0_a (J_a - 1)^2 / 2
        + sum_t K'_t V0_t (J_t - J')^2 / 2 - sum_i m_i g . (x_i - X_i)
    where a is a volume averaged at a node, K'_t the share averaged and the fourth sum over tets below
    J' = SQUEEZED_RATIO. A resting tool's contact energy (`contact_energy`) is not in it.
    """
    ends = state.node_position[model.spring_nodes]
    stretch = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) - model.spring_rest_length
    springs = 0.5 * float(model.spring_stiffness @ stretch**2)
    ratio = volume_ratios(model, state)
    volume = 0.5 * float((model.tet_bulk * model.tet_rest_volume) @ (ratio - 1.0) ** 2)
    squeezed = np.minimum(ratio - SQUEEZED_RATIO, 0.0)
    volume += 0.5 * float((model.tet_averaged_bulk * model.tet_rest_volume) @ squeezed**2)
    quarter = np.repeat(ratio * model.tet_rest_volume / 4.0, 4)
    averaged = np.bincount(model.tet_nodes.ravel(), quarter, len(model.node_mass)) / model.node_rest_volume
    volume += 0.5 * float((model.node_bulk * model.node_rest_volume) @ (averaged - 1.0) ** 2)
    lift = (state.node_position - model.node_rest_position) @ model.gravity
    return springs + volume - float(model.node_mass @ lift)


def contact_energy(model: OrganModel, state: OrganState, shapes: ContactShapes, contact: ContactLaw) -> float:
    """Energy stored between tissue and shapes where they stand now, without friction's [J].

    E = sum over shapes and quadrature points of (k_p / 2) A g^2, g = s (s + t) / r: with d from the shape's axis to the
    point and n the triangle's normal, t = d . n and s^2 = r^2 - (|d|^2 - t^2). Counted are points inside the shape that
    it meets from outside (t <= 0) or holds already (`state.contact_engaged`).
    """
    corners = state.node_position[model.surface_triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    points = np.einsum("qc,tcx->tqx", QUADRATURE_BARYCENTRIC, corners)
    energy = 0.0
    for shape, radius in enumerate(shapes.shape_radius):
        start, axis = shapes.shape_ends[shape, 0], np.diff(shapes.shape_ends[shape], axis=0)[0]
        squared = float(axis @ axis)
        along = np.clip((points - start) @ axis / squared, 0.0, 1.0) if squared > 0.0 else np.zeros(points.shape[:2])
        offset = points - start - along[:, :, None] * axis
        height = np.einsum("tqx,tx->tq", offset, normal)
        chord_squared = radius**2 - (np.einsum("tqx,tqx->tq", offset, offset) - height**2)
        chord = np.sqrt(np.maximum(chord_squared, 0.0))
        held = state.contact_engaged[shape].reshape(-1, QUADRATURE_COUNT) != 0
        inside = (chord_squared > 0.0) & (chord + height > 0.0) & (held | (height <= 0.0))
        depth = np.where(inside, chord * (chord + height) / radius, 0.0)
        area = model.surface_rest_area * QUADRATURE_WEIGHT
        energy += 0.5 * contact.stiffness * float(area @ (depth * depth).sum(axis=1))
    return energy


def momentum(model: OrganModel, state: OrganState) -> FloatArray:
    """Linear momentum, p = sum_i m_i v_i [kg m/s], shape (3,)."""
    return model.node_mass @ state.node_velocity


def angular_momentum(model: OrganModel, state: OrganState, point: ArrayLike) -> FloatArray:
    """Angular momentum about a point [m], L = sum_i m_i (x_i - point) x v_i [kg m^2/s], shape (3,)."""
    arm = state.node_position - np.asarray(point, dtype=np.float64)
    return model.node_mass @ np.cross(arm, state.node_velocity)


def volume_ratios(model: OrganModel, state: OrganState) -> FloatArray:
    """Volume of each tet over its volume at rest, J = V / V0, negative where it is inside out, shape (n_tet,)."""
    return tet_volumes(state.node_position, model.tet_nodes) / model.tet_rest_volume


def inverted_tets(model: OrganModel, state: OrganState) -> IntArray:
    """Indices of the tets that are inside out, flat or not finite (J > 0 does not hold), shape (n_inverted,)."""
    return np.flatnonzero(~(volume_ratios(model, state) > 0.0)).astype(np.int32)


def internal_forces(model: OrganModel, state: OrganState) -> FloatArray:
    """Forces of springs and volume term with their beta damping on each node [N], shape (n_node, 3).

    f = -dU/dx without gravity and contact (plus beta's share of the velocity); the state is left as it is.
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
        volume_ratio_tet=np.zeros(1, np.int32),
    )
    evaluate_forces(model._replace(gravity=no_gravity), scratch)
    return scratch.node_force
