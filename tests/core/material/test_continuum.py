"""Solids at finite strain: linear limits, frame indifference, and a stress that is the derivative of an energy."""

import numpy as np
import pytest

from msdm_core.material.continuum import (
    Demiray,
    Ogden,
    SpringSolid,
    bulk_modulus,
    determinant_and_cofactor,
    fit_springs,
    lattice_directions,
    simple_shear_stress,
    sphere_directions,
    uniaxial_stress,
)
from msdm_core.material.tissue_law import Stiffening

MU, BULK = 2000.0, 9000.0


class Cubic:
    """A law with a quadratic rise of the slope, phi = e + 40 e^3."""

    def tension(self, strain):
        return strain + 40.0 * strain**3

    def tangent(self, strain):
        return 1.0 + 120.0 * strain**2


SOLIDS = {
    "springs": SpringSolid(MU, BULK - 5.0 / 3.0 * MU),
    "stiffening": SpringSolid(MU, BULK - 5.0 / 3.0 * MU, Cubic()),
    "lattice": SpringSolid(MU, BULK - 5.0 / 3.0 * MU, Cubic(), lattice_directions()),
    "Demiray": Demiray(MU, 5.0, BULK),
    "neo-Hookean": Demiray(MU, 0.0, BULK),
    "Ogden": Ogden(MU, 8.0, BULK),
}
GRADIENT = np.array([[1.2, 0.3, -0.1], [0.05, 0.9, 0.2], [-0.15, 0.1, 1.1]])


@pytest.mark.parametrize("name", SOLIDS)
def test_small_strains_are_those_of_a_linear_solid(name):
    size = 1e-6
    strain = np.array([[1.0, 0.4, -0.2], [0.4, -0.5, 0.3], [-0.2, 0.3, 0.7]])
    stress = SOLIDS[name].first_piola(np.eye(3) + size * strain) / size
    # 2 mu dev(e) + K tr(e) I, to the order of the strain.
    expected = 2.0 * MU * (strain - np.trace(strain) / 3.0 * np.eye(3)) + BULK * np.trace(strain) * np.eye(3)
    np.testing.assert_allclose(stress, expected, atol=1e-4 * BULK)


@pytest.mark.parametrize("name", SOLIDS)
def test_a_rotation_turns_the_stress_with_it(name):
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    solid = SOLIDS[name]
    np.testing.assert_allclose(solid.first_piola(turn @ GRADIENT), turn @ solid.first_piola(GRADIENT), atol=1e-9 * BULK)


@pytest.mark.parametrize("name", [name for name in SOLIDS if name != "lattice"])
def test_no_direction_of_the_material_is_special(name):
    angle = 0.4
    turn = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(angle), -np.sin(angle)], [0.0, np.sin(angle), np.cos(angle)]])
    solid = SOLIDS[name]
    # The quadrature over directions is exact for polynomials of degree 23; of the root |F N| the rest counts too.
    expected = solid.first_piola(GRADIENT) @ turn
    assert np.abs(solid.first_piola(GRADIENT @ turn) - expected).max() < 1e-5 * np.abs(expected).max()


def test_the_lattice_has_special_directions():
    angle = 0.4
    turn = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(angle), -np.sin(angle)], [0.0, np.sin(angle), np.cos(angle)]])
    expected = SOLIDS["lattice"].first_piola(GRADIENT) @ turn
    assert np.abs(SOLIDS["lattice"].first_piola(GRADIENT @ turn) - expected).max() > 0.01 * np.abs(expected).max()


@pytest.mark.parametrize("name", SOLIDS)
def test_no_work_is_done_on_a_closed_path(name):
    """The stress derives from an energy: work around a loop of deformations vanishes, with the square of the steps."""
    turns = np.linspace(0.0, 2.0 * np.pi, 401)
    first, second = np.zeros((3, 3)), np.zeros((3, 3))
    first[0, 1], second[1, 1] = 0.2, 0.15
    path = GRADIENT + np.cos(turns)[:, None, None] * first + np.sin(turns)[:, None, None] * second
    stress = SOLIDS[name].first_piola(path)
    steps = np.diff(path, axis=0)
    work = (0.5 * (stress[1:] + stress[:-1]) * steps).sum()
    done = np.abs(0.5 * (stress[1:] + stress[:-1]) * steps).sum()
    assert abs(work) < 1e-4 * done


