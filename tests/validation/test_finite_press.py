"""The finite-strain reference of presses against closed forms: slopes, Hertz, stretching of its membrane."""

import numpy as np
import pytest
from scipy.integrate import simpson

from msdm_core.material.regions import Material
from msdm_core.material.tissue_law import Stiffening
from surgsim_apps.validation.finite_press import RIGID, PressedLayer, layer_mesh, neo_hookean, spring_law
from surgsim_env.scene.palpable_surface import hertz_force, hidden_share

STIFFENING = Stiffening(onset_strain=0.08, cap_strain=0.25, tangent_cap=30.0)


def uniform(modulus: float):
    """Young's modulus [Pa] at all places."""
    return lambda r, z: np.full_like(r, modulus)


def neo_hookean_energy(f: np.ndarray, shear: float, lame: float) -> float:
    """W = mu (J^(-2/3) I1 - 3) / 2 + K (J - 1)^2 / 2, K = lambda + 2 mu / 3."""
    ratio = np.linalg.det(f)
    bulk = lame + 2.0 / 3.0 * shear
    return 0.5 * shear * (ratio ** (-2.0 / 3.0) * (f**2).sum() - 3.0) + 0.5 * bulk * (ratio - 1.0) ** 2


def spring_energy(f: np.ndarray, shear: float, lame: float) -> float:
    """W = E w(s), E s^2 / 2 = (15 mu / 2) <(|F N| - 1)^2> + (K_t / 2) (J - 1)^2, w by Simpson's rule over w'."""
    height, weight = np.polynomial.legendre.leggauss(24)
    turn = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    across = np.sqrt(1.0 - height**2)[:, None]
    normals = np.stack(
        [across * np.cos(turn), across * np.sin(turn), np.broadcast_to(height[:, None], (24, 48))], axis=-1
    )
    stretch = np.linalg.norm(normals @ f.T, axis=-1)
    springs = (weight / 2.0) @ ((stretch - 1.0) ** 2).mean(axis=1)
    linear = 7.5 * shear * springs + 0.5 * (lame - shear) * (np.linalg.det(f) - 1.0) ** 2
    modulus = shear * (3.0 * lame + 2.0 * shear) / (lame + shear)
    strain = np.linspace(0.0, np.sqrt(2.0 * linear / modulus), 2001)
    return float(modulus * simpson(STIFFENING.tension(strain), x=strain))


