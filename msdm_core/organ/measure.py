"""Measured quantities of an organ's state: energy, tissue load, volume ratios, inverted tets, forces of supports."""

from typing import NamedTuple

import numpy as np

from msdm_core.arithmetic import dot, eigh, log, matmul, norm
from msdm_core.kernels.contact_kernels import (
    QUADRATURE_BARYCENTRIC,
    QUADRATURE_COUNT,
    QUADRATURE_RISE,
    QUADRATURE_WEIGHT,
)
from msdm_core.kernels.element_kernels import SQUEEZED_RATIO, STRAIN_LEAST
from msdm_core.kernels.load_kernels import (
    add_gradients,
    add_pressures,
    add_to_corners,
    fill_corner_means,
    fill_lengths,
    fill_principal_values,
    fill_volume_ratios,
)
from msdm_core.kernels.structure_kernels import ContactLaw, ContactShapes, OrganModel, OrganState
from msdm_core.kernels.support_kernels import add_support_forces, place_ground
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, area_vectors
from msdm_core.organ.motion import SIGNAL


def kinetic_energy(model: OrganModel, state: OrganState) -> float:
    """Energy of motion, T = sum_i m_i |v_i|^2 / 2 [J]."""
    return 0.5 * float(matmul(model.node_mass, dot(state.node_velocity, state.node_velocity)))


def potential_energy(model: OrganModel, state: OrganState) -> float:
    """Energy of springs, volume term, foundations and gravity, zero at the undeformed position [J].

    U = sum_e U_e + sum_t K'_t s V0_t ((J_t - s) - s ln(J_t / s)) + sum_h u_h . K_h u_h / 2 - sum_i m_i g . (x_i - X_i)
    with U_e the energy of a spring, a tet or an averaged volume without Maxwell arms (`element_energies`), if linear
    k (l - l0)^2 / 2, K_t V0_t (J_t - 1)^2 / 2 and K_a V0_a (J_a - 1)^2 / 2;
    K'_t the whole volume modulus of a tet, its sum over tets below s = SQUEEZED_RATIO (infinite for a tet inside out);
    u_h the displacement of a node on an elastic foundation. Contact with tools (`contact_energy`) and supports is not
    included.
    """
    strain = element_strains(model, state.node_position)
    elements = float(element_energies(model, strain, node_strains(model, strain)).sum())
    volume = float(squeezed_energies(model, volume_ratios(model, state)).sum())
    lift = matmul(state.node_position - model.node_rest_position, model.gravity)
    ground = (state.motion[:, SIGNAL, None, None] * model.motion_foundation_shift).sum(axis=0)
    moved = state.node_position[model.foundation_nodes] - (model.foundation_position + ground)
    held = 0.5 * float((dot(model.foundation_stiffness, moved[:, None]) * moved).sum())
    return elements + volume + held - float(matmul(model.node_mass, lift))


def squeezed_energies(model: OrganModel, ratio: FloatArray) -> FloatArray:
    """Energy of the barrier of each tet [J] (`potential_energy`), from the volume ratios J, both (n_tet,)."""
    energy = np.zeros(len(ratio))
    squeezed = np.flatnonzero(~(ratio >= SQUEEZED_RATIO) & (model.tet_barrier_bulk > 0.0))
    share = np.maximum(ratio[squeezed], 0.0) / SQUEEZED_RATIO
    with np.errstate(divide="ignore"):
        barrier = SQUEEZED_RATIO * SQUEEZED_RATIO * ((share - 1.0) - log(share))
    energy[squeezed] = (model.tet_barrier_bulk * model.tet_rest_volume)[squeezed] * barrier
    return energy


def squeezed_tensions(model: OrganModel, ratio: FloatArray) -> FloatArray:
    """Tension of the barrier of each tet, K' (J - s) s / J below s (`element_kernels.tet_scale`) [Pa], (n_tet,)."""
    return model.tet_barrier_bulk * np.minimum(ratio - SQUEEZED_RATIO, 0.0) * (SQUEEZED_RATIO / ratio)


