"""Measured quantities of an organ's state: energy, tissue load, volume ratios, inverted tets, forces of supports."""

from typing import NamedTuple

import numpy as np

from msdm_core.arithmetic import dot, eigh, log, matmul, norm
from msdm_core.kernels.contact_kernels import (
    QUADRATURE_BARYCENTRIC,
    QUADRATURE_COUNT,
    QUADRATURE_WEIGHT,
)
from msdm_core.kernels.element_kernels import SQUEEZED_RATIO, STRAIN_LEAST
from msdm_core.kernels.load_kernels import add_gradients, add_pressures, fill_volume_ratios
from msdm_core.kernels.structure_kernels import ContactLaw, ContactShapes, OrganModel, OrganState
from msdm_core.kernels.support_kernels import add_support_forces, place_ground
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, area_vectors
from msdm_core.organ.motion import SIGNAL

ROUNDING = 1e-12  # margin of strains


def kinetic_energy(model: OrganModel, state: OrganState) -> float:
    """Energy of motion, T = sum_i m_i |v_i|^2 / 2 [J]."""
    return 0.5 * float(matmul(model.node_mass, dot(state.node_velocity, state.node_velocity)))


def potential_energy(model: OrganModel, state: OrganState) -> float:
    """Energy of springs, volume term, foundations and gravity, zero at the undeformed position [J].

    U = sum_s U_s(l_s) + sum_t K_t V0_t (J_t - 1)^2 / 2 + sum_a K_a V0_a (J_a - 1)^2 / 2
        + sum_t K'_t s V0_t ((J_t - s) - s ln(J_t / s)) + sum_h u_h . K_h u_h / 2 - sum_i m_i g . (x_i - X_i)
    with U_s the energy of a spring, k (l - l0)^2 / 2 if linear, without Maxwell arms; a the volumes averaged at nodes;
    K'_t the averaged share of the modulus, its sum over tets below s = SQUEEZED_RATIO (infinite for a tet inside out);
    u_h the displacement of a node on an elastic foundation. Contact with tools (`contact_energy`) and supports is not
    included.
    """
    ends = state.node_position[model.spring_nodes]
    length = norm(ends[:, 1] - ends[:, 0], axis=1)
    springs = float(spring_energies(model, length).sum())
    ratio = volume_ratios(model, state)
    volume = 0.5 * float(matmul(model.tet_bulk * model.tet_rest_volume, np.square(ratio - 1.0)))
    squeezed = np.flatnonzero(~(ratio >= SQUEEZED_RATIO) & (model.tet_averaged_bulk > 0.0))
    share = np.maximum(ratio[squeezed], 0.0) / SQUEEZED_RATIO
    with np.errstate(divide="ignore"):
        barrier = SQUEEZED_RATIO * SQUEEZED_RATIO * ((share - 1.0) - log(share))
    volume += float(matmul((model.tet_averaged_bulk * model.tet_rest_volume)[squeezed], barrier))
    quarter = np.repeat(ratio * model.tet_rest_volume / 4.0, 4)
    averaged = np.bincount(model.tet_nodes.ravel(), quarter, len(model.node_mass)) / model.node_rest_volume
    volume += 0.5 * float(matmul(model.node_bulk * model.node_rest_volume, np.square(averaged - 1.0)))
    lift = matmul(state.node_position - model.node_rest_position, model.gravity)
    ground = (state.motion[:, SIGNAL, None, None] * model.motion_foundation_shift).sum(axis=0)
    moved = state.node_position[model.foundation_nodes] - (model.foundation_position + ground)
    held = 0.5 * float((dot(model.foundation_stiffness, moved[:, None]) * moved).sum())
    return springs + volume + held - float(matmul(model.node_mass, lift))


def spring_tensions(model: OrganModel, length: FloatArray) -> FloatArray:
    """Tension of each spring at lengths [m] (n_spring,), without Maxwell arms [N], (n_spring,)."""
    tension = model.spring_stiffness * (length - model.spring_rest_length)
    if not model.stiffens:
        return tension
    rise = node_rises(model, node_strains(model, length))
    return tension * (1.0 + rise[model.spring_nodes].mean(axis=1))


