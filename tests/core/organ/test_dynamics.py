"""Symplectic Euler, damping, settling and faults, against closed forms and conservation laws."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from msdm_core.errors import OrganDivergedError, OrganError
from msdm_core.kernels.structure_kernels import ContactLaw, OrganModel, OrganState
from msdm_core.material.regions import Damping, Material
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.measure import inverted_tets, kinetic_energy, potential_energy, volume_ratios
from msdm_core.organ.stepping import advance
from tests.core import oracle
from tests.core.measures import angular_momentum, internal_forces, momentum

EXACT = 1e-12
GRAVITY = 9.81


# ---- falling ------------------------------------------------------------------------------------------------------


def test_free_fall():
    """Without damping v_n = n g dt and x_n = g dt^2 n (n + 1) / 2, symplectic Euler's exact fall."""
    model = oracle.irregular_organ(0)._replace(gravity=oracle.frozen([0.0, 0.0, -GRAVITY]))
    state = rest_state(oracle.irregular_organ(0))
    dt, count = 1e-4, 1000
    advance(model, state, dt=dt, substep_count=count)
    fall = state.node_position - model.node_rest_position
    expected = -GRAVITY * dt**2 * count * (count + 1) / 2.0
    np.testing.assert_allclose(fall[:, 2], expected, rtol=EXACT)
    np.testing.assert_allclose(state.node_velocity[:, 2], -GRAVITY * dt * count, rtol=EXACT)
    np.testing.assert_allclose(fall[:, :2], 0.0, rtol=0, atol=EXACT * abs(expected))


def test_terminal_speed():
    """v' = e^(-alpha dt) v + g dt ends at g dt / (1 - e^(-alpha dt)) = (g / alpha) (1 + alpha dt / 2 + ...)."""
    model = oracle.irregular_organ(0, damping=Damping(alpha=50.0))._replace(gravity=oracle.frozen([GRAVITY, 0.0, 0.0]))
    state = rest_state(oracle.irregular_organ(0))
    dt = 2e-4
    advance(model, state, dt=dt, substep_count=5000)  # 50 decay times
    speed = momentum(model, state)[0] / model.node_mass.sum()
    assert speed == pytest.approx(GRAVITY * dt / -math.expm1(-50.0 * dt), rel=EXACT)
    assert speed == pytest.approx(GRAVITY / 50.0, rel=0.51 * 50.0 * dt)


# ---- one spring ---------------------------------------------------------------------------------------------------


SPRING_LENGTH, SPRING_STIFFNESS = 0.01, 40.0


def oscillator(damping: Damping = oracle.UNDAMPED) -> tuple[OrganModel, float]:
    """One node on one spring, the other three corners of a tet held; its angular frequency sqrt(k / m) [rad/s]."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * SPRING_LENGTH
    organ = compile_organ(
        OrganSpec(TetMesh(corners, [[0, 1, 2, 3]]), oracle.TISSUE, anchors=[0, 2, 3], damping=damping)
    )
    model = organ._replace(
        spring_nodes=oracle.frozen([[0, 1]], np.int32),
        spring_stiffness=oracle.frozen([SPRING_STIFFNESS]),
        spring_rest_length=oracle.frozen([SPRING_LENGTH]),
        tet_bulk=oracle.frozen([0.0]),
        node_bulk=oracle.frozen([0.0] * 4),
        averages_volume=False,
        stable_step=1.0,
    )
    return model, math.sqrt(SPRING_STIFFNESS / float(model.node_mass[1]))


def oscillation(model: OrganModel, dt: float, count: int) -> NDArray:
    """The free node's offset along the spring at each step, from an offset of 1 mm [m], shape (count + 1,)."""
    state = rest_state(model)
    state.node_position[1, 0] += 1e-3
    offsets = [1e-3]
    for _ in range(count):
        advance(model, state, dt=dt)
        offsets.append(float(state.node_position[1, 0]) - SPRING_LENGTH)
    return np.array(offsets)


def measured_frequency(offset: NDArray, dt: float) -> float:
    """w of the undamped difference equation x_(n+1) + x_(n-1) = 2 cos(w dt) x_n, by least squares [rad/s]."""
    middle = offset[1:-1]
    return math.acos(float((offset[2:] + offset[:-2]) @ middle / (middle @ middle)) / 2.0) / dt


def test_oscillators_period_is_right_to_second_order():
    """Symplectic Euler: cos(w' dt) = 1 - (w dt)^2 / 2, so w' = w (1 + (w dt)^2 / 24 + ...)."""
    model, omega = oscillator()
    errors = []
    for steps in (40, 80, 160):  # per period
        dt = 2.0 * math.pi / omega / steps
        frequency = measured_frequency(oscillation(model, dt, 4 * steps), dt)
        assert frequency == pytest.approx(math.acos(1.0 - 0.5 * (omega * dt) ** 2) / dt, rel=1e-9)
        errors.append(frequency / omega - 1.0)
        assert errors[-1] == pytest.approx((omega * dt) ** 2 / 24.0, rel=0.01)
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 2.0, rtol=0, atol=0.02)


