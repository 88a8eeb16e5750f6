"""Quantities of the state of an organ: energy, momentum, volume ratios, inverted tets, forces."""

import math

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.kernels.contact_kernels import (
    QUADRATURE_BARYCENTRIC,
    QUADRATURE_COUNT,
    QUADRATURE_WEIGHT,
    closest_on_axis,
)
from msdm_core.kernels.element_kernels import SQUEEZED_RATIO
from msdm_core.kernels.guard_kernels import GUARD_SHARE, closest_in_triangle
from msdm_core.kernels.structure_kernels import ContactLaw, ContactShapes, OrganModel, OrganState
from msdm_core.kernels.substep_kernels import evaluate_forces
from msdm_core.kernels.support_kernels import add_support_forces
from msdm_core.material.tissue_law import ARM_COUNT
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, tet_volumes


def kinetic_energy(model: OrganModel, state: OrganState) -> float:
    """Energy of motion, T = sum_i m_i |v_i|^2 / 2 [J]."""
    return 0.5 * float(model.node_mass @ np.einsum("ij,ij->i", state.node_velocity, state.node_velocity))


def potential_energy(model: OrganModel, state: OrganState) -> float:
    """Energy of springs, volume term, foundations and gravity, zero at the undeformed position [J].

    U = sum_s U_s(l_s) + sum_t K_t V0_t (J_t - 1)^2 / 2 + sum_a K_a V0_a (J_a - 1)^2 / 2
        + sum_t K'_t s V0_t ((J_t - s) - s ln(J_t / s)) + sum_h u_h . K_h u_h / 2 - sum_i m_i g . (x_i - X_i)
    where U_s is the energy of a spring, k (l - l0)^2 / 2 if it is linear, with that of its Maxwell arms, a is a volume
    averaged at a node, K'_t the share averaged and the fourth sum over tets below s = SQUEEZED_RATIO (infinite for one
    that is inside out), and u_h the displacement of a node on an elastic foundation. A resting tool's `contact_energy`
    is not in it, nor what supports store.
    """
    ends = state.node_position[model.spring_nodes]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    springs = float(spring_energies(model, length).sum()) + arm_energy(model, state, length)
    ratio = volume_ratios(model, state)
    volume = 0.5 * float((model.tet_bulk * model.tet_rest_volume) @ (ratio - 1.0) ** 2)
    squeezed = np.flatnonzero(~(ratio >= SQUEEZED_RATIO) & (model.tet_averaged_bulk > 0.0))
    share = np.maximum(ratio[squeezed], 0.0) / SQUEEZED_RATIO
    with np.errstate(divide="ignore"):
        barrier = SQUEEZED_RATIO**2 * ((share - 1.0) - np.log(share))
    volume += float((model.tet_averaged_bulk * model.tet_rest_volume)[squeezed] @ barrier)
    quarter = np.repeat(ratio * model.tet_rest_volume / 4.0, 4)
    averaged = np.bincount(model.tet_nodes.ravel(), quarter, len(model.node_mass)) / model.node_rest_volume
    volume += 0.5 * float((model.node_bulk * model.node_rest_volume) @ (averaged - 1.0) ** 2)
    lift = (state.node_position - model.node_rest_position) @ model.gravity
    moved = state.node_position[model.foundation_nodes] - model.foundation_position
    held = 0.5 * float(np.einsum("ni,nij,nj->", moved, model.foundation_stiffness, moved))
    return springs + volume + held - float(model.node_mass @ lift)


def spring_tensions(model: OrganModel, length: FloatArray) -> FloatArray:
    """Tension of each spring at some lengths [m] (n_spring,) without its Maxwell arms [N], (n_spring,)."""
    change = length - model.spring_rest_length
    tension = model.spring_stiffness * change
    if not model.stiffens:
        return tension
    beyond = np.maximum(np.abs(change) * model.spring_growth - model.spring_onset, 0.0)
    ramp = np.minimum(beyond, 1.0)
    excess = model.spring_excess * (ramp**3 / 3.0 + (beyond - ramp))
    return tension + np.sign(change) * model.spring_stiffness * model.spring_rest_length * excess


def spring_energies(model: OrganModel, length: FloatArray) -> FloatArray:
    """Integral of `spring_tensions` from the rest length to some lengths [m] (n_spring,) [J], (n_spring,)."""
    change = length - model.spring_rest_length
    energy = 0.5 * model.spring_stiffness * change**2
    if not model.stiffens:
        return energy
    beyond = np.maximum(np.abs(change) * model.spring_growth - model.spring_onset, 0.0)
    ramp = np.minimum(beyond, 1.0)
    over = beyond - ramp
    scale = np.divide(
        model.spring_stiffness * model.spring_rest_length * model.spring_excess,
        model.spring_growth,
        out=np.zeros_like(energy),
        where=model.spring_growth > 0.0,
    )
    return energy + scale * (ramp**4 / 12.0 + over / 3.0 + 0.5 * over**2)


