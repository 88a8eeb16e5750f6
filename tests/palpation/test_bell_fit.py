"""The fit of a bell to touches: compared with a plain least-squares solution, and on blocks of known contrast."""

import numpy as np
import pytest

from surgsim_env.palpation.bell_fit import BACKGROUND_SPREAD, BELL_SPREAD, BELL_WIDTH, MEAN_SPREAD, MODEL_ERROR, BellFit
from surgsim_env.palpation.chart import MAP_SIDE, TouchMap
from surgsim_env.palpation.touches import stiffest_spots

TIP, CELL, SIDE = 0.008, 0.0032, 0.030
NOISE = 0.01


def block_map() -> TouchMap:
    """A face of 30 x 30 mm: 11 x 11 sites, the outermost on its border."""
    numbers = np.arange(MAP_SIDE) - MAP_SIDE // 2
    inside = np.abs(numbers) <= 5
    return TouchMap(np.array([SIDE, SIDE]), CELL, np.outer(inside, inside).ravel())


def record(touch_map: TouchMap, contrast: np.ndarray, readings: np.ndarray, rng: np.random.Generator, noise: float):
    """Sums of products and squares of readings with noise [N] under a Hertz force of 0.1 N, (n_site,) each."""
    square = 0.1**2 * readings
    return square * contrast + 0.1 * np.sqrt(readings) * noise * rng.normal(size=len(contrast)), square


def bell(touch_map: TouchMap, middle: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * ((touch_map.sites - middle) ** 2).sum(axis=1) / (BELL_WIDTH * TIP) ** 2)


def test_it_is_the_least_squares_fit():
    """Each site's bell is one more column of a ridge regression: the best has the least sum of squares."""
    touch_map, rng = block_map(), np.random.default_rng(1)
    fit = BellFit(touch_map, TIP, NOISE)
    for _ in range(5):
        readings = touch_map.pressable * rng.integers(0, 3, MAP_SIDE**2)
        contrast = 1.0 + 0.3 * bell(touch_map, rng.uniform(0.002, 0.028, 2))
        product, square = record(touch_map, contrast, readings, rng, NOISE)
        felt = np.flatnonzero(square)
        u, v = touch_map.places[felt].T
        terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
        spread = [MEAN_SPREAD, *[BACKGROUND_SPREAD] * 5, BELL_SPREAD]
        root = np.sqrt(1.0 / (NOISE**2 / square[felt] + MODEL_ERROR**2))
        costs = {}
        for site in np.flatnonzero(touch_map.pressable):
            columns = np.column_stack([terms, bell(touch_map, touch_map.sites[site])[felt]])
            rows = np.vstack([columns * root[:, None], np.diag(1.0 / np.array(spread))])
            wanted = np.append(product[felt] / square[felt] * root, np.zeros(7))
            solved = np.linalg.lstsq(rows, wanted, rcond=None)[0]
            if solved[-1] > 0.0 and np.abs(touch_map.numbers[felt] - touch_map.numbers[site]).max(axis=1).min() <= 1:
                costs[site] = ((rows @ solved - wanted) ** 2).sum()
        fitted = fit.best(*fit.cropped(np.stack([product, square])[:, None]))
        assert fit.sites[fitted.site[0]] == min(costs, key=costs.__getitem__)
        # The parabola's top lies within half a cell of that site.
        off = 0.5 * (fitted.place[0] - touch_map.places[fit.sites[fitted.site[0]]]) * SIDE
        assert np.abs(off).max() <= 0.5 * CELL + 1e-12


def test_a_fall_towards_the_edges_does_not_hide_a_lesion():
    """Contrast falls by 0.2 at the middle of a side; a bell of half that height stands 9 mm off the middle."""
    touch_map, rng = block_map(), np.random.default_rng(2)
    fit, errors, plain = BellFit(touch_map, TIP, NOISE), [], []
    for angle in np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False):
        middle = 0.5 * SIDE + 0.009 * np.array([np.cos(angle), np.sin(angle)])
        contrast = 1.0 - 0.2 * (touch_map.places**2).sum(axis=1) + 0.1 * bell(touch_map, middle)
        product, square = record(touch_map, contrast, 2.0 * touch_map.pressable, rng, 0.003)
        u, v, _ = stiffest_spots(fit, product[None], square[None])[0]
        errors.append(np.linalg.norm(0.5 * (np.array([u, v]) + 1.0) * SIDE - middle))
        most = np.argmax(np.where(square > 0.0, product / np.maximum(square, 1e-9), 0.0))
        plain.append(np.linalg.norm(touch_map.sites[most] - middle))
    # A cell is 3.2 mm: places are between sites.
    assert np.mean(errors) < 0.5 * CELL < np.mean(plain)


def test_records_do_not_mix_and_an_empty_one_is_zero():
    touch_map, rng = block_map(), np.random.default_rng(3)
    fit = BellFit(touch_map, TIP, NOISE)
    rows = []
    for _ in range(3):
        contrast = 1.0 + 0.4 * bell(touch_map, rng.uniform(0.0, SIDE, 2))
        rows.append(record(touch_map, contrast, 1.0 * touch_map.pressable, rng, NOISE))
    rows.insert(1, (np.zeros(MAP_SIDE**2), np.zeros(MAP_SIDE**2)))
    product, square = (np.array(values) for values in zip(*rows, strict=True))
    spots = stiffest_spots(fit, product, square)
    assert not spots[1].any() and np.abs(spots[:, :2]).max() <= 1.0
    for index in range(4):
        np.testing.assert_allclose(stiffest_spots(fit, product[[index]], square[[index]])[0], spots[index], rtol=1e-9)


@pytest.mark.parametrize("force", [0.15, -0.05])
def test_one_touch_is_the_stiffest_place(force: float):
    """Also where bias makes the reading negative, so that no bell fits."""
    touch_map = block_map()
    site = MAP_SIDE**2 // 2 + 3
    square = np.zeros((1, MAP_SIDE**2))
    square[0, site] = 0.1**2
    spot = stiffest_spots(BellFit(touch_map, TIP, NOISE), square * force / 0.1, square)[0]
    np.testing.assert_allclose(spot, [*touch_map.places[site], force / 0.1], atol=1e-9)


def test_a_wide_lesion_is_fitted_with_a_wide_bell():
    """Two rows of touches of a wide bell between them: the fit that knows its width places it better."""
    touch_map, rng = block_map(), np.random.default_rng(4)
    numbers = touch_map.numbers
    in_rows = touch_map.pressable & np.isin(numbers[:, 1], (MAP_SIDE // 2 - 4, MAP_SIDE // 2 + 3))
    errors = {1.0: [], 1.8: []}
    for _ in range(30):
        middle = 0.5 * SIDE + rng.uniform(-0.005, 0.005, 2)
        spread = 1.8 * BELL_WIDTH * TIP
        contrast = 1.0 + 0.4 * np.exp(-0.5 * ((touch_map.sites - middle) ** 2).sum(axis=1) / spread**2)
        product, square = record(touch_map, contrast, 2.0 * in_rows, rng, 0.003)
        for share, listed in errors.items():
            place = stiffest_spots(BellFit(touch_map, share * TIP, NOISE), product[None], square[None])[0, :2]
            listed.append(np.linalg.norm(0.5 * (place + 1.0) * SIDE - middle))
    assert np.mean(errors[1.8]) < 0.8 * np.mean(errors[1.0]), {k: np.mean(v) for k, v in errors.items()}
