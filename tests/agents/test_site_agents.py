"""The baselines of SurgSim/PalpateSites-v0, on maps made of bell curves: what they press, and that they find."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from surgsim_apps.scoring.site_search import AGENTS, BOUNDS, GpEi, GpEvr, GpThompson, OracleNear
from surgsim_apps.training.site_agent import OBSERVATION_SIZE, SLICES, SiteFacts, SiteProcess
from surgsim_env.palpation.chart import MAP_SIDE, TouchMap
from surgsim_env.palpation.lesion_estimator import LesionEstimator

pytestmark = pytest.mark.agents
# Under a tip of 8 mm: 11 x 11 sites of the map, 4 mm apart.
FACE = np.pad(np.ones((11, 11), dtype=bool), (MAP_SIDE - 11) // 2)
FACTS = SiteFacts(
    TouchMap(np.array([0.04, 0.04]), 0.004, FACE.ravel()),
    tip_radius=0.008,
    lesion_radius=0.008,
    noise=0.05,
    excess_least=0.1,
)
NAMES = [name for name in AGENTS if name not in BOUNDS]


class Chart:
    """An environment without physics: log contrast is a bell curve of 7 mm at each centre [m]."""

    def __init__(self, centres: list[tuple[float, float]], noise: float = 0.0, seed: int = 0) -> None:
        self.centres, self.noise, self.rng = np.array(centres).reshape(-1, 2), noise, np.random.default_rng(seed)
        self.places: list[np.ndarray] = []
        self.values: list[float] = []

    def observation(self) -> np.ndarray:
        seen = np.zeros(OBSERVATION_SIZE, dtype=np.float32)
        for place, value in zip(self.places, self.values, strict=True):
            site = FACTS.map.nearest(2.0 * place / FACTS.extent - 1.0)
            seen[SLICES["contrast_map"]][site], seen[SLICES["pressed_map"]][site] = value, 1.0
        seen[SLICES["presses_left"]] = 1.0 - len(self.places) / FACTS.budget
        return seen

    def press(self, action: np.ndarray) -> None:
        assert action.shape == (2,) and action.dtype == np.float32 and (np.abs(action) <= 1.0).all()
        place = 0.5 * (action.astype(np.float64) + 1.0) * FACTS.extent
        squared = ((self.centres - place) ** 2).sum(axis=1)
        self.places.append(place)
        self.values.append(0.4 * np.exp(-0.5 * squared / 0.007**2).sum() + self.noise * self.rng.normal())


def played(name: str, chart: Chart, presses: int = 25, seed: int = 0) -> np.ndarray:
    agent = AGENTS[name]()
    agent.reset(np.random.default_rng(seed), FACTS)
    for _ in range(presses):
        chart.press(agent.act(chart.observation()))
    return np.array(chart.places)


@pytest.mark.parametrize("name", NAMES)
def test_every_agent_presses_its_budget(name: str) -> None:
    places = played(name, Chart([(0.012, 0.030)]))
    assert len(np.unique(places.round(6), axis=0)) >= min(25, {"raster_2": 13}.get(name, 25))
    again = played(name, Chart([(0.012, 0.030)]))
    np.testing.assert_array_equal(places, again)


@pytest.mark.parametrize("name", NAMES)
def test_every_agent_finds_one_lesion(name: str) -> None:
    """On a map without noise the common estimator says where the lesion is to 3 mm, and that it is one."""
    chart = Chart([(0.0125, 0.0285)])
    # A raster that is not done has left out a part of the chart.
    played(name, chart, presses=max(25, int(name[-1]) ** 2 if name.startswith("raster") else 0))
    estimator = LesionEstimator(FACTS.extent, lesion_radius=FACTS.lesion_radius, noise=FACTS.noise)
    estimate = estimator.estimate(np.array(chart.places), np.array(chart.values)).points
    assert estimate.shape == (1, 2)
    assert np.linalg.norm(estimate[0] - chart.centres[0]) < 0.003


def test_a_raster_presses_the_middles_of_its_fields() -> None:
    places = played("raster_3", Chart([]), presses=9)
    middles = (np.arange(3) + 0.5) / 3 * 0.04
    expected = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(places[np.lexsort(places.T)], expected[np.lexsort(expected.T)], atol=1e-8)
    # There and back: no way is longer than a field.
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() == pytest.approx(0.04 / 3, abs=1e-8)


@pytest.mark.parametrize(("name", "inner", "outer"), [("gp_ucb", 0.0, 0.009), ("gp_level_set", 0.005, 0.012)])
def test_what_is_felt_draws_presses(name: str, inner: float, outer: float) -> None:
    """GP-UCB presses on a lesion, the level set around it; what only fills the chart presses there less."""
    centre = np.array([0.027, 0.013])

    def between(name: str) -> int:
        distance = np.linalg.norm(played(name, Chart([tuple(centre)], noise=0.05)) - centre, axis=1)
        return int(((distance > inner) & (distance < outer)).sum())

    assert between(name) >= between("gp_evr") + 2


def pressed_chart(count: int) -> Chart:
    """A chart with presses at random places, on the sites of the map."""
    chart, places = Chart([(0.027, 0.013)], noise=0.05), np.random.default_rng(7).permutation(FACTS.sites[FACE.ravel()])
    for place in places[:count]:
        chart.press(FACTS.action(place))
    return chart


def test_variance_reduction_leaves_the_least_variance() -> None:
    """Against the sum of the process' own variances after each possible press."""
    process = SiteProcess(FACTS)
    for count in (0, 1, 8):
        observation = pressed_chart(count).observation()
        agent = GpEvr()
        agent.reset(np.random.default_rng(0), FACTS)
        chosen = int(FACTS.map.nearest(agent.act(observation)))
        places, pressed = FACTS.sites[process.touches(observation)[0]], observation[SLICES["pressed_map"]] > 0.5

        def variance(places: np.ndarray) -> float:
            return np.square(process.process.spread(places).ravel()[process.candidates]).sum()

        fresh = np.flatnonzero(process.candidates & ~pressed)
        left = {int(site): variance(np.vstack([places, FACTS.sites[site]])) for site in fresh}
        assert left[chosen] == pytest.approx(min(left.values()), rel=1e-9)
        assert variance(places) - agent.worth(observation)[chosen] == pytest.approx(left[chosen], rel=1e-9)