def node_strains(model: OrganModel, length: FloatArray) -> FloatArray:
    """Equivalent strain of each node, s^2 = 5 sum k (l - l0)^2 / sum k l0^2 over its springs of lengths l [m]."""
    twice = model.spring_stiffness * np.square(length - model.spring_rest_length)
    return np.sqrt(model.node_softness * np.bincount(model.spring_nodes.ravel(), np.repeat(twice, 2)))


def node_rises(model: OrganModel, strain: FloatArray) -> FloatArray:
    """Relative rise of tension over linear springs at each node (`element_kernels.node_law`), (n_node,)."""
    beyond, ramp = _ramps(model, strain)
    return model.node_excess * ((ramp * ramp * ramp) / 3.0 + (beyond - ramp)) / np.maximum(strain, STRAIN_LEAST)


def _ramps(model: OrganModel, strain: FloatArray) -> tuple[FloatArray, FloatArray]:
    """U = (s - e0) / (e1 - e0) from 0 on and v = min(u, 1) of each node (`Stiffening`), (n_node,) each."""
    beyond = np.maximum((strain - model.node_onset) * model.node_growth, 0.0)
    return beyond, np.minimum(beyond, 1.0)


def spring_energies(model: OrganModel, length: FloatArray) -> FloatArray:
    """Energy of each spring at lengths [m] (n_spring,), without Maxwell arms [J], (n_spring,).

    Their sum is U = sum_s k (l - l0)^2 / 2 + sum_a A_a w_a(s_a), with w_a' the rise of tension over a linear spring's
    at the strain s_a and A_a = sum k l0^2 / 10 over the springs of node a, a node's part divided among its springs as
    k (l - l0)^2. The gradient is `spring_tensions`.
    """
    twice = model.spring_stiffness * np.square(length - model.spring_rest_length)
    if not model.stiffens:
        return 0.5 * twice
    strain = node_strains(model, length)
    beyond, ramp = _ramps(model, strain)
    over = beyond - ramp
    added = (
        model.node_excess / model.node_growth * (ramp * ramp * ramp * ramp / 12.0 + over / 3.0 + 0.5 * (over * over))
    )
    # A_a w_a over the sum of k (l - l0)^2, which is s^2 / softness with A = 1 / (2 softness).
    share = 0.5 * added / np.square(np.maximum(strain, STRAIN_LEAST))
    return twice * (0.5 + share[model.spring_nodes].sum(axis=1))


def contact_energy(model: OrganModel, state: OrganState, shapes: ContactShapes, contact: ContactLaw) -> float:
    """Elastic energy of the contact between tissue and shapes in their present places, without friction [J].

    E = sum over shapes and quadrature points of (k_p / 2) A g^2, g = s (s + t) / r: with d from the shape's core to the
    point and n the triangle's normal, t = d . n and s^2 = r^2 - (|d|^2 - t^2). Counted are points inside the shape with
    t <= 0 (met from outside) or already in contact (`state.contact_engaged`). The guard of the axes is not included.
    """
    corners = state.node_position[model.surface_triangles]
    normal = area_vectors(corners)
    normal /= norm(normal, axis=1)[:, None]
    points = matmul(QUADRATURE_BARYCENTRIC, corners)
    energy = 0.0
    for shape, radius in enumerate(shapes.shape_radius):
        start, axis = shapes.shape_ends[shape, 0], np.diff(shapes.shape_ends[shape], axis=0)[0]
        squared = float(matmul(axis, axis))
        along = (
            np.clip(matmul(points - start, axis) / squared, 0.0, 1.0) if squared > 0.0 else np.zeros(points.shape[:2])
        )
        offset = points - start - along[:, :, None] * axis
        span = shapes.shape_span[shape]
        if span.any():
            offset -= np.clip(matmul(offset, span) / matmul(span, span), -1.0, 1.0)[:, :, None] * span
        height = dot(offset, normal[:, None])
        chord_squared = radius * radius - (dot(offset, offset) - height * height)
        chord = np.sqrt(np.maximum(chord_squared, 0.0))
        held = state.contact_engaged[shape].reshape(-1, QUADRATURE_COUNT) != 0
        inside = (chord_squared > 0.0) & (chord + height > 0.0) & (held | (height <= 0.0))
        depth = np.where(inside, chord * (chord + height) / radius, 0.0)
        area = model.surface_rest_area * QUADRATURE_WEIGHT
        energy += 0.5 * contact.stiffness * float(matmul(area, (depth * depth).sum(axis=1)))
    return energy