def arm_energy(model: OrganModel, state: OrganState, length: FloatArray) -> float:
    """Energy that the Maxwell arms of all springs store at some lengths [m] (n_spring,) [J].

    An arm of tension g (T - z), which has given way to the tension z, stores g (U(l) - U(l_z) - z (l - l_z)) with the
    energy U and tension T of the elastic spring and T(l_z) = z: what it returns where the spring goes back to l_z at
    once. While it gives way at a constant length, that energy only falls.
    """
    if not model.relaxes:
        return 0.0
    rest = model.spring_rest_length
    energy, total = spring_energies(model, length), 0.0
    for modulus, given in zip(
        model.spring_arm_modulus.reshape(ARM_COUNT, -1),
        state.spring_arm_tension.reshape(ARM_COUNT, -1) * rest,
        strict=True,
    ):
        # Bisection: a linear spring would have to go further for the same tension.
        furthest = given / model.spring_stiffness
        low, high = rest + np.minimum(furthest, 0.0), rest + np.maximum(furthest, 0.0)
        for _ in range(60):
            middle = 0.5 * (low + high)
            above = spring_tensions(model, middle) > given
            low, high = np.where(above, low, middle), np.where(above, middle, high)
        reached = 0.5 * (low + high)
        total += float(modulus @ (energy - spring_energies(model, reached) - given * (length - reached)))
    return total


def contact_energy(model: OrganModel, state: OrganState, shapes: ContactShapes, contact: ContactLaw) -> float:
    """Energy stored in the contact between tissue and shapes in their present places, without that of friction [J].

    E = sum over shapes and quadrature points of (k_p / 2) A g^2, g = s (s + t) / r: with d from the shape's core to the
    point and n the triangle's normal, t = d . n and s^2 = r^2 - (|d|^2 - t^2). Counted are points inside the shape that
    it meets from outside (t <= 0) or holds already (`state.contact_engaged`). To this comes the guard's energy.
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
        span = shapes.shape_span[shape]
        if span.any():
            offset -= np.clip(offset @ span / (span @ span), -1.0, 1.0)[:, :, None] * span
        height = np.einsum("tqx,tx->tq", offset, normal)
        chord_squared = radius**2 - (np.einsum("tqx,tqx->tq", offset, offset) - height**2)
        chord = np.sqrt(np.maximum(chord_squared, 0.0))
        held = state.contact_engaged[shape].reshape(-1, QUADRATURE_COUNT) != 0
        inside = (chord_squared > 0.0) & (chord + height > 0.0) & (held | (height <= 0.0))
        depth = np.where(inside, chord * (chord + height) / radius, 0.0)
        area = model.surface_rest_area * QUADRATURE_WEIGHT
        energy += 0.5 * contact.stiffness * float(area @ (depth * depth).sum(axis=1))
        energy += _guard_energy(corners, normal, shapes.shape_ends[shape], radius, contact.stiffness)
    return energy


def _guard_energy(corners: FloatArray, normal: FloatArray, ends: FloatArray, radius: float, stiffness: float) -> float:
    """Energy of the push k h (h / d - 1) on triangles nearer than h to the axis: k h (h ln(h / d) - (h - d)) [J].

    Exact for a ball; of a shaft the nearest point is that of the kernel.
    """
    reach = GUARD_SHARE * radius
    middle = corners.mean(axis=1)
    size = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    gap = np.linalg.norm(middle - ends.mean(axis=0), axis=1) - size - 0.5 * np.linalg.norm(ends[1] - ends[0])
    energy = 0.0
    for triangle in np.flatnonzero(gap < reach):
        a, b, c = corners[triangle]
        low = ends[np.argmin((ends - a) @ normal[triangle])]
        wb, wc = closest_in_triangle(*(b - a), *(c - a), *(low - a))
        point = a + wb * (b - a) + wc * (c - a)
        offset = point - np.array(closest_on_axis(ends[None], 0, *point))
        distance = float(np.linalg.norm(offset))
        if distance < reach and offset @ normal[triangle] < 0.0:
            energy += reach * math.log(reach / distance) - (reach - distance)
    return math.pi * radius**2 * stiffness * reach * energy


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
    total = np.zeros((len(model.support_kind), 3))
    for support in range(len(total)):
        one = slice(support, support + 1)
        alone = model._replace(
            support_kind=model.support_kind[one],
            support_position=model.support_position[one],
            support_rotation=model.support_rotation[one],
            support_size=model.support_size[one],
            support_friction=model.support_friction[one],
        )
        force, stretch = np.zeros_like(state.node_position), np.ascontiguousarray(state.support_stretch[:, one])
        add_support_forces(alone, state.node_position, state.node_velocity, force, stretch.copy(), 0.0)
        total[support] = force.sum(axis=0)
    return total
