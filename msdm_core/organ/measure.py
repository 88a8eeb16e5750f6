"""Quantities of the state of an organ: energy, momentum, volume ratios, inverted tets, forces."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.arithmetic import dot, eigh, log, matmul, norm
from msdm_core.kernels.contact_kernels import (
    QUADRATURE_BARYCENTRIC,
    QUADRATURE_COUNT,
    QUADRATURE_WEIGHT,
    closest_on_axis,
)
from msdm_core.kernels.element_kernels import SQUEEZED_RATIO, STRAIN_LEAST
from msdm_core.kernels.guard_kernels import GUARD_SHARE, closest_in_triangle
from msdm_core.kernels.load_kernels import add_gradients, add_pressures, fill_volume_ratios
from msdm_core.kernels.structure_kernels import ContactLaw, ContactShapes, OrganModel, OrganState
from msdm_core.kernels.substep_kernels import evaluate_forces
from msdm_core.kernels.support_kernels import add_support_forces, place_ground
from msdm_core.material.tissue_law import ARM_COUNT
from msdm_core.mesh.tet_mesh import FloatArray, IntArray
from msdm_core.organ.motion import foundation_places

# Of strains, as a margin.
ROUNDING = 1e-12


def kinetic_energy(model: OrganModel, state: OrganState) -> float:
    """Energy of motion, T = sum_i m_i |v_i|^2 / 2 [J]."""
    return 0.5 * float(matmul(model.node_mass, dot(state.node_velocity, state.node_velocity)))


def potential_energy(model: OrganModel, state: OrganState) -> float:
    """Energy of springs, volume term, foundations and gravity, zero at the undeformed position [J].

    U = sum_s U_s(l_s) + sum_t K_t V0_t (J_t - 1)^2 / 2 + sum_a K_a V0_a (J_a - 1)^2 / 2
        + sum_t K'_t s V0_t ((J_t - s) - s ln(J_t / s)) + sum_h u_h . K_h u_h / 2 - sum_i m_i g . (x_i - X_i)
    where U_s is the energy of a spring, k (l - l0)^2 / 2 if none stiffens, with that of its Maxwell arms, a is a volume
    averaged at a node, K'_t the share averaged and the fourth sum over tets below s = SQUEEZED_RATIO (infinite for one
    that is inside out), and u_h the displacement of a node on an elastic foundation. A resting tool's `contact_energy`
    is not in it, nor what supports store.
    """
    ends = state.node_position[model.spring_nodes]
    length = norm(ends[:, 1] - ends[:, 0], axis=1)
    springs = float(spring_energies(model, length).sum()) + arm_energy(model, state, length)
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
    moved = state.node_position[model.foundation_nodes] - foundation_places(model, state)
    held = 0.5 * float((dot(model.foundation_stiffness, moved[:, None]) * moved).sum())
    return springs + volume + held - float(matmul(model.node_mass, lift))


def spring_tensions(model: OrganModel, length: FloatArray) -> FloatArray:
    """Tension of each spring without its Maxwell arms where all have some lengths [m] (n_spring,) [N], (n_spring,)."""
    change = length - model.spring_rest_length
    tension = model.spring_stiffness * change
    if not model.stiffens:
        return tension
    rise = _node_rises(model, node_strains(model, length))
    return tension * (1.0 + rise[model.spring_nodes].mean(axis=1))


def node_strains(model: OrganModel, length: FloatArray) -> FloatArray:
    """Equivalent strain of each node, s^2 = 5 sum k (l - l0)^2 / sum k l0^2 over its springs of some lengths [m]."""
    twice = model.spring_stiffness * np.square(length - model.spring_rest_length)
    return np.sqrt(model.node_softness * np.bincount(model.spring_nodes.ravel(), np.repeat(twice, 2)))


def _node_rises(model: OrganModel, strain: FloatArray) -> FloatArray:
    """What stiffening adds to tension over that of linear springs (`element_kernels.node_law`), (n_node,)."""
    beyond = np.maximum((strain - model.node_onset) * model.node_growth, 0.0)
    ramp = np.minimum(beyond, 1.0)
    return model.node_excess * ((ramp * ramp * ramp) / 3.0 + (beyond - ramp)) / np.maximum(strain, STRAIN_LEAST)


def spring_energies(model: OrganModel, length: FloatArray) -> FloatArray:
    """Energy of all springs of some lengths [m] (n_spring,), without Maxwell arms, shared among them [J], (n_spring,).

    U = sum_s k (l - l0)^2 / 2 + sum_a A_a w_a(s_a), where w_a' is what stiffening adds to the strain s_a in the
    tension and A_a = sum k l0^2 / 10 over the springs of node a; a node's part belongs to its springs as k (l - l0)^2
    does. The gradient is `spring_tensions`.
    """
    twice = model.spring_stiffness * np.square(length - model.spring_rest_length)
    if not model.stiffens:
        return 0.5 * twice
    strain = node_strains(model, length)
    beyond = np.maximum((strain - model.node_onset) * model.node_growth, 0.0)
    ramp = np.minimum(beyond, 1.0)
    over = beyond - ramp
    added = (
        model.node_excess / model.node_growth * (ramp * ramp * ramp * ramp / 12.0 + over / 3.0 + 0.5 * (over * over))
    )
    # A_a w_a over the sum of k (l - l0)^2, which is s^2 / softness with A = 1 / (2 softness).
    share = 0.5 * added / np.square(np.maximum(strain, STRAIN_LEAST))
    return twice * (0.5 + share[model.spring_nodes].sum(axis=1))


def arm_energy(model: OrganModel, state: OrganState, length: FloatArray) -> float:
    """Energy that the Maxwell arms of all springs store at some lengths [m] (n_spring,) [J].

    Arms of tension g (T - z), which have given way to the tensions z, store g (U(l) - U(l_z) - z . (l - l_z)) with the
    energy U and tensions T of the elastic springs and T(l_z) = z: what they return where the springs go back to l_z at
    once. While they give way at constant lengths, that energy only falls, because U is convex. Where g differs from
    spring to spring, each has its share.

    Raises:
        ValueError: lengths with the tensions z were not found.
    """
    if not model.relaxes:
        return 0.0
    energy, total = spring_energies(model, length), 0.0
    for modulus, given in zip(
        model.spring_arm_modulus.reshape(ARM_COUNT, -1),
        state.spring_arm_tension.reshape(ARM_COUNT, -1) * model.spring_rest_length,
        strict=True,
    ):
        reached = _lengths_of(model, given)
        total += float(matmul(modulus, energy - spring_energies(model, reached) - given * (length - reached)))
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
        wanted = _node_rises(model, strain)
        if (np.abs(wanted - rise) <= LENGTH_TOLERANCE * (1.0 + rise)).all():
            return length
        ramp = np.clip((strain - model.node_onset) * model.node_growth, 0.0, 1.0)
        tangent = 1.0 + model.node_excess * model.node_growth * (ramp * ramp)
        rise = rise + (wanted - rise) * np.minimum((1.0 + wanted) / tangent, 1.0)
    raise ValueError(
        f"no lengths were found for the tensions that the arms have given way to, in {LENGTH_ROUNDS} rounds"
    )


def contact_energy(model: OrganModel, state: OrganState, shapes: ContactShapes, contact: ContactLaw) -> float:
    """Energy stored in the contact between tissue and shapes in their present places, without that of friction [J].

    E = sum over shapes and quadrature points of (k_p / 2) A g^2, g = s (s + t) / r: with d from the shape's core to the
    point and n the triangle's normal, t = d . n and s^2 = r^2 - (|d|^2 - t^2). Counted are points inside the shape that
    it meets from outside (t <= 0) or holds already (`state.contact_engaged`). To this comes the guard's energy.
    """
    corners = state.node_position[model.surface_triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
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
        energy += _guard_energy(corners, normal, shapes.shape_ends[shape], radius, contact.stiffness)
    return energy


def _guard_energy(corners: FloatArray, normal: FloatArray, ends: FloatArray, radius: float, stiffness: float) -> float:
    """Energy of the push k h (h / d - 1) on triangles nearer than h to the axis: k h (h ln(h / d) - (h - d)) [J].

    Exact for a ball; of a shaft the nearest point is that of the kernel.
    """
    reach = GUARD_SHARE * radius
    middle = corners.mean(axis=1)
    size = norm(corners - middle[:, None], axis=2).max(axis=1)
    gap = norm(middle - ends.mean(axis=0), axis=1) - size - 0.5 * norm(ends[1] - ends[0])
    energy = 0.0
    for triangle in np.flatnonzero(gap < reach):
        a, b, c = corners[triangle]
        low = ends[np.argmin(matmul(ends - a, normal[triangle]))]
        wb, wc = closest_in_triangle(*(b - a), *(c - a), *(low - a))
        point = a + wb * (b - a) + wc * (c - a)
        offset = point - np.array(closest_on_axis(ends[None], 0, *point))
        distance = float(norm(offset))
        if distance < reach and matmul(offset, normal[triangle]) < 0.0:
            energy += reach * float(log(reach / distance)) - (reach - distance)
    return math.pi * (radius * radius) * stiffness * reach * energy


class TissueLoad(NamedTuple):
    """What tissue bears where it bears most, averaged at nodes.

    Fields:
        pressure: largest contact pressure, per undeformed area [Pa]; 0 without contact
        pressure_node: where
        strain: largest |lambda - 1| of the principal stretches
        strain_node: where
    """

    pressure: float
    pressure_node: int
    strain: float
    strain_node: int


def tissue_load(model: OrganModel, state: OrganState, shapes: ContactShapes, contact: ContactLaw) -> TissueLoad:
    """Largest contact pressure and principal strain of an organ.

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
    # Eigenvalues lie within the mean +- twice the root of a sixth of the deviator's square (Smith 1961): nodes whose
    # bound is below a strain that is known need no closer look.
    mean = np.trace(squared, axis1=1, axis2=2) / 3.0
    spread = 2.0 * np.sqrt(np.maximum((squared * squared).sum(axis=(1, 2)) - 3.0 * (mean * mean), 0.0) / 6.0)
    bound = np.maximum(np.sqrt(mean + spread) - 1.0, 1.0 - np.sqrt(np.maximum(mean - spread, 0.0)))
    near = np.flatnonzero(bound >= _principal_strain(squared[[bound.argmax()]])[0] - ROUNDING)
    strain = _principal_strain(squared[near])
    return TissueLoad(float(pressure.max()), int(pressure.argmax()), float(strain.max()), int(near[strain.argmax()]))