def element_strains(model: OrganModel, position: FloatArray) -> FloatArray:
    """Strain of each spring, l / l0 - 1, of each tet, J - 1, and of the volume averaged at each node, J_a - 1.

    Springs, tets and averaged volumes are the elements that `Stiffening` and `Relaxation` apply to, (n_element,).

    Args:
        model: the organ.
        position: of the nodes [m], (n_node, 3).
    """
    length, ratio = np.empty(len(model.spring_nodes)), np.empty(len(model.tet_nodes))
    fill_lengths(position, model.spring_nodes, length)
    fill_volume_ratios(position, model.tet_nodes, model.tet_rest_volume, ratio)
    averaged = corner_sums(model, model.tet_nodes, ratio * model.tet_rest_volume / 4.0) / model.node_rest_volume
    return np.concatenate([length / model.spring_rest_length, ratio, averaged]) - 1.0


def element_stiffness(model: OrganModel) -> FloatArray:
    """Tension over strain of each linear element, k l0 of a spring [N/m], K of a volume [Pa], (n_element,).

    Tension of a spring is over l0, as of its Maxwell arms.
    """
    return np.concatenate([model.spring_stiffness, model.tet_bulk, model.node_bulk])


def element_size(model: OrganModel) -> FloatArray:
    """Twice the linear energy of each element over strain and tension, l0^2 [m^2] or V0 [m^3], (n_element,)."""
    return np.concatenate([np.square(model.spring_rest_length), model.tet_rest_volume, model.node_rest_volume])


def node_shares(model: OrganModel, energy: FloatArray) -> FloatArray:
    """Sum of the energies of elements (n_element,) at each node, an even share at each of an element's, (n_node,)."""
    springs, tets = len(model.spring_nodes), len(model.tet_nodes)
    total = corner_sums(model, model.spring_nodes, 0.5 * energy[:springs])
    quarters = corner_sums(model, model.tet_nodes, 0.25 * energy[springs : springs + tets])
    return total + quarters + energy[springs + tets :]


def corner_sums(model: OrganModel, nodes: IntArray, value: FloatArray) -> FloatArray:
    """Sum at each node (n_node,) of a value (n,) of the items with nodes (n, m)."""
    total = np.zeros(len(model.node_mass))
    add_to_corners(nodes, value, total)
    return total


def element_means(model: OrganModel, value: FloatArray) -> FloatArray:
    """Mean of a value of the nodes (n_node,) at each element, (n_element,)."""
    return np.concatenate([corner_means(value, model.spring_nodes), corner_means(value, model.tet_nodes), value])


def corner_means(value: FloatArray, nodes: IntArray) -> FloatArray:
    """Mean of a value of the nodes (n_node,) over the nodes (n, m) of each item, (n,)."""
    mean = np.empty(len(nodes))
    fill_corner_means(nodes, value, mean)
    return mean


def element_tensions(model: OrganModel, strain: FloatArray, equivalent: FloatArray) -> FloatArray:
    """Tension of each element without Maxwell arms [N/m, Pa], (n_element,).

    Args:
        model: the organ.
        strain: of the elements, (n_element,).
        equivalent: strain of the nodes (`node_strains`), (n_node,).
    """
    tension = element_stiffness(model) * strain
    if not model.stiffens:
        return tension
    return tension * (1.0 + element_means(model, node_rises(model, equivalent)))


def node_strains(model: OrganModel, strain: FloatArray) -> FloatArray:
    """Equivalent strain of each node, s^2 = 2 U_a / (E_a V_a) (`Stiffening`), from those of elements (n_element,).

    0 of an organ that does not stiffen, (n_node,).
    """
    if not model.stiffens:
        return np.zeros(len(model.node_mass))
    twice = element_size(model) * element_stiffness(model) * np.square(strain)
    return np.sqrt(2.0 * model.node_softness * node_shares(model, twice))


def node_rises(model: OrganModel, strain: FloatArray) -> FloatArray:
    """Relative rise of tension over linear tissue at each node (`element_kernels.node_law`), (n_node,)."""
    beyond, ramp = _ramps(model, strain)
    return model.node_excess * ((ramp * ramp * ramp) / 3.0 + (beyond - ramp)) / np.maximum(strain, STRAIN_LEAST)


def _ramps(model: OrganModel, strain: FloatArray) -> tuple[FloatArray, FloatArray]:
    """U = (s - e0) / (e1 - e0) from 0 on and v = min(u, 1) of each node (`Stiffening`), (n_node,) each."""
    beyond = np.maximum((strain - model.node_onset) * model.node_growth, 0.0)
    return beyond, np.minimum(beyond, 1.0)


