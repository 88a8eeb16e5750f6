"""The kernels' forces against a plain numpy oracle, their energies, and invariance to rigid motion."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from msdm_core.kernels.structure_kernels import KEPT_NAMES, ContactLaw, ContactShapes, OrganModel, OrganState
from msdm_core.material.regions import Damping
from msdm_core.organ.compile import rest_state
from msdm_core.organ.measure import potential_energy, volume_ratios
from msdm_core.organ.stepping import advance, advance_organ
from tests.core import oracle
from tests.core.measures import internal_forces

SEEDS = (0, 1, 2)
ELASTIC = ContactLaw(stiffness=2e7, damping=0.0, friction=0.0, tangential_stiffness=1e7)
FULL = ContactLaw(stiffness=2e7, damping=500.0, friction=0.4, tangential_stiffness=1e7)
DIFFERENCE = 1e-7  # [m]; central differences over a penetration of about 1 mm: error (h / g)^2 = 1e-8
GRADIENT_TOLERANCE = 1e-6

ANGLES = st.floats(-math.pi, math.pi)
SHIFTS = st.floats(-0.2, 0.2)


def largest(forces: NDArray) -> float:
    return float(np.abs(forces).max())


def rotation_matrix(turn: ArrayLike) -> NDArray:
    return Rotation.from_rotvec(turn).as_matrix()


def gradient(function, values: NDArray) -> NDArray:
    """Central differences of a scalar function over every entry of an array, changed in place and put back."""
    slope = np.zeros(values.shape)
    for index in np.ndindex(values.shape):
        kept = values[index]
        values[index] = kept + DIFFERENCE
        above = function()
        values[index] = kept - DIFFERENCE
        slope[index] = (above - function()) / (2.0 * DIFFERENCE)
        values[index] = kept
    return slope


def without_averages(model: OrganModel) -> OrganModel:
    """The same organ without the averaged volume term."""
    return model._replace(
        node_bulk=oracle.frozen(np.zeros_like(model.node_bulk)),
        tet_barrier_bulk=oracle.frozen(np.zeros_like(model.tet_barrier_bulk)),
        averages_volume=False,
    )


# ---- springs and volume term --------------------------------------------------------------------------------------


@pytest.mark.parametrize("beta", [0.0, 2e-3])
@pytest.mark.parametrize("seed", SEEDS)
def test_internal_forces_equal_the_oracle(seed: int, beta: float):
    model = oracle.irregular_organ(seed, damping=Damping(alpha=0.0, beta=beta))
    state = oracle.deformed_state(model, seed + 10)
    before = OrganState(*(array.copy() for array in state))
    springs = oracle.spring_forces(model, state.node_position, state.node_velocity)
    volume = oracle.volume_forces(model, state.node_position, state.node_velocity)
    by_tet = oracle.volume_forces(without_averages(model), state.node_position, state.node_velocity)
    # None drowns in another's tolerance.
    assert min(largest(by_tet), largest(volume - by_tet)) > 0.01 * largest(springs)
    assert volume_ratios(model, state).min() < 0.6  # some are squeezed
    np.testing.assert_allclose(internal_forces(model, state), springs + volume, rtol=0, atol=1e-12 * largest(springs))
    for name in KEPT_NAMES:
        np.testing.assert_array_equal(getattr(before, name), getattr(state, name))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_step_equals_the_oracle(seed: int):
    """Three symplectic Euler steps with alpha, beta, gravity and anchors."""
    model = oracle.irregular_organ(seed, damping=Damping(alpha=30.0, beta=1e-4))
    inverse = np.where(np.arange(len(model.node_mass)) % 7 == 0, 0.0, 1.0 / model.node_mass)
    model = model._replace(gravity=oracle.frozen([1.0, -2.0, -9.81]), node_inverse_mass=oracle.frozen(inverse))
    state = oracle.deformed_state(oracle.irregular_organ(seed), seed + 20)
    state.node_velocity[inverse == 0.0] = 0.0
    position, velocity = state.node_position.copy(), state.node_velocity.copy()
    dt = 1e-4
    for _ in range(3):
        position, velocity = oracle.symplectic_step(model, position, velocity, dt)
    advance(model, state, dt=dt, substep_count=3)
    np.testing.assert_allclose(state.node_velocity, velocity, rtol=0, atol=1e-12 * largest(velocity))
    np.testing.assert_allclose(state.node_position, position, rtol=0, atol=1e-12 * largest(position))


@pytest.mark.parametrize("seed", SEEDS)
def test_internal_forces_are_minus_the_gradient_of_the_energy(seed: int):
    """f = -dU/dx, U = springs + volumes of tets, averaged and squeezed - sum m g . (x - X)."""
    model = oracle.irregular_organ(seed)._replace(gravity=oracle.frozen([0.0, 3.0, -9.81]))
    state = oracle.deformed_state(oracle.irregular_organ(seed), seed)
    state.node_position[:] += 0.4 * (model.node_rest_position - state.node_position)
    assert 0.1 < volume_ratios(model, state).min() < 0.6  # squeezed, but not so much that differences fail
    weight = model.node_mass[:, None] * model.gravity
    forces = internal_forces(model, state) + weight
    slope = gradient(lambda: potential_energy(model, state), state.node_position)
    np.testing.assert_allclose(forces, -slope, rtol=0, atol=GRADIENT_TOLERANCE * largest(forces))


@pytest.mark.parametrize("beta", [0.0, 2e-3])
@pytest.mark.parametrize("seed", SEEDS)
def test_internal_forces_sum_to_zero_and_make_no_torque(seed: int, beta: float):
    """sum f = 0 and sum x cross f = 0 to rounding."""
    model = oracle.irregular_organ(seed, damping=Damping(alpha=0.0, beta=beta))
    state = oracle.deformed_state(model, seed)
    forces = internal_forces(model, state)
    scale = np.abs(forces).sum()
    torque = np.cross(state.node_position, forces).sum(axis=0)
    assert largest(forces.sum(axis=0)) <= 1e-12 * scale
    assert largest(torque) <= 1e-12 * scale * np.abs(state.node_position).max()


@settings(max_examples=30, deadline=None)
@given(st.tuples(ANGLES, ANGLES, ANGLES), st.tuples(SHIFTS, SHIFTS, SHIFTS))
def test_rigid_motions_make_no_force(turn: tuple[float, float, float], shift: tuple[float, float, float]):
    """x = R X + c leaves every length and volume: f = 0 to 1e-12 of the stiffest spring's k l0."""
    model = RIGID_ORGAN
    state = rest_state(model)
    state.node_position[:] = model.node_rest_position @ rotation_matrix(turn).T + shift
    scale = float((model.spring_stiffness * model.spring_rest_length).max())
    assert largest(internal_forces(model, state)) <= 1e-12 * scale
    np.testing.assert_allclose(volume_ratios(model, state), 1.0, rtol=0, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(st.tuples(ANGLES, ANGLES, ANGLES), st.tuples(SHIFTS, SHIFTS, SHIFTS))
def test_forces_turn_with_the_frame(turn: tuple[float, float, float], shift: tuple[float, float, float]):
    """f(R x + c, R v) = R f(x, v), damping included."""
    model = RIGID_ORGAN
    rotation = rotation_matrix(turn)
    state = oracle.deformed_state(model, 5)
    turned = rest_state(model)
    turned.node_position[:] = state.node_position @ rotation.T + shift
    turned.node_velocity[:] = state.node_velocity @ rotation.T
    forces = internal_forces(model, state)
    np.testing.assert_allclose(
        internal_forces(model, turned), forces @ rotation.T, rtol=0, atol=1e-12 * largest(forces)
    )


RIGID_ORGAN = oracle.irregular_organ(3, damping=Damping(alpha=0.0, beta=2e-3))


# ---- contact ------------------------------------------------------------------------------------------------------

TOP = 0.02  # height of the small block [m]
# Shafts and boxes stay beyond the reach of the guard, whose place on them is approximate (`guard_kernels.near_axis`).
SHAPES = {
    "ball": oracle.ball((0.014, 0.011, TOP + 0.0055), 0.007),
    "deep ball": oracle.ball((0.014, 0.011, TOP - 0.003), 0.007),
    "ball near its axis": oracle.ball((0.014, 0.011, TOP + 0.0035), 0.007),
    "capsule's side": oracle.single_tool(
        [[0.003, 0.009, TOP + 0.005], [0.027, 0.012, TOP + 0.006]], 0.006, centre=(0.01, 0.0, 0.05)
    ),
    "capsule's tip": oracle.single_tool(
        [[0.016, 0.009, TOP + 0.0025], [0.03, 0.03, TOP + 0.06]], 0.006, centre=(0.02, 0.02, 0.04)
    ),
    "ball and shaft": oracle.single_tool(
        [[[0.01, 0.01, TOP + 0.006]] * 2, [[0.012, 0.01, TOP + 0.004], [0.024, 0.012, TOP + 0.004]]],
        [0.007, 0.004],
        centre=(0.0, 0.0, 0.05),
    ),
    # Tilted about its length: points below the core, beside it and off its end.
    "rounded box": oracle.single_tool(
        [[[0.012, 0.013, TOP + 0.0045], [0.024, 0.012, TOP + 0.0048]]],
        0.005,
        span=(0.0004, 0.0051, 0.001),
        centre=(0.0, 0.0, 0.05),
    ),
}


def touched_state(model: OrganModel, name: str) -> OrganState:
    """A deformed surface under the shape; the deep ball has sunk in, its points engaged on the way."""
    shapes = SHAPES[name]
    state = oracle.deformed_state(model, 7, shape_count=len(shapes.shape_radius))
    state.node_velocity[:] = 0.0
    if name == "deep ball":
        top = (model.node_rest_position[model.surface_triangles][:, :, 2] > TOP - 2e-3).all(axis=1)
        state.contact_engaged[0] = np.repeat(top, 4)
    return state


# Shapes with many points in contact.
LONG = {"ball and shaft", "capsule's side", "rounded box"}


@pytest.mark.parametrize("name", [pytest.param(shape, marks=[pytest.mark.slow] * (shape in LONG)) for shape in SHAPES])
def test_contact_forces_are_minus_the_gradient_over_the_nodes(name: str):
    """f_i = -dE/dx_i, E = sum (k_p / 2) w A0 g^2: the turning of the normals with the corners included."""
    model = oracle.irregular_organ(4)
    state = touched_state(model, name)
    shapes = SHAPES[name]
    forces, _ = oracle.contact_forces(model, state, shapes, ELASTIC)
    position = state.node_position
    near = np.flatnonzero(np.abs(forces).sum(axis=1) > 0.0)
    assert len(near) >= 5
    slope = np.zeros_like(forces)
    for node in near:
        slope[node] = gradient(
            lambda: oracle.contact_energy(model, position, shapes, ELASTIC.stiffness, state.contact_engaged),
            position[node],
        )
    np.testing.assert_allclose(forces, -slope, rtol=0, atol=GRADIENT_TOLERANCE * largest(forces))


@pytest.mark.parametrize("name", SHAPES)
def test_contact_wrench_is_minus_the_gradient_over_the_shape(name: str):
    """F = -dE/dc over the tool's place, torque = -dE/dphi over its turning about the centre of mass."""
    model = oracle.irregular_organ(4)
    state = touched_state(model, name)
    shapes = SHAPES[name]
    _, wrench = oracle.contact_forces(model, state, shapes, ELASTIC)
    motion = np.zeros(6)
    arm = 0.01  # [m]; so that the turning moves the shape as far as the shift does

    def energy() -> float:
        moved = moved_shapes(shapes, motion[:3], motion[3:] / arm)
        return oracle.contact_energy(model, state.node_position, moved, ELASTIC.stiffness, state.contact_engaged)

    slope = gradient(energy, motion)
    slope[3:] *= arm
    force = largest(wrench[:3])
    assert force > 0.05
    np.testing.assert_allclose(wrench[:3], -slope[:3], rtol=0, atol=GRADIENT_TOLERANCE * force)
    np.testing.assert_allclose(wrench[3:], -slope[3:], rtol=0, atol=GRADIENT_TOLERANCE * force * 0.05)


def moved_shapes(shapes: ContactShapes, shift: NDArray, turn: NDArray) -> ContactShapes:
    """The tool shifted and turned about its centre of mass."""
    centre = shapes.tool_centre[0]
    axes = shapes.shape_ends.reshape(-1, 3)
    turned = (axes - centre) @ rotation_matrix(turn).T + centre + shift
    return shapes._replace(shape_ends=turned.reshape(-1, 2, 3), shape_span=shapes.shape_span @ rotation_matrix(turn).T)


@pytest.mark.parametrize("law", [ELASTIC, FULL], ids=["elastic", "with damping and friction"])
@pytest.mark.parametrize("name", SHAPES)
def test_action_equals_reaction(name: str, law: ContactLaw):
    """The nodes' forces and the tool's wrench sum to zero, and so do their torques about the tool's centre."""
    model = oracle.irregular_organ(4)
    state = touched_state(model, name)
    state.node_velocity[:] = np.random.default_rng(1).uniform(-0.1, 0.1, state.node_velocity.shape)
    state.contact_stretch[:] = np.random.default_rng(2).uniform(-1e-4, 1e-4, state.contact_stretch.shape)
    shapes = SHAPES[name]
    forces, wrench = oracle.contact_forces(model, state, shapes, law)
    torque = np.cross(state.node_position - shapes.tool_centre[0], forces).sum(axis=0)
    scale = np.abs(forces).sum()
    assert largest(forces.sum(axis=0) + wrench[:3]) <= 1e-12 * scale
    assert largest(torque + wrench[3:]) <= 1e-12 * scale * 0.1


@pytest.mark.parametrize("name", ["ball", "deep ball", "ball near its axis"])
def test_a_frictionless_ball_feels_no_torque_about_its_centre(name: str):
    """The energy does not change when a ball turns: torque = 0 to 1e-12 of force times radius."""
    model = oracle.irregular_organ(4)
    _, wrench = oracle.contact_forces(model, touched_state(model, name), SHAPES[name], ELASTIC)
    assert largest(wrench[3:]) <= 1e-12 * largest(wrench[:3]) * 0.007


@pytest.mark.parametrize("name", ["ball and shaft", "rounded box"])
@settings(max_examples=15, deadline=None)
@given(turn=st.tuples(ANGLES, ANGLES, ANGLES), shift=st.tuples(SHIFTS, SHIFTS, SHIFTS))
def test_contact_turns_with_the_frame(name: str, turn: tuple[float, float, float], shift: tuple[float, float, float]):
    """The whole scene turned and shifted, friction's memory included: forces turn, nothing else changes."""
    model = oracle.irregular_organ(4)
    shapes = SHAPES[name]._replace(tool_twist=np.array([[0.03, -0.02, 0.05, 0.4, -0.3, 0.2]]))
    rotation = rotation_matrix(turn)
    state = touched_state(model, name)
    state.node_velocity[:] = np.random.default_rng(1).uniform(-0.1, 0.1, state.node_velocity.shape)
    state.contact_stretch[:] = np.random.default_rng(2).uniform(-1e-5, 1e-5, state.contact_stretch.shape)
    turned = OrganState(*(array.copy() for array in state))
    turned.node_position[:] = state.node_position @ rotation.T + shift
    turned.node_velocity[:] = state.node_velocity @ rotation.T
    turned.contact_stretch[:] = state.contact_stretch @ rotation.T
    turned_shapes = shapes._replace(
        shape_ends=shapes.shape_ends @ rotation.T + shift,
        shape_span=shapes.shape_span @ rotation.T,
        tool_centre=shapes.tool_centre @ rotation.T + shift,
        tool_twist=(shapes.tool_twist.reshape(2, 3) @ rotation.T).reshape(1, 6),
    )
    forces, wrench = oracle.contact_forces(model, state, shapes, FULL)
    turned_forces, turned_wrench = oracle.contact_forces(model, turned, turned_shapes, FULL)
    # A penetration of 1 mm is a difference of coordinates of up to 0.3 m: 3e-16 x 300 = 1e-13, and some.
    np.testing.assert_allclose(turned_forces, forces @ rotation.T, rtol=0, atol=1e-11 * largest(forces))
    np.testing.assert_allclose(
        turned_wrench.reshape(2, 3), wrench.reshape(2, 3) @ rotation.T, rtol=0, atol=1e-11 * largest(wrench)
    )


def test_the_guard_never_throws_the_surface():
    """Taken implicitly, a guard of any stiffness moves the surface no farther than to h = 0.6 r in one substep.

    The push is at most the one whose step ends at d + s / (1 + s) d (h - d) / h < h, s = k (h / d)^2 dt^2 W. A ball of
    0.8 mm between quadrature points, which it does not touch, so that only the guard acts.
    """
    model = oracle.without_stiffness(oracle.block())
    corners = model.node_rest_position[model.surface_triangles]
    triangle = int(np.argmin(np.linalg.norm(corners.mean(axis=1) - [0.015, 0.01, TOP], axis=1)))
    foot, radius, height = corners[triangle].T @ [0.35, 0.55, 0.10], 0.0008, 0.0001
    law = ContactLaw(stiffness=1e12, damping=0.0, friction=0.0, tangential_stiffness=1.0)
    state = rest_state(model, shape_count=1)
    shapes = oracle.ball(foot + np.array([0.0, 0.0, height]), radius)
    wrench = np.zeros((1, 6))
    advance_organ(model._replace(alpha=0.0), state, shapes, law, 2.5e-4, 1, wrench)
    assert not state.contact_engaged.any() and wrench[0, 2] > 0.0
    after = state.node_position[model.surface_triangles[triangle]]
    normal = np.cross(after[1] - after[0], after[2] - after[0])
    on_axis, on_triangle = oracle.nearest_pair(shapes.shape_ends[0], after, normal / np.linalg.norm(normal))
    reach = 0.6 * radius
    assert np.linalg.norm(on_axis - on_triangle) == pytest.approx(height + height * (reach - height) / reach, rel=1e-3)