def _principal_strain(squared: FloatArray) -> FloatArray:
    """Largest |lambda - 1| of the square roots lambda of the eigenvalues of C = F^T F (n, 3, 3), (n,)."""
    return np.abs(np.sqrt(np.maximum(eigh(squared)[0], 0.0)) - 1.0).max(axis=1)


def momentum(model: OrganModel, state: OrganState) -> FloatArray:
    """Linear momentum, p = sum_i m_i v_i [kg m/s], shape (3,)."""
    return matmul(model.node_mass, state.node_velocity)


def angular_momentum(model: OrganModel, state: OrganState, point: ArrayLike) -> FloatArray:
    """Angular momentum about a point [m], L = sum_i m_i (x_i - point) x v_i [kg m^2/s], shape (3,)."""
    arm = state.node_position - np.asarray(point, dtype=np.float64)
    return matmul(model.node_mass, np.cross(arm, state.node_velocity))


def volume_ratios(model: OrganModel, state: OrganState) -> FloatArray:
    """Volume of each tet over its volume at rest, J = V / V0, negative where it is inside out, shape (n_tet,)."""
    ratio = np.empty(len(model.tet_nodes))
    fill_volume_ratios(state.node_position, model.tet_nodes, model.tet_rest_volume, ratio)
    return ratio


def inverted_tets(model: OrganModel, state: OrganState) -> IntArray:
    """Indices of the tets that are inside out, flat or not finite (J > 0 does not hold), shape (n_inverted,)."""
    return np.flatnonzero(~(volume_ratios(model, state) > 0.0)).astype(np.int32)


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