def element_energies(model: OrganModel, strain: FloatArray, equivalent: FloatArray) -> FloatArray:
    """Energy of each element without Maxwell arms [J], (n_element,); arguments as of `element_tensions`.

    Their sum is U = sum_a E_a V_a w(s_a), a node's part divided among its elements as their linear energies. The
    gradient over strain is tension times `element_size`.
    """
    twice = element_size(model) * element_stiffness(model) * np.square(strain)
    if not model.stiffens:
        return 0.5 * twice
    beyond, ramp = _ramps(model, equivalent)
    over = beyond - ramp
    added = (
        model.node_excess / model.node_growth * (ramp * ramp * ramp * ramp / 12.0 + over / 3.0 + 0.5 * (over * over))
    )
    # The rise of w(s) over s^2 / 2.
    rise = 2.0 * added / np.square(np.maximum(equivalent, STRAIN_LEAST))
    return 0.5 * twice * (1.0 + element_means(model, rise))


def contact_energy(model: OrganModel, state: OrganState, shapes: ContactShapes, contact: ContactLaw) -> float:
    """Elastic energy of the contact between tissue and shapes in their present places, without friction [J].

    E = sum over shapes and quadrature points of (k_p / 2) A g^2, g = s (s + t) / r: with d from the shape's core to the
    point and n the triangle's normal, t = d . n and s^2 = r^2 - (|d|^2 - t^2). Counted are points inside the shape with
    t <= 0 (met from outside) or already in contact (`state.contact_engaged`). The guard of the axes is not included.
    """
    corners = state.node_position[model.surface_triangles]
    normal = area_vectors(corners)
    normal /= norm(normal, axis=1)[:, None]
    rise = matmul(model.surface_rise.transpose(0, 2, 1), state.node_position[model.surface_around])
    points = matmul(QUADRATURE_BARYCENTRIC, corners) + matmul(QUADRATURE_RISE, rise)
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

    Pressures are those of `node_pressures`; F_i = sum V_t F_t / sum V_t over the tets of node i, with the singular
    values lambda, is likewise an average over a cell.
    """
    pressure = node_pressures(model, state, shapes, contact)
    gradient = np.zeros((len(pressure), 3, 3))
    add_gradients(model.node_rest_position, state.node_position, model.tet_nodes, gradient)
    gradient /= 4.0 * model.node_rest_volume[:, None, None]
    squared = matmul(gradient.transpose(0, 2, 1), gradient)
    strain = np.abs(np.sqrt(np.maximum(principal_values(squared), 0.0)) - 1.0).max(axis=1)
    equivalent = 0.0
    if model.stiffens:
        node_strain = node_strains(model, element_strains(model, state.node_position))
        equivalent = float(node_strain[model.node_excess > 0.0].max())
    place, most = int(pressure.argmax()), int(strain.argmax())
    # To rounding, also where two principal values are close.
    largest = np.abs(np.sqrt(np.maximum(eigh(squared[[most]])[0], 0.0)) - 1.0).max()
    return TissueLoad(float(pressure[place]), place, float(largest), most, equivalent)


def node_pressures(model: OrganModel, state: OrganState, shapes: ContactShapes, contact: ContactLaw) -> FloatArray:
    """Contact pressure at each node, per undeformed area [Pa], (n_node,); 0 inside the organ.

    p_i = sum of w A k_p g over the quadrature points around node i (`contact_energy`), over a third of the area of its
    triangles: an average over a cell.
    """
    push = np.zeros(len(model.node_mass))
    add_pressures(model, state, shapes, contact.stiffness, push)
    area = corner_sums(model, model.surface_triangles, model.surface_rest_area / 3.0)
    return np.divide(push, area, out=np.zeros_like(push), where=area > 0.0)


def principal_values(matrices: FloatArray) -> FloatArray:
    """Eigenvalues of symmetric matrices (n, 3, 3), descending, (n, 3); two close ones to 1e-8 of the deviator."""
    values = np.empty((3, len(matrices)))
    fill_principal_values(np.ascontiguousarray(matrices.transpose(1, 2, 0)), values)
    return values.T


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