def test_expected_improvement_is_the_mean_of_the_improvements() -> None:
    """Over draws of the normal distribution at each site."""
    observation, agent = pressed_chart(8).observation(), GpEi()
    agent.reset(np.random.default_rng(0), FACTS)
    belief = agent.process.belief(observation)
    draws = belief.excess + belief.spread * np.random.default_rng(1).normal(size=(20_000, len(belief.excess)))
    gains = np.maximum(draws - belief.excess[agent.process.candidates].max(), 0.0)
    np.testing.assert_allclose(agent.worth(observation), gains.mean(axis=0), atol=5.0 * gains.std() / np.sqrt(20_000))


@pytest.mark.parametrize("gradient_noise", [0.0, 5.0])
def test_samples_have_the_mean_and_the_spread_of_the_posterior(gradient_noise: float) -> None:
    observation, agent = pressed_chart(8).observation(), GpThompson()
    if gradient_noise:
        observation = np.append(observation, np.zeros(2 * len(FACTS.sites) + 1, dtype=np.float32))
    agent.reset(np.random.default_rng(0), replace(FACTS, gradient_noise=gradient_noise))
    belief, inside = agent.process.belief(observation), agent.process.candidates
    samples = np.array([agent.worth(observation)[inside] for _ in range(1000)])
    spread = belief.spread[inside]
    assert (np.abs(samples.mean(axis=0) - belief.excess[inside]) < 5.0 * spread / np.sqrt(1000)).all()
    # The deviation of a deviation from n normal draws is sigma / sqrt(2 n).
    np.testing.assert_allclose(samples.std(axis=0), spread, rtol=5.0 / np.sqrt(2000))


def test_variance_reduction_fills_the_chart() -> None:
    """No candidate is farther from a press than one correlation length after 25 presses."""
    places = played("gp_evr", Chart([(0.027, 0.013)]))
    gaps = np.linalg.norm(FACTS.sites[FACTS.map.pressable][:, None] - places, axis=2).min(axis=1)
    assert gaps.max() < 0.010


def test_the_near_oracle_presses_lesions_first() -> None:
    agent = OracleNear()
    agent.reset(np.random.default_rng(0), FACTS)
    truth = np.array([[0.010, 0.020, 0.0], [0.030, 0.030, 0.0]])
    chart = SimpleNamespace(extent=np.array(FACTS.extent), place=lambda point: point[:2] / 0.02 - 1.0)
    agent.see(SimpleNamespace(truth=truth, charted=SimpleNamespace(chart=chart)))
    pressed = Chart([])
    for _ in range(9):
        pressed.press(agent.act(pressed.observation()))
    places = np.array(pressed.places)
    np.testing.assert_allclose(places[:2], truth[:, :2], atol=1e-8)
    away = np.linalg.norm(places[2:, None] - truth[:, :2], axis=2).min(axis=1)
    assert away[0] > 0.015
    np.testing.assert_allclose(away[1:], 0.9 * FACTS.lesion_radius, rtol=0.01)
