"""The finite-strain reference of presses against closed forms: slopes, Hertz, stretching of its membrane."""

import numpy as np
import pytest

from msdm_core.material.regions import Material
from surgsim_apps.validation.finite_press import RIGID, PressedLayer, layer_mesh, neo_hookean
from surgsim_env.scene.palpable_surface import hertz_force, hidden_share


def test_the_stress_and_its_slope_are_those_of_the_energy():
    """Central differences of W = mu (I1 - 3 - 2 ln J) / 2 + lambda (J - 1)^2 / 2."""
    random = np.random.default_rng(0)
    shear, lame = 2.0, 9.0
    gradient = np.array([1.0, 0.0, 0.0, 1.0, 1.0]) + random.uniform(-0.2, 0.2, 5)

    def energy(f: np.ndarray) -> float:
        ratio = (f[0] * f[3] - f[1] * f[2]) * f[4]
        return 0.5 * shear * ((f**2).sum() - 3.0 - 2.0 * np.log(ratio)) + 0.5 * lame * (ratio - 1.0) ** 2

    def at(f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        stress, slope, _ = neo_hookean(f[:, None], np.full(1, shear), np.full(1, lame))
        return stress[:, 0], slope[..., 0]

    stress, slope = at(gradient)
    for part, step in enumerate(1e-6 * np.eye(5)):
        assert stress[part] == pytest.approx((energy(gradient + step) - energy(gradient - step)) / 2e-6, rel=1e-6)
        np.testing.assert_allclose(slope[:, part], (at(gradient + step)[0] - at(gradient - step)[0]) / 2e-6, rtol=1e-6)


def test_a_shallow_press_is_hertz():
    """Rigid ball of 20 mm, 0.4 mm deep, on 12 cm of tissue: F = 4/3 E / (1 - nu^2) sqrt(R d^3) to 3 %.

    The contact radius is 2.8 mm, elements are 0.5 mm; at that depth finite strains add about 1 %.
    """
    body = PressedLayer(layer_mesh(0.12, 0.12, 5e-4, (0.006, 0.006)), lambda r, z: np.full_like(r, 5000.0), 0.45)
    (force,) = body.forces(0.02, (4e-4,))
    assert force == pytest.approx(hertz_force(Material(5000.0, 1060.0, 0.45), 0.02, 4e-4), rel=0.03)


def test_a_softer_contact_takes_what_is_said():
    """The share of a healthy press that contact takes: the formula of the reports, half of it for Hertz

    The formula takes the pressure in the middle; the mean over a Hertz pressure (with its weight) is half of that.
    """
    body = PressedLayer(layer_mesh(0.08, 0.08, 1e-3, (0.016, 0.012)), lambda r, z: np.full_like(r, 5000.0), 0.45)
    rigid, soft = (body.forces(0.012, (0.003,), k)[0] for k in (RIGID, 2e7))
    share = hidden_share(rigid, 1.5 * rigid / 0.003, 0.012, 0.003, 2e7)
    assert 0.35 * share < 1.0 - soft / rigid < 0.65 * share


def test_a_membrane_makes_the_press_stiffer_by_little():
    """20 N/m on tissue of 5 kPa under a tip of 12 mm: 2 to 6 % more force at 3 to 7 mm."""
    mesh = layer_mesh(0.08, 0.08, 1.5e-3, (0.015, 0.012))
    plain, covered = (
        np.array(
            PressedLayer(mesh, lambda r, z: np.full_like(r, 5000.0), 0.45, membrane=size).forces(0.012, (0.003, 0.005))
        )
        for size in (0.0, 20.0)
    )
    assert ((covered / plain > 1.015) & (covered / plain < 1.06)).all()
