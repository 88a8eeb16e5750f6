"""Contrast maps and estimates on synthetic sites, where the answer is known."""

import numpy as np
import pytest

from msdm_core.mesh.geodesic import SurfaceDistance
from surgsim_apps.palpate.contrast_map import (
    contrast_with_model,
    contrast_with_neighbours,
    feel_lesions,
    healthy_majority,
    score_map,
)
from surgsim_apps.palpate.truth import Truth
from surgsim_env.coupling.sensors import ForceReading
from surgsim_env.scene.model import ForceSensor

SPACING = 0.010
RADIUS = 0.015
# A flat plate of 0.2 x 0.16 m: distances along it are straight.
PLATE = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.2, 0.16, 0.0], [0.0, 0.16, 0.0]])
SURFACE = SurfaceDistance(PLATE, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))


def raster() -> np.ndarray:
    u, v = np.meshgrid(np.arange(0.02, 0.181, SPACING), np.arange(0.02, 0.141, SPACING))
    return np.column_stack([u.ravel(), v.ravel(), np.zeros(u.size)])


def stiffness_of(sites, *bumps, trend=0.7, noise=0.0, seed=0):
    """A healthy trend (quadratic, as large as the lesions) times bumps (x, y, height), with noise."""
    x, y = (sites[:, 0] - 0.1) / 0.1, (sites[:, 1] - 0.08) / 0.1
    value = 60.0 * np.exp(trend * x + 0.4 * trend * y * y)
    for bx, by, height in bumps:
        far = ((sites[:, 0] - bx) ** 2 + (sites[:, 1] - by) ** 2) / (2 * (0.6 * RADIUS) ** 2)
        value = value * (1.0 + height * np.exp(-far))
    return value * (1.0 + noise * np.random.default_rng(seed).normal(size=len(sites)))


def truth_at(x, y, name="lesion"):
    point = np.array([x, y, 0.0])
    return Truth(name, point - [0.0, 0.0, 0.02], point, np.array([0.0, 0.0, 1.0]), RADIUS)


def felt(sites, contrast):
    return feel_lesions(sites, contrast, spacing=SPACING)


@pytest.mark.parametrize("place", [(0.063, 0.081), (0.068, 0.047), (0.085, 0.104)])
@pytest.mark.parametrize("seed", range(3))
def test_one_lesion_under_a_strong_trend(place, seed):
    sites = raster()
    stiffness = stiffness_of(sites, (*place, 0.6), noise=0.02, seed=seed)
    assert np.linalg.norm(sites[np.argmax(stiffness), :2] - place) > RADIUS, "the trend is no challenge"
    estimates = felt(sites, contrast_with_neighbours(stiffness, sites[:, :2]))
    assert len(estimates) == 1
    assert np.linalg.norm(estimates[0].point[:2] - place) < 0.5 * SPACING
    assert estimates[0].contrast == pytest.approx(1.6, abs=0.15)


def test_neighbours_find_the_contrast_itself():
    sites = raster()
    contrast = contrast_with_neighbours(stiffness_of(sites, (0.08, 0.08, 0.6)), sites[:, :2])
    wanted = stiffness_of(sites, (0.08, 0.08, 0.6)) / stiffness_of(sites)
    # The trend is a factor of 4 here; the ridge keeps a few hundredths of it.
    assert np.abs(contrast - wanted).max() < 0.05


def test_what_is_known_of_the_geometry_is_taken_out():
    sites = raster()
    thickness = 0.05 + 0.03 * np.sin(sites[:, :1] * 80.0)
    stiffness = stiffness_of(sites) * np.exp(0.01 / thickness[:, 0])
    without = contrast_with_neighbours(stiffness, sites[:, :2])
    within = contrast_with_neighbours(stiffness, sites[:, :2], 1.0 / thickness)
    assert within.std() < 0.2 * without.std()


def test_model_takes_out_an_unknown_modulus_and_any_geometry():
    sites = raster()
    rng = np.random.default_rng(4)
    geometry = rng.uniform(0.3, 3.0, len(sites))
    bump = stiffness_of(sites, (0.12, 0.06, 0.5), trend=0.0) / 60.0
    contrast = contrast_with_model(60.0 * geometry * bump, 71.0 * geometry)
    np.testing.assert_allclose(contrast, bump, rtol=2e-3)


def test_order_is_by_strength_and_each_lesion_is_felt_once():
    sites = raster()
    bumps = [(0.05, 0.05, 0.35), (0.15, 0.11, 0.8), (0.10, 0.12, 0.5)]
    estimates = felt(sites, contrast_with_neighbours(stiffness_of(sites, *bumps, noise=0.01), sites[:, :2]))
    contrasts = [estimate.contrast for estimate in estimates]
    assert contrasts == sorted(contrasts, reverse=True)
    truths = [truth_at(x, y, f"{height}") for x, y, height in bumps]
    scored = score_map("m", sites, np.ones(len(sites)), estimates, truths, SURFACE, spacing=SPACING)
    assert [score.estimate for score in scored.scores] == [2, 0, 1]
    assert scored.felt_count == 3
    assert scored.false_alarms == 0
    assert max(score.error for score in scored.scores) < 0.005


