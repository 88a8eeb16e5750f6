"""The stable step beside the eigenvalues of the dense stiffness, and what contact adds to it."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq

from msdm_core.kernels.structure_kernels import FAULT_NONE, ContactLaw, OrganModel, OrganState
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.measure import internal_forces
from msdm_core.organ.stability import apply_stiffness, contact_node_area, contact_node_stiffness, stable_dt, step_limit
from msdm_core.organ.stepping import NO_CONTACT, NO_SHAPES, advance_organ
from tests.core import oracle


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


def test_contact_is_counted_in_the_stable_step():
    """2 / w_max of M^-1 (K + contact), to 1 % from below; friction's stiffness counts where there is friction."""
    model = SMALL_ORGANS["anchored"]
    area = contact_node_area(model)
    assert area.sum() == pytest.approx(model.surface_rest_area.sum(), rel=1e-12)
    for law in (STIFF_CONTACT, FIRM_CONTACT, FIRM_CONTACT._replace(friction=0.1)):
        true_step = 2.0 / math.sqrt(dense_modes(model, contact_node_stiffness(model, law))[0][-1])
        assert 0.99 * true_step <= stable_dt(model, law) <= true_step * (1.0 + 1e-12)
    np.testing.assert_array_equal(
        contact_node_stiffness(model, FIRM_CONTACT), contact_node_stiffness(model, STIFF_CONTACT)
    )
    np.testing.assert_allclose(contact_node_stiffness(model, FIRM_CONTACT._replace(friction=0.1)), 8e8 * area)


def test_contact_damping_is_counted_in_the_stable_step():
    """The step where the largest eigenvalue of M^-1 ((K + contact) dt^2 + 2 c_p A dt) is 4, to 1 % from below."""
    model = SMALL_ORGANS["anchored"]
    held, area = contact_node_stiffness(model, STIFF_CONTACT), contact_node_area(model)
    for damping in (1e3, 1e4, 1e5):

        def excess(dt: float, damping: float = damping) -> float:
            return dense_modes(model, held + 2.0 * damping * area / dt)[0][-1] * dt**2 - 4.0

        true_step = brentq(excess, 1e-7, 1e-2, rtol=1e-6)
        found = stable_dt(model, STIFF_CONTACT._replace(damping=damping))
        assert 0.98 * true_step <= found <= true_step * (1.0 + 1e-5)


def test_contact_holds_no_node_harder_than_counted():
    """Patches touched along any directions e hold a node along any x with at most `contact_node_stiffness`.

    On a plane that is k_p A; on an edge and in a corner less than the areas of all faces together would give.
    """
    model, random = SMALL_ORGANS["anchored"], np.random.default_rng(0)
    law = STIFF_CONTACT._replace(friction=0.3)
    area, held = contact_node_area(model), contact_node_stiffness(model, law)
    corners = model.node_rest_position[model.surface_triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    greatest = np.zeros(len(area))
    for node in np.flatnonzero(area > 0.0):
        around = (model.surface_triangles == node).any(axis=1)
        n, third = normal[around], model.surface_rest_area[around, None] / 3.0
        for x in [*n, n.sum(axis=0), *random.normal(size=(60, 3))]:
            x = x / np.linalg.norm(x)
            # Along e somewhere between the patch's normal and x it is held hardest; others are tried as well.
            share = random.uniform(0.0, 1.0, (len(n), 40, 1))
            e = share * n[:, None] + (1.0 - share) * x + random.normal(scale=0.1, size=(len(n), 40, 3))
            e /= np.linalg.norm(e, axis=2)[:, :, None]
            pressed, along = np.maximum((e * n[:, None]).sum(axis=2), 0.0) ** 2, (e @ x) ** 2
            one = law.stiffness * pressed * along + law.tangential_stiffness * (1.0 - along)
            greatest[node] = max(greatest[node], float((third * one).max(axis=1).sum()))
    assert (greatest <= held * (1.0 + 1e-9)).all()
    free = area > 0.0
    assert (greatest[free] > 0.85 * held[free]).all()  # nor is it much too careful
    faces = np.zeros((len(area), 3), dtype=bool)
    for corner in range(3):
        np.logical_or.at(faces, model.surface_triangles[:, corner], np.abs(normal) > 0.9)
    flat = faces.sum(axis=1) == 1
    np.testing.assert_allclose(held[flat], law.stiffness * area[flat], rtol=1e-9)
    assert (held[faces.sum(axis=1) == 3] < 0.85 * law.stiffness * area[faces.sum(axis=1) == 3]).all()


@pytest.mark.parametrize(("counted", "stable"), [(True, True), (False, False)])
def test_a_wide_stiff_contact_is_stable_only_where_it_is_counted(counted: bool, stable: bool):
    """A ball so large that it is a plate, 0.1 mm into the block's whole top, ten times as stiff as the organ."""
    model = SMALL_ORGANS["anchored"]
    state = rest_state(model, shape_count=1)
    dt = 0.95 * (stable_dt(model, STIFF_CONTACT) if counted else stable_dt(model))
    shapes = oracle.ball((0.015, 0.01, 0.02 - 1e-4 + 1.0), 1.0)
    wrench = np.zeros((1, 6))
    fault = advance_organ(model, state, shapes, STIFF_CONTACT, dt, 2000, wrench)
    speed = float(np.abs(state.node_velocity).max())
    assert (fault == FAULT_NONE and speed < 1.0) == stable
