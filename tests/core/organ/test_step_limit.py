"""The stable step beside the eigenvalues of the dense stiffness, and what contact adds to it."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from msdm_core.kernels.contact_kernels import SWEEPS
from msdm_core.kernels.structure_kernels import FAULT_NONE, ContactLaw, OrganModel, OrganState
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.stability import (
    apply_stiffness,
    contact_excess,
    contact_hold,
    contact_node_area,
    stable_dt,
    step_limit,
)
from msdm_core.organ.stepping import NO_CONTACT, NO_SHAPES, advance_organ
from tests.core import oracle
from tests.core.measures import internal_forces


def run_unchecked(model: OrganModel, state: OrganState, dt: float, count: int) -> int:
    """Some steps of any length; the FAULT_ code."""
    return advance_organ(model, state, NO_SHAPES, NO_CONTACT, dt, count, np.zeros((0, 6)))


def dense_modes(model: OrganModel, held: NDArray | None = None) -> tuple[NDArray, NDArray]:
    """Eigenvalues w^2 and vectors u of M^-1 (K + diag(held)), K column by column from the linearised forces."""
    count = 3 * len(model.node_mass)
    stiffness = np.empty((count, count))
    force = np.empty((count // 3, 3))
    for column in range(count):
        apply_stiffness(model, np.eye(count)[column].reshape(-1, 3), force)
        stiffness[:, column] = force.ravel()
    stiffness += np.diag(np.repeat(np.zeros(count // 3) if held is None else held, 3))
    scale = np.repeat(np.sqrt(model.node_inverse_mass), 3)
    values, vectors = np.linalg.eigh(scale[:, None] * stiffness * scale)
    return values, scale[:, None] * vectors


ONE_TET = TetMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.3, 1]]) * 0.01, [[0, 1, 2, 3]])
SMALL_ORGANS = {
    "irregular": oracle.irregular_organ(5),
    "anchored": oracle.block(anchored_below=1e-4),
    "one tet": compile_organ(OrganSpec(ONE_TET, oracle.TISSUE, damping=oracle.UNDAMPED)),
}


def test_linearised_forces_are_the_forces_slope():
    """K u = -(f(X + h u) - f(X - h u)) / (2 h)."""
    model = SMALL_ORGANS["irregular"]
    direction = np.random.default_rng(0).uniform(-1.0, 1.0, model.node_rest_position.shape)
    linear = np.empty_like(direction)
    apply_stiffness(model, direction, linear)
    state, step = rest_state(model), 1e-7
    state.node_position[:] = model.node_rest_position + step * direction
    slope = internal_forces(model, state)
    state.node_position[:] = model.node_rest_position - step * direction
    slope = (slope - internal_forces(model, state)) / (2.0 * step)
    np.testing.assert_allclose(linear, -slope, rtol=0, atol=1e-6 * np.abs(slope).max())


@pytest.mark.parametrize("name", SMALL_ORGANS)
def test_stable_step_is_just_below_the_true_one(name: str):
    """2 / w_max of the dense eigenvalues, from below, to 1 %."""
    model = SMALL_ORGANS[name]
    true_step = 2.0 / math.sqrt(dense_modes(model)[0][-1])
    assert 0.99 * true_step <= stable_dt(model) <= true_step * (1.0 + 1e-12)


@pytest.mark.parametrize("name", SMALL_ORGANS)
@pytest.mark.parametrize(("share", "stable"), [(0.95, True), (1.1, False)])
def test_stable_below_and_unstable_above_the_true_step(name: str, share: float, stable: bool):
    """The fastest mode at 1e-9 m: z^2 - (2 - (w dt)^2) z + 1 = 0 has |z| = 1 below w dt = 2, |z| = 2.43 at 2.2."""
    model = SMALL_ORGANS[name]
    values, vectors = dense_modes(model)
    shape = vectors[:, -1].reshape(-1, 3)
    shape *= 1e-9 / np.abs(shape).max()
    state = rest_state(model)
    state.node_position[:] += shape
    assert run_unchecked(model, state, share * 2.0 / math.sqrt(values[-1]), 12) == FAULT_NONE
    growth = np.abs(state.node_position - model.node_rest_position).max() / 1e-9
    if stable:
        run_unchecked(model, state, share * 2.0 / math.sqrt(values[-1]), 5000)
        growth = np.abs(state.node_position - model.node_rest_position).max() / 1e-9
        assert growth < 10.0
    else:
        assert growth > 1e3


@pytest.mark.parametrize(
    "alpha, beta, drag", [(0.0, 0.0, 0.0), (40.0, 0.0, 0.0), (0.0, 2e-4, 0.0), (30.0, 1e-4, 500.0)]
)
def test_step_limit_is_where_the_amplification_matrix_leaves_the_unit_circle(alpha: float, beta: float, drag: float):
    """v' = e^(-alpha dt) v - dt (w^2 x + (beta w^2 + drag) v), x' = x + dt v'."""
    omega = 3000.0

    def radius(dt: float) -> float:
        gain = math.exp(-alpha * dt) - dt * (beta * omega**2 + drag)
        pull = -dt * omega**2
        return float(np.abs(np.linalg.eigvals([[1.0 + dt * pull, dt * gain], [pull, gain]])).max())

    limit = step_limit(omega, alpha, beta, drag)
    assert radius(0.999 * limit) <= 1.0 + 1e-12
    assert radius(1.001 * limit) > 1.0 + 1e-6


def test_step_limit_of_drag_alone_and_of_nothing():
    assert step_limit(0.0, 0.0, 0.0, 500.0) == pytest.approx(2.0 / 500.0)
    assert step_limit(0.0, 0.0, 0.0) == math.inf