def decay_rate(offset: NDArray, dt: float) -> float:
    """Rate of the exponential through the extremes of an oscillation [1/s]; each a parabola through three samples."""
    size = np.abs(offset)
    peak = np.flatnonzero((size[1:-1] > size[:-2]) & (size[1:-1] >= size[2:])) + 1
    before, here, after = size[peak - 1], size[peak], size[peak + 1]
    height = here + (after - before) ** 2 / (8.0 * (2.0 * here - before - after))
    return -float(np.polyfit(peak * dt, np.log(height), 1)[0])


def test_alpha_damps_the_amplitude():
    """Amplitude exp(-alpha t / 2) below critical damping, within 1 %."""
    alpha = 5.0
    model, omega = oscillator(Damping(alpha=alpha))
    assert alpha < 0.1 * omega
    dt = 0.05 / omega
    assert decay_rate(oscillation(model, dt, 3000), dt) == pytest.approx(alpha / 2.0, rel=0.01)


def test_beta_damps_with_half_beta_omega():
    """Ratio zeta = beta w / 2: amplitude exp(-zeta w t), within 1 %."""
    _, omega = oscillator()
    beta = 0.04 / omega  # zeta = 0.02
    model, _ = oscillator(Damping(alpha=0.0, beta=beta))
    dt = 0.02 / omega
    assert decay_rate(oscillation(model, dt, 5000), dt) == pytest.approx(beta * omega**2 / 2.0, rel=0.01)


# ---- conservation -------------------------------------------------------------------------------------------------


def thrown_organ(seed: int) -> tuple[OrganModel, OrganState]:
    """A free organ, deformed by about a tenth of a millimetre, flying and spinning."""
    model = oracle.irregular_organ(seed)
    random = np.random.default_rng(seed)
    state = rest_state(model)
    state.node_position[:] += random.uniform(-1e-4, 1e-4, state.node_position.shape)
    state.node_velocity[:] = np.array([0.1, -0.2, 0.15]) + np.cross([3.0, -2.0, 4.0], state.node_position)
    return model, state


@pytest.mark.parametrize("beta", [0.0, 1e-4])
def test_free_motion_conserves_both_momenta(beta: float):
    """p and L about a fixed point stay to rounding with alpha = 0: beta's damping is internal."""
    model, state = thrown_organ(1)
    model = model._replace(beta=beta)
    point = (0.2, -0.1, 0.3)
    linear, angular = momentum(model, state), angular_momentum(model, state, point)
    advance(model, state, dt=0.5 * model.stable_step, substep_count=2000)
    scale = float(model.node_mass @ np.linalg.norm(state.node_velocity, axis=1))
    np.testing.assert_allclose(momentum(model, state), linear, rtol=0, atol=EXACT * scale)
    np.testing.assert_allclose(angular_momentum(model, state, point), angular, rtol=0, atol=EXACT * scale * 0.5)


def test_alpha_takes_momentum_at_its_rate():
    """p(t) = p(0) exp(-alpha t), exactly: the decay factor is the exponential."""
    model, state = thrown_organ(1)
    model = model._replace(alpha=20.0)
    linear = momentum(model, state)
    advance(model, state, dt=1e-4, substep_count=500)
    np.testing.assert_allclose(momentum(model, state), linear * math.exp(-20.0 * 0.05), rtol=1e-11)


def test_energy_stays_without_drift():
    """Undamped, at half the stable step: a symplectic integrator's energy wavers by O(w dt), and does not drift."""
    model, state = thrown_organ(2)
    state.node_velocity[:] = 0.0
    energies = []
    for _ in range(6000):
        advance(model, state, dt=0.5 * model.stable_step)
        energies.append(kinetic_energy(model, state) + potential_energy(model, state))
    energy = np.array(energies)
    # w dt = 1 for the fastest mode at half the stable step; its modified energy is off by w dt / 2 at most.
    assert np.abs(energy / energy.mean() - 1.0).max() < 0.5
    tenths = energy.reshape(10, -1).mean(axis=1)
    assert np.abs(tenths / tenths.mean() - 1.0).max() < 0.01


# ---- settling -----------------------------------------------------------------------------------------------------


def column_shortening(cells_across: int) -> float:
    """Settlement of a bonded 15 x 15 x 60 mm column under its weight, over rho g L^2 / (2 E)."""
    length, modulus, density = 0.06, 1e5, 1000.0
    model = oracle.block(
        (0.015, 0.015, length),
        (cells_across, cells_across, 4 * cells_across),
        material=Material(modulus, density),
        anchored_below=1e-6,
        gravity=(0.0, 0.0, -GRAVITY),
    )
    state = rest_state(model)
    free = model.node_inverse_mass > 0.0
    residual = internal_forces(model, state) + model.node_mass[:, None] * model.gravity
    weight = GRAVITY * float(model.node_mass.sum())
    assert np.linalg.norm(residual[free], axis=1).sum() <= 1.1e-6 * weight  # the settling's own tolerance, and rounding
    np.testing.assert_array_equal(state.node_velocity, 0.0)
    np.testing.assert_array_equal(state.node_position[~free], model.node_rest_position[~free])
    top = model.node_rest_position[:, 2] > length - 1e-9
    sunk = float((model.node_rest_position - state.node_position)[top, 2].mean())
    return sunk / (density * GRAVITY * length**2 / (2.0 * modulus))


