"""The learned acquisition function: its formula, and that it presses the candidate of most worth."""

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the `agents` extra")

from surgsim_apps.scoring.evaluate import policies_folder
from surgsim_apps.scoring.site_search import UCB_BETA
from surgsim_apps.training.acquisition import Acquisition
from surgsim_apps.training.policy_files import load_policy
from surgsim_apps.training.site_agent import (
    LENGTH_SHARE,
    OBSERVATION_SIZE,
    SITE_COUNT,
    SLICES,
    SiteProcess,
    observed_facts,
)
from surgsim_env.palpation.chart import MAP_SIDE
from surgsim_env.palpation.lesion_estimator import (
    BACKGROUND_SPREAD,
    EXCESS_LENGTH,
    EXCESS_SPREAD,
    MODEL_SPREAD,
)

pytestmark = pytest.mark.agents
# A chart of 40 x 32 mm under a tip of 8 mm: 11 x 9 sites of the map, 4 mm apart, around its middle.
EXTENT, TIP, CELL, NOISE = np.array([0.04, 0.032]), 0.008, 0.004, 0.04
LESION_RADIUS, EXCESS_LEAST = 0.008, 0.1
MIDDLE = MAP_SIDE // 2
FACE = np.zeros((MAP_SIDE, MAP_SIDE), dtype=bool)
FACE[MIDDLE - 4 : MIDDLE + 5, MIDDLE - 5 : MIDDLE + 6] = True


def at(row: int, column: int) -> int:
    """The number of the site so many rows and columns from the middle."""
    return (MIDDLE + row) * MAP_SIDE + MIDDLE + column


def observed(contrast: dict[int, float]) -> np.ndarray:
    """An observation that remembers the log contrast of some sites."""
    values = np.zeros(OBSERVATION_SIZE, dtype=np.float32)
    for site, value in contrast.items():
        values[SLICES["contrast_map"]][site], values[SLICES["pressed_map"]][site] = value, 1.0
    values[SLICES["face_map"]] = FACE.ravel()
    values[SLICES["map_cell"]] = CELL / TIP
    values[SLICES["chart_share"]] = EXTENT / (CELL * (MAP_SIDE - 1))
    values[SLICES["contrast_noise"]] = NOISE
    values[SLICES["excess_least"]] = EXCESS_LEAST
    values[SLICES["lesion_radius"]] = LESION_RADIUS / TIP
    values[SLICES["presses_left"]] = 0.6
    return values


PRESSES = {at(-2, 0): 0.1, at(0, 2): 0.5, at(2, -1): 0.3}


def test_belief_is_that_of_scikit_learn():
    """Its process predicts background plus excess; mean and variance of the excess follow from its fitted weights."""
    from scipy.linalg import solve_triangular
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    observation = observed(PRESSES)
    facts = observed_facts(observation)
    excess = ConstantKernel(EXCESS_SPREAD**2) * RBF(LENGTH_SHARE * EXCESS_LENGTH / TIP)
    peer = GaussianProcessRegressor(
        ConstantKernel(BACKGROUND_SPREAD**2) + excess,
        alpha=facts.noise**2 + MODEL_SPREAD**2,
        optimizer=None,  # pyright: ignore[reportArgumentType]  (None is documented)
    )
    pressed = sorted(PRESSES)
    peer.fit(facts.sites[pressed], observation[pressed].astype(np.float64))
    covariance = excess(facts.sites, peer.X_train_)
    explained = solve_triangular(peer.L_, covariance.T, lower=True)
    belief = SiteProcess(facts).belief(observation)
    inside, expected = FACE.ravel(), np.sqrt(EXCESS_SPREAD**2 - (explained**2).sum(axis=0))
    np.testing.assert_allclose(belief.excess[inside], (covariance @ peer.alpha_)[inside], atol=1e-10)
    np.testing.assert_allclose(belief.spread[inside], expected[inside], atol=1e-8)


def test_the_acquisition_function_is_its_formula():
    """Against plain sums over all sites, for numbers at which every term counts."""
    values = (2.0, 1.5, 0.7, 0.4, -0.5, 0.25, 1.3, 0.9, 1.2, 0.5, 0.2, 1.1, 0.5)
    bound, gain, hot, hot_spread, hot_excess, limit, power, reach, room, share, softness, onset, width = values
    process = SiteProcess(observed_facts(observed(PRESSES)))
    belief = process.belief(observed(PRESSES))
    excess, spread, radius = belief.excess / EXCESS_SPREAD, belief.spread / EXCESS_SPREAD, LESION_RADIUS / TIP
    steps = np.stack(np.divmod(np.arange(SITE_COUNT), MAP_SIDE), axis=-1) * CELL / TIP
    squared = ((steps[:, None] - steps) ** 2).sum(axis=2)

    def blurred(what: np.ndarray, deviation: float) -> np.ndarray:
        return np.exp(-0.5 * squared / deviation**2) @ what * (CELL / TIP) ** 2 / (2.0 * np.pi * deviation**2)

    fits = process.candidates / (1.0 + np.exp(-(blurred(process.candidates, room * radius) - share) / softness))
    unknown = np.maximum((spread - limit) / (1.0 - limit), 1e-6) ** power
    felt = 1.0 / (1.0 + np.exp(-(belief.excess / EXCESS_LEAST - onset) / width))
    around = felt * (hot + hot_spread * spread + hot_excess * excess)
    expected = excess + bound * spread + gain * blurred(fits * unknown, reach * radius) + around
    np.testing.assert_allclose(Acquisition(values).worth(process, belief).numpy(), expected, atol=2e-5)


def test_the_first_numbers_are_an_upper_confidence_bound():
    """Off the border of the face, where nothing was pressed."""
    process = SiteProcess(observed_facts(observed(PRESSES)))
    belief = process.belief(observed(PRESSES))
    pressed = np.isin(np.arange(SITE_COUNT), list(PRESSES))
    bound = np.where(process.candidates & ~pressed, belief.excess + UCB_BETA * belief.spread, -np.inf)
    assert process.candidates.sum() == 63 and Acquisition().best(process, belief, pressed) == bound.argmax()
    assert process.candidates[Acquisition().best(process, belief, process.candidates)], "all pressed: one again"


def test_the_shipped_policy_presses_the_site_of_most_worth():
    policy = load_policy(policies_folder() / "sites_evolved.json")
    assert isinstance(policy.decider, Acquisition) and policy.description.observation is not None
    (action,) = policy.act(observed(PRESSES)[None], np.ones(1, dtype=bool))
    process = SiteProcess(observed_facts(observed(PRESSES)))
    pressed = np.isin(np.arange(SITE_COUNT), list(PRESSES))
    site = policy.decider.best(process, process.belief(observed(PRESSES)), pressed)
    np.testing.assert_allclose(action, 2.0 * process.facts.sites[site] / process.facts.extent - 1.0, atol=1e-6)