STIFF_CONTACT = ContactLaw(stiffness=2e8, damping=0.0, friction=0.0, tangential_stiffness=1e8)
FIRM_CONTACT = STIFF_CONTACT._replace(tangential_stiffness=8e8)


def test_contact_hold_is_that_of_the_node_held_most():
    """dt max(k_p dt + c_p, k_t dt) A / m; friction's stiffness counts where there is friction."""
    model, dt = SMALL_ORGANS["anchored"], 1e-4
    area = contact_node_area(model)
    assert area.sum() == pytest.approx(model.surface_rest_area.sum(), rel=1e-12)
    most = float((area * model.node_inverse_mass).max())
    for law, held, share in (
        (STIFF_CONTACT, 2e8 * dt, 1.0),
        (STIFF_CONTACT._replace(damping=2e4), 2e8 * dt + 2e4, 0.5),
        (FIRM_CONTACT, 2e8 * dt, 1.0),
        (FIRM_CONTACT._replace(friction=0.1), 8e8 * dt, 1.0),
    ):
        assert contact_hold(model, law, dt) == pytest.approx((dt * held * most, share), rel=1e-12)


def swept(gram: NDArray, hold: NDArray) -> NDArray:
    """The X of p = X v that the sweeps reach from p = 0: each adds w (v - (1 + G) p) / (1 + h)."""
    x = np.zeros_like(gram)
    for factor in SWEEPS:
        x += factor / (1.0 + hold[:, None]) * (np.eye(len(gram)) - x - gram @ x)
    return x


@pytest.mark.parametrize("scale", [0.3, 1.0, 3.0, 6.9, 12.0, 16.0])
def test_what_the_sweeps_leave_is_bounded_for_any_points(scale: float):
    """Points with random slopes J on nodes of random masses, K J^T J dt^2 = S with the largest hold given.

    Masses M' = (M^-1 - J^T X J)^-1 (in units where K dt^2 = 1) must be symmetric, above M, and S <= 2 (M' - M), so that
    S + T <= 2 (M + M') for all T <= 4 M; that is (2 + G)^-1 <= X <= G^-1 on what the points can feel.
    """
    random = np.random.default_rng(round(10 * scale))
    for _ in range(50):
        points, nodes = random.integers(2, 40), random.integers(2, 10)
        slope = random.uniform(0.0, 1.0, (points, nodes)) * (random.uniform(size=(points, nodes)) < 0.4)
        slope[np.arange(points), random.integers(0, nodes, points)] += 0.1
        mass = random.uniform(0.3, 3.0, nodes)
        # A third of the slopes point the other way: norms count.
        norm, slope = slope, np.where(random.uniform(size=slope.shape) < 0.33, -slope, slope)
        total = norm.sum(axis=1)
        held = (norm * total[:, None]).sum(axis=0)
        size = scale / float((held / mass).max())
        hold = size * (norm / total[:, None]) @ (held / mass)
        gram = size * (slope / mass) @ slope.T
        x = swept(gram, hold)
        np.testing.assert_allclose(x, x.T, atol=1e-12)
        assert np.linalg.eigvalsh(x - np.linalg.inv(2.0 * np.eye(points) + gram)).min() > -1e-9
        root = np.real(np.linalg.cholesky(x + 1e-15 * np.eye(points)))
        assert np.linalg.eigvalsh(root.T @ gram @ root).max() < 1.0 + 1e-9


def test_contact_excess_is_where_the_amplification_matrix_leaves_the_unit_circle():
    """x' = x + v', v' = (v - (k + t) x) (1 + k R) / (1 + k), for the k up to a hold that needs the most."""

    def radius(held: float, hold: float, organ: float) -> float:
        left = math.prod(1.0 - factor * (1.0 + held) / (1.0 + hold) for factor in SWEEPS)
        gain = (1.0 + held * left) / (1.0 + held)
        pull = -gain * (held + organ)
        return float(np.abs(np.linalg.eigvals([[1.0 + pull, gain], [pull, gain]])).max())

    assert contact_excess(16.0) == contact_excess(50.0, share=0.0) == 0.0
    # Beyond, the sweeps push some velocities past zero: their mass would be negative.
    assert contact_excess(60.0) == contact_excess(60.0, share=0.0) == math.inf
    for hold in (25.0, 35.0, 45.0):
        limit = 4.0 - contact_excess(hold)
        assert 1.0 < limit < 4.0
        parts = hold * np.linspace(0.0, 1.0, 400)
        assert max(radius(held, hold, 0.999 * limit) for held in parts) <= 1.0 + 1e-9
        assert max(radius(held, hold, 1.001 * limit) for held in parts) > 1.0 + 1e-6


def test_a_wide_stiff_contact_is_stable():
    """A ball so large that it is a plate, 0.1 mm into the block's whole top, ten times as stiff as the organ.

    Up to the hold that takes nothing of the step's limit: the rise of edges makes motions from node to node twice as
    stiff, and beyond it a plate needs shorter steps than a ball.
    """
    model = SMALL_ORGANS["anchored"]
    state = rest_state(model, shape_count=1)
    dt = 0.95 * stable_dt(model, STIFF_CONTACT)
    while contact_hold(model, STIFF_CONTACT, dt)[0] > 16.0:
        dt *= 0.95
    shapes = oracle.ball((0.015, 0.01, 0.02 - 1e-4 + 1.0), 1.0)
    wrench = np.zeros((1, 6))
    assert advance_organ(model, state, shapes, STIFF_CONTACT, dt, 2000, wrench) == FAULT_NONE
    assert np.abs(state.node_velocity).max() < 1.0
