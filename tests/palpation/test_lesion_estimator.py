"""The common estimator: its posterior against brute conditioning, its lesions against made maps."""

import numpy as np
import pytest

from surgsim_env.palpation import lesion_estimator as module
from surgsim_env.palpation.lesion_estimator import LesionEstimator

EXTENT = (0.040, 0.044)
LESION_RADIUS = 0.008
NOISE = 0.03


def estimator() -> LesionEstimator:
    return LesionEstimator(EXTENT, lesion_radius=LESION_RADIUS, noise=NOISE)


def scattered(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(count)
    return rng.uniform(0.0, EXTENT, (count, 2)), rng.normal(0.1, 0.4, count)


def raster(count: int = 9) -> np.ndarray:
    return np.stack(np.meshgrid(*(np.linspace(0.0, length, count) for length in EXTENT)), axis=-1).reshape(-1, 2)


def bumps(places: np.ndarray, centres: list[tuple[float, float]], height: float = 0.7) -> np.ndarray:
    """Log contrast of lesions at centres [m]: bell curves of 6 mm."""
    squared = ((places[:, None] - np.array(centres).reshape(-1, 2)) ** 2).sum(axis=2)
    return height * np.exp(-0.5 * squared / 0.006**2).sum(axis=1)


def map_points(made: LesionEstimator) -> np.ndarray:
    return np.stack(np.meshgrid(*made.axes), axis=-1).reshape(-1, 2)


def squared_distances(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return ((first[:, None] - second) ** 2).sum(axis=2)


def test_posterior_is_that_of_the_joint_normal() -> None:
    """E[b, e | y] = C_ey C_yy^-1 y, with every covariance written out."""
    made, (places, values) = estimator(), scattered(25)

    def covariance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return module.EXCESS_SPREAD**2 * np.exp(-0.5 * squared_distances(a, b) / module.EXCESS_LENGTH**2)

    noise = NOISE**2 + module.MODEL_SPREAD**2
    solved = np.linalg.solve(covariance(places, places) + module.BACKGROUND_SPREAD**2 + noise * np.eye(25), values)
    background, excess = made.process.mean(places, values)
    assert background == pytest.approx(module.BACKGROUND_SPREAD**2 * solved.sum(), abs=1e-10)
    expected = covariance(map_points(made), places) @ solved
    np.testing.assert_allclose(excess.ravel(), expected, atol=1e-10)


@pytest.mark.parametrize(
    "centres", [[(0.020, 0.022)], [(0.010, 0.012), (0.030, 0.035)], [(0.008, 0.008), (0.032, 0.010), (0.020, 0.036)]]
)
def test_lesions_are_found_where_they_are(centres: list[tuple[float, float]]) -> None:
    """Presses 5 mm apart tell a lesion's place to a fraction of that."""
    places = raster()
    estimate = estimator().estimate(places, bumps(places, centres))
    distance = np.sqrt(squared_distances(np.array(centres), estimate.points))
    assert len(estimate.points) == len(centres)
    assert distance.min(axis=1).max() < 0.001
    assert (np.diff(estimate.strength) <= 0.0).all()


def test_stiffer_tissue_throughout_is_no_lesion() -> None:
    """log 1.3 everywhere, and as much on top of a lesion: the background takes it up."""
    places = raster()
    assert len(estimator().estimate(places, np.full(len(places), np.log(1.3))).points) == 0
    lesion = bumps(places, [(0.020, 0.022)])
    with_offset = estimator().estimate(places, lesion + np.log(1.3))
    without = estimator().estimate(places, lesion)
    np.testing.assert_allclose(with_offset.points, without.points, atol=5e-4)
    # What e takes of the offset: it averages to a spread of se / sqrt(patches) over area / (2 pi l^2) = 6 patches.
    taken = module.EXCESS_SPREAD**2 / 6.0 / (module.EXCESS_SPREAD**2 / 6.0 + module.BACKGROUND_SPREAD**2)
    assert (1.0 - taken) * np.log(1.3) < with_offset.background - without.background < np.log(1.3)


def test_no_press_no_lesion() -> None:
    estimate = estimator().estimate(np.zeros((0, 2)), np.zeros(0))
    assert estimate.points.shape == (0, 2) and estimate.strength.shape == (0,)
    assert not estimate.outline.any() and not estimate.excess.any()


def test_at_most_three_lesions() -> None:
    places = raster(15)
    centres = [(x, y) for x in (0.006, 0.034) for y in (0.006, 0.038)]
    assert len(estimator().estimate(places, bumps(places, centres)).points) == module.LESIONS_MOST


def test_outline_is_a_disc_around_the_lesion() -> None:
    """A bell curve of spread s is above a share q of its height within s sqrt(-2 log q); the map smooths it."""
    places = raster(15)
    estimate = estimator().estimate(places, bumps(places, [(0.020, 0.022)]))
    cell = (estimate.axes[0][1] - estimate.axes[0][0]) * (estimate.axes[1][1] - estimate.axes[1][0])
    radius = np.sqrt(estimate.outline.sum() * cell / np.pi)
    assert radius == pytest.approx(0.006 * np.sqrt(-2.0 * np.log(module.OUTLINE_SHARE)), rel=0.15)


def test_a_map_that_deviates_asks_for_more_excess() -> None:
    """A maximum of 0.12 is a lesion beside a map of a block, and none beside one that deviates by 0.05."""
    places = raster()
    values = bumps(places, [(0.020, 0.022)], height=0.15)
    plain = estimator().estimate(places, values)
    assert len(plain.points) == 1
    doubtful = LesionEstimator(EXTENT, lesion_radius=LESION_RADIUS, noise=NOISE, map_spread=0.05)
    assert doubtful.excess_least == pytest.approx(estimator().excess_least + module.EXCESS_LEAST_MAP * 0.05)
    assert estimator().excess_least < plain.strength[0] < doubtful.excess_least
    assert len(doubtful.estimate(places, values).points) == 0


# ---- gradients by taxels ---------------------------------------------------------------------------------------------


def feeling(noise: float = 2.0) -> LesionEstimator:
    return LesionEstimator(EXTENT, lesion_radius=LESION_RADIUS, noise=NOISE, gradient_noise=noise)


def slopes(places: np.ndarray, centres: list[tuple[float, float]], step: float = 1e-6) -> np.ndarray:
    """Gradient of `bumps` by central differences [1/m]."""
    ways = step * np.eye(2)
    return np.stack([(bumps(places + way, centres) - bumps(places - way, centres)) / (2.0 * step) for way in ways], 1)


def test_covariance_of_gradients_is_the_derivative_of_the_excess() -> None:
    """Central differences of the plain process' covariance, by the first place, the second and both."""
    process, plain = feeling().process, estimator().process
    (first, _), (second, _) = scattered(4), scattered(3)
    step = 1e-6
    ways = [step * way for way in np.eye(2)]

    def slope_of(function, places: np.ndarray, way: np.ndarray) -> np.ndarray:
        return (function(places + way) - function(places - way)) / (2.0 * step)

    rows = [lambda a, b: plain.excess_covariance(a, b)]
    rows += [lambda a, b, way=way: slope_of(lambda x: plain.excess_covariance(x, b), a, way) for way in ways]
    expected = np.block(
        [
            [row(first, second), *(slope_of(lambda x, row=row: row(first, x), second, way) for way in ways)]
            for row in rows
        ]
    )
    measured = process.excess_covariance(first, second)
    scale = np.abs(measured).max(initial=0.0)
    np.testing.assert_allclose(measured, expected, rtol=0, atol=1e-4 * scale)


def test_posterior_with_gradients_is_that_of_the_joint_normal() -> None:
    """Mean and deviation at the map's points, with the covariance of excess and gradients written out."""
    made, (places, values) = feeling(), scattered(6)
    gradients = np.random.default_rng(1).normal(0.0, 30.0, (6, 2))
    points = map_points(made)
    whole = made.process.excess_covariance(np.vstack([places, points]), np.vstack([places, points]))
    count = len(places) + len(points)
    own = np.concatenate([np.arange(6), count + np.arange(6), 2 * count + np.arange(6)])
    noise = np.diag(np.repeat([NOISE**2 + module.MODEL_SPREAD**2, made.process.gradient_variance], [6, 12]))
    noise[:6, :6] += module.BACKGROUND_SPREAD**2
    inverse = np.linalg.inv(whole[np.ix_(own, own)] + noise)
    between = whole[np.ix_(np.arange(6, count), own)]
    _, excess = made.process.mean(places, values, gradients)
    expected = between @ inverse @ np.concatenate([values, *gradients.T])
    np.testing.assert_allclose(excess.ravel(), expected, atol=1e-8)
    spread = np.sqrt(module.EXCESS_SPREAD**2 - np.einsum("ij,jk,ik->i", between, inverse, between))
    np.testing.assert_allclose(made.process.spread(places).ravel(), spread, atol=1e-8)


def test_a_press_beside_a_lesion_tells_its_direction() -> None:
    """Two presses, both on the near side: with gradients the largest excess lies beyond them, towards the lesion."""
    lesion, places = [(0.026, 0.022)], np.array([[0.018, 0.014], [0.006, 0.036]])
    made, values = feeling(), bumps(places, lesion)
    _, felt = made.process.mean(places, values, slopes(places, lesion))
    _, plain = estimator().process.mean(places, values)
    peak, blind = (map_points(made)[excess.argmax()] for excess in (felt, plain))
    assert np.linalg.norm(peak - lesion[0]) < 0.5 * np.linalg.norm(places[0] - lesion[0])
    assert np.linalg.norm(blind - places[0]) < 0.003