def test_a_broad_lesion_is_felt_once():
    """Its shoulders are as far away as another lesion may be, and well above the threshold."""
    sites = raster()
    contrast = 1.0 + 1.5 * np.exp(-((sites[:, 0] - 0.05) ** 2 + (sites[:, 1] - 0.06) ** 2) / (2 * 0.025**2))
    assert len(felt(sites, contrast)) == 1


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03, 0.1])
@pytest.mark.parametrize("seed", range(4))
def test_no_lesion_no_estimate(noise, seed):
    sites = raster()
    stiffness = stiffness_of(sites, noise=noise, seed=seed)
    assert felt(sites, contrast_with_neighbours(stiffness, sites[:, :2])) == []
    assert felt(sites, contrast_with_model(stiffness, stiffness_of(sites))) == []


def test_score_counts_misses_false_alarms_and_the_healthy_spread():
    sites = raster()
    # Lesion at (0.05, 0.05); the map shows one 7 mm beside it and one where there is nothing.
    contrast = stiffness_of(sites, (0.057, 0.05, 0.5), (0.15, 0.11, 0.7), trend=0.0) / 60.0
    truths = [truth_at(0.05, 0.05, "A"), truth_at(0.10, 0.135, "B")]
    scored = score_map("m", sites, contrast, felt(sites, contrast), truths, SURFACE, spacing=SPACING)
    first, second = scored.scores
    assert first.felt
    assert first.error == pytest.approx(0.007, abs=0.001)
    assert not second.felt
    assert scored.felt_count == 1
    assert scored.false_alarms == 1
    distance = np.min([np.linalg.norm(sites - truth.point, axis=1) for truth in truths], axis=0)
    healthy = contrast[distance > RADIUS + 0.015]
    assert scored.healthy_std == pytest.approx(healthy.std())
    over = contrast[np.linalg.norm(sites - truths[0].point, axis=1) <= RADIUS]
    assert first.contrast == pytest.approx(over.max())


def test_lesions_keep_their_own_estimate():
    """A greedy match would give A the estimate that B needs."""
    sites = raster()
    contrast = np.ones(len(sites))
    estimates = felt(sites, stiffness_of(sites, (0.06, 0.05, 0.6), (0.10, 0.05, 0.6), trend=0.0) / 60.0)
    assert len(estimates) == 2
    scored = score_map(
        "m", sites, contrast, estimates, [truth_at(0.075, 0.05), truth_at(0.062, 0.05)], SURFACE, spacing=SPACING
    )
    assert {score.estimate for score in scored.scores} == {0, 1}


def test_healthy_majority_ignores_a_lesion_that_reaches_many_sites():
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.normal(1.0, 0.02, 60), rng.uniform(1.05, 2.0, 50)])
    centre, spread = healthy_majority(values)
    assert centre == pytest.approx(1.0, abs=0.02)
    assert 0.01 < spread < 0.05
    assert np.median(values) > 1.02


def scanned(force, normals, sensor, seed=3):
    """A scan's readings: the bias is drawn once."""
    rng, reading = np.random.default_rng(seed), ForceReading(sensor)
    reading.reset(rng)
    return reading.read_along(force, normals, rng)


def test_sensor_readings():
    normals = np.tile([0.0, 0.6, 0.8], (4000, 1))
    sensor = ForceSensor(noise=0.01, bias=0.05, range=1.0)
    force = np.full(4000, 0.5)
    reading = scanned(force, normals, sensor)
    assert (reading == scanned(force, normals, sensor)).all()
    assert reading.std() == pytest.approx(0.01, rel=0.05)
    assert 0.001 < abs(reading.mean() - 0.5) < 0.05 * 1.4  # one bias for the whole scan
    assert scanned(force + 9.0, normals, sensor).max() == 1.0
    exact = ForceSensor(noise=0.0, bias=0.0, range=1.0)
    assert (scanned(force, normals, exact) == force).all()


def test_readings_along_normals_are_those_of_the_three_axes():
    normals = np.array([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0], [0.0, -0.8, 0.6]])
    force, sensor = np.array([0.5, 0.2, 0.9]), ForceSensor(noise=0.01, bias=0.05, range=10.0)
    rng, reading = np.random.default_rng(3), ForceReading(sensor)
    reading.reset(rng)
    single = [reading.read(size * normal, rng, 0.0)[0] @ normal for size, normal in zip(force, normals, strict=True)]
    np.testing.assert_allclose(scanned(force, normals, sensor), single, rtol=1e-12)
