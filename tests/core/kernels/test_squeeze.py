"""The implicit pressure of squeezed tets: the closed form of one tet, balance, and presses at the scene's substeps."""

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from msdm_core.kernels.element_kernels import SQUEEZED_RATIO
from msdm_core.kernels.squeeze_kernels import hold_squeezed
from msdm_core.mesh.tet_mesh import tet_volumes
from tests.core.kernels.test_deep_press import SITES, organ, press

DT = 3e-4
MODULUS = 4e4
CORNERS = np.array([[0.0, 0.0, 0.0], [5e-3, 1e-3, 0.0], [0.0, 4e-3, 1e-3], [1e-3, 1e-3, 6e-3]])
TET = np.array([[0, 1, 2, 3]], dtype=np.int32)
# 1 / mass [1/kg]; corner 2 is anchored.
INVERSE_MASS = np.array([1e4, 2e4, 0.0, 1.5e4])


def gradients(corners: NDArray) -> NDArray:
    """dV/dx of a tet's corners by central differences, exact for a volume: it is linear in each coordinate [m^2]."""
    slope = np.zeros((4, 3))
    for index in np.ndindex(4, 3):
        step = np.zeros((4, 3))
        step[index] = 1e-4
        pair = [tet_volumes(corners + sign * step, TET)[0] for sign in (1.0, -1.0)]
        slope[index] = (pair[0] - pair[1]) / 2e-4
    return slope


@njit(error_model="numpy")
def hold(*given):
    """`hold_squeezed`, which has no wrapper for Python."""
    hold_squeezed(*given)


def held(ratio: float, velocity: NDArray, force: NDArray) -> NDArray:
    """Forces of `hold_squeezed` on a tet of a volume ratio [N], shape (4, 3)."""
    after = force.copy()
    inverse_volume = np.array([ratio / tet_volumes(CORNERS, TET)[0]])
    group = np.zeros(1, dtype=np.int32)
    hold(
        CORNERS, velocity, after, INVERSE_MASS, TET, inverse_volume, np.array([MODULUS]), group, 1, 8, DT
    )  # fmt: skip
    return after - force


def tension_of(ratio: float) -> float:
    return MODULUS * (ratio - SQUEEZED_RATIO) * SQUEEZED_RATIO / ratio


def steepness_of(ratio: float) -> float:
    """dp/dJ by central differences [Pa]."""
    return (tension_of(ratio + 1e-6) - tension_of(ratio - 1e-6)) / 2e-6


def added_tension(added: NDArray) -> float:
    slope = gradients(CORNERS)
    return -float((added * slope).sum() / (slope * slope).sum())


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [0.05, 0.2, 0.5, 0.59])
def test_one_tets_pressure_is_that_of_the_steps_end(ratio: float):
    """dp = dt p' dJ/dt with the velocities that it leads to itself, along dV/dx."""
    rng = np.random.default_rng(int(1000 * ratio))
    velocity, force = -2e-2 * np.sign(gradients(CORNERS)), rng.normal(0.0, 1e-4, (4, 3))
    added = held(ratio, velocity, force)
    end = velocity + DT * INVERSE_MASS[:, None] * (force + added)
    rate = float((gradients(CORNERS) * end).sum()) * ratio / tet_volumes(CORNERS, TET)[0]
    more = added_tension(added)
    assert more < 0.0
    np.testing.assert_allclose(added, -more * gradients(CORNERS), rtol=1e-9, atol=1e-12 * np.abs(added).max())
    assert more == pytest.approx(DT * steepness_of(ratio) * rate, rel=1e-6)


def test_it_moves_neither_the_centre_of_mass_nor_turns_the_body():
    added = held(0.3, -2e-2 * np.sign(gradients(CORNERS)), np.zeros((4, 3)))
    size = np.abs(added).max()
    assert np.abs(added.sum(axis=0)).max() < 1e-14 * size * 10
    assert np.abs(np.cross(CORNERS, added).sum(axis=0)).max() < 1e-14 * size * np.abs(CORNERS).max() * 10


def test_a_tet_at_rest_and_one_that_is_not_squeezed_get_nothing():
    inward = -2e-2 * np.sign(gradients(CORNERS))
    assert not held(0.3, np.zeros((4, 3)), np.zeros((4, 3))).any()
    assert not held(SQUEEZED_RATIO, inward, np.zeros((4, 3))).any()
    assert not held(float("nan"), inward, np.zeros((4, 3))).any()


def test_a_tet_that_opens_fast_loses_its_pressure_but_never_pulls():
    outward = 10.0 * np.sign(gradients(CORNERS))
    assert added_tension(held(0.3, outward, np.zeros((4, 3)))) == pytest.approx(-tension_of(0.3), rel=1e-9)


@pytest.mark.parametrize("site", SITES)
def test_presses_go_far_beyond_the_hard_limit_at_the_scenes_substeps(site: str):
    """Explicit, three substeps ended presses over a hard lesion at 1.4 to 1.8 N, four at 1.9 to 2.4 N."""
    end = press(organ(site, True), site, 0.008, 0.02)
    assert "turned inside out" in end.fault
    assert end.force[:-1].max() > 2.4


@pytest.mark.slow
def test_what_the_organ_balances_at_does_not_depend_on_the_step():
    """A press held till all is at rest, some tets squeezed: the same force with three and with nine substeps."""
    forces = []
    for substeps in (3, 9):
        end = press(organ("a node", True), "a node", 0.008, 0.010, substeps=substeps, hold=0.5)
        ratio = tet_volumes(end.state.node_position, oracle_tets()) / organ("a node", True).tet_rest_volume
        assert not end.fault and ratio.min() < 0.9 * SQUEEZED_RATIO
        forces.append(end.force[-1])
    assert forces[0] == pytest.approx(forces[1], rel=1e-3)


def oracle_tets() -> NDArray:
    return organ("a node", True).tet_nodes