@pytest.mark.parametrize(
    ("law", "energy", "accuracy"),
    [(neo_hookean, neo_hookean_energy, 1e-6), (spring_law(STIFFENING), spring_energy, 1e-3)],
    ids=["neo-Hooke", "stiffening springs"],
)
def test_the_stress_and_its_slope_are_those_of_the_energy(law, energy, accuracy):
    """Central differences of the energy and of the stress; the springs' quadrature has degree 11."""
    random = np.random.default_rng(0)
    shear, lame = 2.0, 9.0
    gradient = np.array([1.0, 0.0, 0.0, 1.0, 1.0]) + random.uniform(-0.2, 0.2, 5)

    def work(f: np.ndarray) -> float:
        return energy(np.array([[f[0], f[1], 0.0], [f[2], f[3], 0.0], [0.0, 0.0, f[4]]]), shear, lame)

    def at(f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        stress, slope = law(f[:, None], np.full(1, shear), np.full(1, lame))
        return stress[:, 0], slope[..., 0]

    stress, slope = at(gradient)
    size = np.abs(stress).max()
    for part, step in enumerate(1e-6 * np.eye(5)):
        assert stress[part] == pytest.approx(
            (work(gradient + step) - work(gradient - step)) / 2e-6, abs=accuracy * size
        )
        rise = (at(gradient + step)[0] - at(gradient - step)[0]) / 2e-6
        np.testing.assert_allclose(slope[:, part], rise, rtol=1e-6, atol=1e-6 * np.abs(slope).max())


def test_a_shallow_press_is_hertz():
    """Rigid ball of 20 mm, 0.4 mm deep, on 12 cm of tissue: F = 4/3 E / (1 - nu^2) sqrt(R d^3) to 3 %.

    The contact radius is 2.8 mm, elements are 0.5 mm; at that depth finite strains add about 1 %.
    """
    body = PressedLayer(layer_mesh(0.12, 0.12, 5e-4, (0.006, 0.006)), uniform(5000.0), 0.45)
    (force,) = body.forces(0.02, (4e-4,))
    assert force == pytest.approx(hertz_force(Material(5000.0, 1060.0, 0.45), 0.02, 4e-4), rel=0.03)


def test_a_softer_contact_takes_what_is_said():
    """The share of a healthy press that contact takes: the formula of the reports, half of it for Hertz

    The formula takes the pressure in the middle; the mean over a Hertz pressure (with its weight) is half of that.
    """
    body = PressedLayer(layer_mesh(0.08, 0.08, 1e-3, (0.016, 0.012)), uniform(5000.0), 0.45)
    rigid, soft = (body.forces(0.012, (0.003,), k)[0] for k in (RIGID, 2e7))
    share = hidden_share(rigid, 1.5 * rigid / 0.003, 0.012, 0.003, 2e7)
    assert 0.35 * share < 1.0 - soft / rigid < 0.65 * share


def test_a_membrane_makes_the_press_stiffer_by_little():
    """20 N/m on tissue of 5 kPa under a tip of 12 mm: 2 to 6 % more force at 3 to 7 mm."""
    mesh = layer_mesh(0.08, 0.08, 1.5e-3, (0.015, 0.012))
    plain, covered = (
        np.array(PressedLayer(mesh, uniform(5000.0), 0.45, membrane=size).forces(0.012, (0.003, 0.005)))
        for size in (0.0, 20.0)
    )
    assert ((covered / plain > 1.015) & (covered / plain < 1.06)).all()


def test_springs_of_small_strain_are_the_same_solid():
    """Linear springs with nu 0.45 against neo-Hooke at a depth of 0.2 mm: equal to the order of the strain, 4 %."""
    mesh = layer_mesh(0.06, 0.03, 5e-4, (0.004, 0.004))
    laws = (neo_hookean, spring_law())
    first, second = (PressedLayer(mesh, uniform(5000.0), 0.45, law=law).forces(0.02, (2e-4,))[0] for law in laws)
    assert second == pytest.approx(first, rel=0.04)


def test_pressure_and_volumes_of_a_small_press():
    """Hertz: p = 3 F / (2 pi a^2) with a^2 = R d, and J - 1 = -2 (1 + nu) (1 - 2 nu) p / E under the middle.

    Volume lost by a force F on a wide bonded layer: F h / M with M = E (1 - nu) / ((1 + nu) (1 - 2 nu)), by reciprocity
    with a uniform pressure on its top. Strains are 5 % and elements a fifth of a.
    """
    radius, depth, height, nu, modulus = 0.02, 4e-4, 0.04, 0.45, 5000.0
    body = PressedLayer(layer_mesh(6.0 * height, height, 5e-4, (0.006, 0.006)), uniform(modulus), nu)
    (press,) = body.presses(radius, (depth,))
    assert press.pressure == pytest.approx(1.5 * press.force / (np.pi * radius * depth), rel=0.06)
    squeezed = 2.0 * (1.0 + nu) * (1.0 - 2.0 * nu) * press.pressure / modulus
    assert 1.0 - press.volume_ratio == pytest.approx(squeezed, rel=0.10)
    constrained = modulus * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu))
    assert press.volume_lost == pytest.approx(press.force * height / constrained, rel=0.05)


def test_a_small_press_on_a_dome_is_hertz():
    """Its force over that on a flat layer of the same size is sqrt(R* / R) with 1 / R* = 1 / R + 1 / R_cap."""
    forces = []
    for curvature in (np.inf, 0.1):
        mesh = layer_mesh(0.07, 0.06, 5e-4, (0.006, 0.006), curvature=curvature)
        forces += PressedLayer(mesh, uniform(5000.0), 0.45).forces(0.02, (4e-4,))
    # The contact radius is 0.05 of the thickness, which adds 5 % to both forces.
    assert forces[1] / forces[0] == pytest.approx(np.sqrt(0.1 / 0.12), rel=0.015)


def test_a_membrane_on_a_dome_bears_an_even_stretch():
    """Stretch l from the centre of its cap: dW/dl = A C (1 + nu) (l^2 - 1) l, A = 2 pi R H, C = E h / (1 - nu^2)."""
    radius, curvature, stretch, size, nu = 0.03, 0.05, 1.1, 20.0, 0.5
    mesh = layer_mesh(radius, 0.02, 1e-3, (0.01, 0.01), curvature=curvature)
    body = PressedLayer(mesh, uniform(5000.0), 0.45, membrane=size)
    place = body._basis.doflocs.copy()
    place[1] += curvature
    direction = np.where(body._up, place[1], place[0])
    force = body._skin((stretch - 1.0) * direction)[1]
    area = 2.0 * np.pi * curvature * (curvature - np.sqrt(curvature**2 - radius**2))
    expected = area * size / (1.0 - nu**2) * (1.0 + nu) * (stretch**2 - 1.0) * stretch
    # The outline has straight sides, whose error is of the second order in their size.
    assert force @ direction == pytest.approx(expected, rel=2e-3)