class TissueLoad(NamedTuple):
    """Largest load of the tissue, averaged at nodes.

    Fields:
        pressure: largest contact pressure, per undeformed area [Pa]; 0 without contact
        pressure_node: its node
        strain: largest |lambda - 1| of the principal stretches
        strain_node: its node
        equivalent_strain: largest of the nodes that stiffen (`Stiffening`); 0 without
    """

    pressure: float
    pressure_node: int
    strain: float
    strain_node: int
    equivalent_strain: float


def tissue_load(model: OrganModel, state: OrganState, shapes: ContactShapes, contact: ContactLaw) -> TissueLoad:
    """Largest contact pressure, principal strain and equivalent strain of an organ.

    p_i = sum of w A k_p g over the quadrature points around node i (`contact_energy`), over a third of the area of its
    triangles; F_i = sum V_t F_t / sum V_t over its tets, with the singular values lambda: averages over a cell.
    """
    push = np.zeros(len(model.node_mass))
    add_pressures(model, state, shapes, contact.stiffness, push)
    third = np.repeat(model.surface_rest_area / 3.0, 3)
    area = np.bincount(model.surface_triangles.ravel(), third, len(push))
    pressure = np.divide(push, area, out=np.zeros_like(push), where=area > 0.0)
    gradient = np.zeros((len(push), 3, 3))
    add_gradients(model.node_rest_position, state.node_position, model.tet_nodes, gradient)
    gradient /= 4.0 * model.node_rest_volume[:, None, None]
    squared = matmul(gradient.transpose(0, 2, 1), gradient)
    # Eigenvalues lie within the mean +- twice the root of a sixth of the deviator's square (Smith 1961): this bound
    # leaves few nodes for the eigenvalues.
    mean = np.trace(squared, axis1=1, axis2=2) / 3.0
    spread = 2.0 * np.sqrt(np.maximum((squared * squared).sum(axis=(1, 2)) - 3.0 * (mean * mean), 0.0) / 6.0)
    bound = np.maximum(np.sqrt(mean + spread) - 1.0, 1.0 - np.sqrt(np.maximum(mean - spread, 0.0)))
    near = np.flatnonzero(bound >= _principal_strain(squared[[bound.argmax()]])[0] - ROUNDING)
    strain = _principal_strain(squared[near])
    equivalent = 0.0
    if model.stiffens:
        ends = state.node_position[model.spring_nodes]
        length = norm(ends[:, 1] - ends[:, 0], axis=1)
        equivalent = float(node_strains(model, length)[model.node_excess > 0.0].max())
    place, most = int(pressure.argmax()), int(strain.argmax())
    return TissueLoad(float(pressure[place]), place, float(strain[most]), int(near[most]), equivalent)


def _principal_strain(squared: FloatArray) -> FloatArray:
    """Largest |lambda - 1| of the square roots lambda of the eigenvalues of C = F^T F (n, 3, 3), (n,)."""
    return np.abs(np.sqrt(np.maximum(eigh(squared)[0], 0.0)) - 1.0).max(axis=1)


def volume_ratios(model: OrganModel, state: OrganState) -> FloatArray:
    """Volume of each tet over its volume at rest, J = V / V0, negative for a tet inside out, shape (n_tet,)."""
    ratio = np.empty(len(model.tet_nodes))
    fill_volume_ratios(state.node_position, model.tet_nodes, model.tet_rest_volume, ratio)
    return ratio


def inverted_tets(model: OrganModel, state: OrganState) -> IntArray:
    """Indices of the tets inside out, flat or not finite (J > 0 does not hold), shape (n_inverted,)."""
    return np.flatnonzero(~(volume_ratios(model, state) > 0.0)).astype(np.int32)


def support_forces(model: OrganModel, state: OrganState) -> FloatArray:
    """Force of each support on the organ, friction included [N], shape (n_support, 3); the state does not change.

    The load on the support is its negative.
    """
    force, load, ground = np.zeros_like(state.node_position), state.ground_load.copy(), state.ground_support.copy()
    place_ground(model, state.motion, state.ground_foundation.copy(), ground)
    add_support_forces(
        model, ground, state.node_position, state.node_velocity, force, state.support_stretch.copy(), load, 0.0
    )
    return load
