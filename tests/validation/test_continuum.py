"""The continuum of springs: linear limits, frame indifference, and a stress that is the derivative of an energy."""

import numpy as np
import pytest

from surgsim_apps.validation.continuum import (
    SpringSolid,
    determinant_and_cofactor,
    lattice_directions,
    simple_shear_stress,
    sphere_directions,
    stretch_across,
    uniaxial_stress,
)

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


@pytest.mark.parametrize("name", SOLIDS)
def test_the_tangent_is_the_derivative_of_the_stress(name):
    solid, step = SOLIDS[name], 1e-6
    tangent = solid.tangent(GRADIENT)
    for i in range(3):
        for j in range(3):
            change = np.zeros((3, 3))
            change[i, j] = step
            slope = (solid.first_piola(GRADIENT + change) - solid.first_piola(GRADIENT - change)) / (2.0 * step)
            np.testing.assert_allclose(tangent[:, :, i, j], slope, rtol=1e-5, atol=1e-4 * BULK)


def test_the_lattice_is_a_quadrature_of_degree_5():
    directions, weights = lattice_directions()
    fine, share = sphere_directions()
    for powers in [(2, 0, 0), (4, 0, 0), (2, 2, 0), (0, 0, 4)]:
        exact = share @ (fine**powers).prod(axis=1)
        assert weights @ (directions**powers).prod(axis=1) == pytest.approx(exact)
    # Of degree 6 it is not: <x^6> = 1/7 on the sphere, 2/15 + 4 (3/20) / 27 on the lattice.
    assert share @ fine[:, 0] ** 6 == pytest.approx(1.0 / 7.0)
    assert weights @ directions[:, 0] ** 6 == pytest.approx(2.0 / 15.0 + 0.6 / 27.0)


def test_a_bar_and_shear_of_small_strain():
    """E = 9 K mu / (3 K + mu) along a bar with free sides, and mu in shear."""
    solid, size = SOLIDS["springs"], 1e-6
    modulus = 9.0 * BULK * MU / (3.0 * BULK + MU)
    assert uniaxial_stress(solid, np.array([1.0 + size]))[0] == pytest.approx(modulus * size, rel=1e-4)
    assert simple_shear_stress(solid, np.array([size]))[0] == pytest.approx(MU * size, rel=1e-4)


def test_stiffening_springs_keep_poissons_ratio():
    """The sides of a bar move as those of linear tissue at every strain, and its strain is that of `Stiffening`."""
    stretch = 1.0 + np.array([-0.3, -0.1, -1e-4, 1e-4, 0.1, 0.3])
    across = stretch_across(SOLIDS["stiffening"], stretch)
    np.testing.assert_allclose(across, stretch_across(SOLIDS["springs"], stretch), rtol=1e-9)
    poisson = (3.0 * BULK - 2.0 * MU) / (2.0 * (3.0 * BULK + MU))
    assert (1.0 - across[3]) / 1e-4 == pytest.approx(poisson, rel=1e-3)


def test_volume_and_its_slope():
    volume, cofactor = determinant_and_cofactor(GRADIENT)
    assert volume == pytest.approx(np.linalg.det(GRADIENT))
    np.testing.assert_allclose(cofactor, volume * np.linalg.inv(GRADIENT).T)