@pytest.mark.parametrize("name", ["springs", "stiffening", "lattice"])
def test_the_tangent_is_the_derivative_of_the_stress(name):
    solid, step = SOLIDS[name], 1e-6
    found = solid.tangent(GRADIENT)
    for i in range(3):
        for j in range(3):
            change = np.zeros((3, 3))
            change[i, j] = step
            slope = (solid.first_piola(GRADIENT + change) - solid.first_piola(GRADIENT - change)) / (2.0 * step)
            np.testing.assert_allclose(found[:, :, i, j], slope, rtol=1e-5, atol=1e-4 * BULK)


def test_the_lattice_is_a_quadrature_of_degree_5():
    directions, weights = lattice_directions()
    fine, share = sphere_directions()
    for powers in [(2, 0, 0), (4, 0, 0), (2, 2, 0), (0, 0, 4)]:
        exact = share @ (fine**powers).prod(axis=1)
        assert weights @ (directions**powers).prod(axis=1) == pytest.approx(exact)
    # Of degree 6 it is not: <x^6> = 1/7 on the sphere, 2/15 + 4 (3/20) / 27 on the lattice.
    assert share @ fine[:, 0] ** 6 == pytest.approx(1.0 / 7.0)
    assert weights @ directions[:, 0] ** 6 == pytest.approx(2.0 / 15.0 + 0.6 / 27.0)


def test_a_neo_hookean_bar_and_shear():
    """Nearly incompressible: P = mu (l - l^-2), and P_12 = mu g."""
    solid = Demiray(MU, 0.0, 1e5 * MU)
    stretch = np.array([0.6, 0.9, 1.1, 1.5])
    np.testing.assert_allclose(uniaxial_stress(solid, stretch), MU * (stretch - stretch**-2.0), rtol=1e-4)
    amount = np.array([0.1, 0.4])
    np.testing.assert_allclose(simple_shear_stress(solid, amount), MU * amount, rtol=1e-12)


def test_fungs_and_ogdens_bars():
    """Incompressible: P = mu e^(b (I1 - 3)) (l - l^-2), and P = (2 mu / a) (l^(a-1) - l^(-a/2-1))."""
    stretch = np.array([0.7, 0.95, 1.2])
    first = stretch**2 + 2.0 / stretch
    expected = MU * np.exp(3.0 * (first - 3.0)) * (stretch - stretch**-2.0)
    np.testing.assert_allclose(uniaxial_stress(Demiray(MU, 3.0, 1e5 * MU), stretch), expected, rtol=1e-4)
    expected = 2.0 * MU / 9.0 * (stretch**8.0 - stretch**-5.5)
    np.testing.assert_allclose(uniaxial_stress(Ogden(MU, 9.0, 1e5 * MU), stretch), expected, rtol=1e-4)


def test_volume_and_its_slope():
    volume, cofactor = determinant_and_cofactor(GRADIENT)
    assert volume == pytest.approx(np.linalg.det(GRADIENT))
    np.testing.assert_allclose(cofactor, volume * np.linalg.inv(GRADIENT).T)


def test_a_fit_finds_the_springs_that_the_stress_is_of():
    law = Stiffening(0.05, 0.25, 8.0)
    solid = SpringSolid(MU, MU * (4.0 * 0.45 - 1.0) / 0.1, law)
    found = fit_springs(solid, strain=0.4)
    assert found.youngs_modulus == pytest.approx(2.9 * MU, rel=1e-3)
    assert found.stiffening.tangent_cap == pytest.approx(8.0, rel=0.01)
    assert found.stiffening.onset_strain == pytest.approx(0.05, abs=1e-3)
    assert found.stiffening.cap_strain == pytest.approx(0.25, abs=1e-3)
    assert max(found.tension_error, found.compression_error, found.shear_error) < 1e-3


def test_springs_fitted_to_fungs_solid_stiffen_with_its_exponent():
    """How far springs alike in tension and compression can follow it: compression is where they are furthest."""
    found = [fit_springs(Demiray(MU, b, bulk_modulus(MU, 0.45)), strain=0.2) for b in (3.0, 10.0)]
    assert all(one.youngs_modulus == pytest.approx(2.9 * MU, rel=0.05) for one in found)
    stresses = [uniaxial_stress(SpringSolid(MU, 8.0 * MU, one.stiffening), np.array([1.2]))[0] for one in found]
    assert stresses[1] > 1.2 * stresses[0]
    for one in found:
        assert one.shear_error < one.tension_error < one.compression_error < 0.5