def test_a_column_settles_under_its_weight():
    """u = rho g L^2 / (2 E), from below: formula (6) makes the outer layer of a lattice too stiff.

    The error is that of a layer as thick as a cell, so it falls about as cell / width: 14 % with cells of a third of
    the width, 3/5 to 3/4 of that with cells of a fifth (bonding the foot adds 1 % of its own).
    """
    coarse, fine = 1.0 - column_shortening(3), 1.0 - column_shortening(5)
    assert 0.0 < fine < coarse < 0.16
    assert 0.55 < fine / coarse < 0.75


def test_gravity_without_anchors_does_not_settle():
    model = oracle.block(gravity=(0.0, 0.0, -GRAVITY))
    with pytest.raises(OrganDivergedError, match=r"did not settle under gravity .* is it anchored"):
        rest_state(model)


# ---- repetition and faults ----------------------------------------------------------------------------------------


def pressed_run(model: OrganModel) -> OrganState:
    """200 haptic steps of a ball that comes in slantwise, with friction and damping."""
    law = ContactLaw(stiffness=2e7, damping=200.0, friction=0.3, tangential_stiffness=1e7)
    state = rest_state(model, shape_count=1)
    shapes = oracle.ball((0.012, 0.01, 0.0262), 0.006, velocity=(0.01, 0.0, -0.02))
    for _ in range(200):
        advance(model, state, dt=1e-4, substep_count=3, shapes=shapes, contact=law)
    return state


def test_a_run_repeats_to_the_bit():
    """Also with another organ run in between."""
    model = oracle.block(anchored_below=1e-4, damping=Damping(alpha=20.0, beta=1e-4))
    first = pressed_run(model)
    pressed_run(oracle.block(anchored_below=1e-4, material=Material(9000.0, 900.0, 0.3)))
    second = pressed_run(oracle.block(anchored_below=1e-4, damping=Damping(alpha=20.0, beta=1e-4)))
    assert first.contact_engaged.any() and np.abs(first.contact_stretch).max() > 0.0
    for name, before, after in zip(first._fields, first, second):
        assert before.tobytes() == after.tobytes(), name


def test_an_inverted_tet_is_named():
    model = oracle.block()
    state = rest_state(model)
    tet = 7
    a, b, c, d = state.node_position[model.tet_nodes[tet]]
    normal = np.cross(b - a, c - a)
    state.node_position[model.tet_nodes[tet, 3]] -= 1.5 * ((d - a) @ normal) / (normal @ normal) * normal
    ratios = volume_ratios(model, state)
    assert ratios[tet] == pytest.approx(-0.5, rel=1e-9)
    assert tet in inverted_tets(model, state)
    worst = int(np.argmin(ratios))
    match = rf"tet {worst} turned inside out: volume ratio {ratios[worst]:.3g}, it must stay above 0: press less deep"
    with pytest.raises(OrganDivergedError, match=match):
        advance(model, state, dt=1e-5)


@pytest.mark.parametrize("field", ["node_velocity", "node_position"])
def test_a_number_that_is_not_finite_is_named(field: str):
    model = oracle.irregular_organ(5)
    state = rest_state(model)
    node = 11
    getattr(state, field)[node, 1] = math.nan
    first = node
    if field == "node_position":  # springs and averaged volumes spread it to the neighbours and theirs in the step
        around = np.unique(model.tet_nodes[(model.tet_nodes == node).any(axis=1)])
        first = int(model.tet_nodes[np.isin(model.tet_nodes, around).any(axis=1)].min())
    with pytest.raises(OrganDivergedError, match=rf"node {first} is no longer finite"):
        advance(model, state, dt=1e-5)


@pytest.mark.parametrize("factor", [1.001, 0.0, math.nan])
def test_a_step_that_is_not_stable_is_refused(factor: float):
    model = oracle.irregular_organ(5)
    state = rest_state(model)
    with pytest.raises(OrganError, match="stable step"):
        advance(model, state, dt=factor * model.stable_step)
    np.testing.assert_array_equal(state.node_position, model.node_rest_position)


@pytest.mark.parametrize(
    ("fields", "named"), [({"alpha": -1.0}, "alpha is -1"), ({"alpha": 1.0, "beta": math.nan}, "beta is nan")]
)
def test_bad_damping_is_refused(fields: dict[str, float], named: str):
    with pytest.raises(OrganError, match=named):
        Damping(**fields)
