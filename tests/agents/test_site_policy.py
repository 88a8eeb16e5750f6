"""The learned acquisition function: it sees the belief of the searches gp_* and names the site that is pressed."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")
import gymnasium as gym
import torch
from stable_baselines3 import PPO

from surgsim_env.palpation.chart import MAP_SIDE, TouchMap
from surgsim_env.palpation.lesion_estimator import (
    BACKGROUND_SPREAD,
    EXCESS_LENGTH,
    EXCESS_SPREAD,
    MODEL_SPREAD,
    contrast_process,
)
from surgsim_env.scoring.evaluate import policies_folder
from surgsim_env.scoring.site_search import UCB_BETA
from surgsim_env.training.policy_files import describe, load_policy, save_policy
from surgsim_env.training.site_agent import (
    LENGTH_SHARE,
    OBSERVATION_SIZE,
    SITE_COUNT,
    SLICES,
    SiteFacts,
    SiteProcess,
    observed_facts,
)
from surgsim_env.training.site_policy import (
    CHOICE_SPACE,
    FEATURE_SPACE,
    MAPS,
    NUMBERS,
    SHARPNESS,
    Acquisition,
    SitePolicy,
    belief_features,
    site_actions,
)

pytestmark = pytest.mark.agents
# A chart of 40 x 32 mm under a tip of 8 mm: 11 x 9 sites of the map, 4 mm apart, around its middle.
EXTENT, TIP, CELL, NOISE = np.array([0.04, 0.032]), 0.008, 0.004, 0.04
LESION_RADIUS, EXCESS_LEAST = 0.008, 0.1
MIDDLE = MAP_SIDE // 2
FACE = np.zeros((MAP_SIDE, MAP_SIDE), dtype=bool)
FACE[MIDDLE - 4 : MIDDLE + 5, MIDDLE - 5 : MIDDLE + 6] = True
SETTINGS = SiteFacts(TouchMap(EXTENT, CELL, FACE.ravel()), TIP, LESION_RADIUS, NOISE, EXCESS_LEAST)
# Those off the chart's border, and not in a corner that was cut off.
INSIDE = np.zeros((MAP_SIDE, MAP_SIDE), dtype=bool)
INSIDE[MIDDLE - 3 : MIDDLE + 4, MIDDLE - 4 : MIDDLE + 5] = True


def at(row: int, column: int) -> int:
    """The number of the site so many rows and columns from the middle."""
    return (MIDDLE + row) * MAP_SIDE + MIDDLE + column


def observed(contrast: dict[int, float], left: float = 0.6) -> np.ndarray:
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
    values[SLICES["presses_left"]] = left
    return values


def place(site: int) -> np.ndarray:
    row, column = divmod(site, MAP_SIDE)
    return 0.5 * EXTENT + CELL * np.array([column - MIDDLE, row - MIDDLE])


PRESSES = [{at(-3, -3): 0.1, at(0, 2): 0.5, at(0, 0): -0.2, at(3, 1): 0.05}, {at(0, 0): 0.3}]


@pytest.mark.parametrize("pressed", PRESSES)
def test_belief_is_that_of_scikit_learn(pressed):
    """Its process predicts background plus excess; mean and variance of the excess follow from its fitted weights."""
    from scipy.linalg import solve_triangular
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    observation = observed(pressed).astype(np.float64)
    excess = ConstantKernel(EXCESS_SPREAD**2) * RBF(LENGTH_SHARE * EXCESS_LENGTH)
    peer = GaussianProcessRegressor(
        ConstantKernel(BACKGROUND_SPREAD**2) + excess,
        alpha=SETTINGS.noise**2 + MODEL_SPREAD**2,
        optimizer=None,  # pyright: ignore[reportArgumentType]  (None is documented)
    )
    sites = np.array([place(site) for site in range(SITE_COUNT)])
    inside = FACE.ravel()
    peer.fit(sites[list(pressed)], observation[list(pressed)])
    covariance = excess(sites, peer.X_train_)
    explained = solve_triangular(peer.L_, covariance.T, lower=True)
    belief = SiteProcess(SETTINGS).belief(observation)
    expected = np.sqrt(EXCESS_SPREAD**2 - (explained**2).sum(axis=0))
    np.testing.assert_allclose(belief.excess[inside], (covariance @ peer.alpha_)[inside], atol=1e-12)
    np.testing.assert_allclose(belief.spread[inside], expected[inside], atol=1e-10)
    # What a policy reads of the observation, in tip radii, is the same in single precision.
    excess_read, spread_read, touched, face = belief_features(observation[None])[0][:-NUMBERS].reshape(MAPS, -1)
    np.testing.assert_allclose(excess_read * EXCESS_SPREAD, belief.excess, atol=1e-6)
    np.testing.assert_allclose(spread_read * EXCESS_SPREAD, belief.spread, atol=1e-6)
    assert np.flatnonzero(touched).tolist() == sorted(pressed) and (face > 0.5).tolist() == INSIDE.ravel().tolist()
    # A belief of the estimator's own length is another one.
    longer = contrast_process(SETTINGS.map.axes, lesion_radius=SETTINGS.lesion_radius, noise=SETTINGS.noise)
    _, other = longer.mean(sites[list(pressed)], observation[list(pressed)])
    assert np.abs(belief.excess - other.ravel()).max() > 0.01


def test_doubt_is_that_of_the_joint_normal_distribution():
    visited = [at(-4, 0), at(0, 2), at(0, 0)]
    spread = slice(SITE_COUNT, 2 * SITE_COUNT)
    assert belief_features(observed({})[None])[0][spread].tolist() == [1.0] * SITE_COUNT
    doubt = belief_features(observed(dict.fromkeys(visited, 0.1))[None])[0][spread] * EXCESS_SPREAD
    # Bayes' rule in terms of precisions: excess at the face's sites and the background, then the presses.
    sites = np.flatnonzero(FACE.ravel())
    places, count = np.array([place(site) for site in sites]), len(sites)
    squared = ((places[:, None] - places) ** 2).sum(axis=2)
    prior = np.zeros((count + 1, count + 1))
    prior[:-1, :-1] = EXCESS_SPREAD**2 * np.exp(-0.5 * squared / (LENGTH_SHARE * EXCESS_LENGTH) ** 2)
    prior[:-1, :-1] += 1e-8 * np.eye(count)
    prior[-1, -1] = BACKGROUND_SPREAD**2
    seen = np.eye(count + 1)[np.searchsorted(sites, visited)]
    seen[:, -1] = 1.0
    posterior = np.linalg.inv(np.linalg.inv(prior) + seen.T @ seen / SiteProcess(SETTINGS).process.noise_variance)
    np.testing.assert_allclose(doubt[sites], np.sqrt(np.diag(posterior)[:-1]), atol=1e-4)


def test_sites_and_actions_are_the_maps():
    sites = np.array([at(-4, -5), at(-4, 5), at(4, -5), at(0, 0), at(2, 1)])
    expected = [[-1, -1], [1, -1], [-1, 1], [0, 0], [0.2, 0.5]]
    np.testing.assert_allclose(site_actions(np.stack([observed({})] * 5), sites), expected, atol=1e-6)


def test_facts_are_those_of_the_observation():
    facts = observed_facts(observed({}))
    np.testing.assert_allclose(facts.extent * TIP, EXTENT, rtol=1e-6)
    np.testing.assert_allclose(facts.sites[FACE.ravel()] * TIP, SETTINGS.sites[FACE.ravel()], rtol=1e-6, atol=1e-9)
    assert facts.noise == pytest.approx(NOISE) and facts.map.pressable.tolist() == FACE.ravel().tolist()


def test_an_observation_without_a_map_is_refused():
    with pytest.raises(ValueError, match=r"map_cell is .* must be above 0"):
        belief_features(np.zeros((1, OBSERVATION_SIZE), dtype=np.float32))


def test_an_untrained_policy_is_an_upper_confidence_bound():
    policy = SitePolicy(FEATURE_SPACE, CHOICE_SPACE, lambda _: 1e-3)
    # A site of the border, which is no candidate, and others.
    features = belief_features(np.stack([observed({at(-4, 0): 0.1, at(0, 2): 0.5}), observed({at(3, 3): 0.3})]))
    logits = policy.get_distribution(torch.as_tensor(features)).distribution.logits
    excess, spread, pressed, face = np.moveaxis(features[:, :-NUMBERS].reshape(2, MAPS, -1), 1, 0)
    bound = SHARPNESS * (excess + UCB_BETA * spread)
    touched = (pressed > 0.5) | (face < 0.5)
    assert (~touched).sum(axis=1).tolist() == [63 - 1, 63 - 1]
    assert (logits.exp().detach().numpy()[touched] == 0.0).all()
    difference = logits.detach().numpy() - bound
    for one, hidden in zip(difference, touched, strict=True):
        np.testing.assert_allclose(one[~hidden], one[~hidden][0], atol=1e-4)
    chosen, _ = policy.predict(features, deterministic=True)
    assert chosen.tolist() == np.where(touched, -np.inf, bound).argmax(axis=1).tolist()


@pytest.mark.parametrize("path", sorted(policies_folder().glob("sites_*.safetensors")), ids=lambda path: path.stem)
def test_shipped_policies_load(path):
    policy = load_policy(path)
    assert isinstance(policy.networks, SitePolicy) and policy.description.belief
    assert policy.description.observation is not None
    actions = policy.act(observed({})[None], np.ones(1, dtype=bool))
    assert (np.abs(actions) < 1.0).all()


def test_the_acquisition_function_is_its_formula():
    """Against plain sums over all sites, for numbers at which every term counts."""
    values = (2.0, 1.5, 0.7, 0.4, -0.5, 0.25, 1.3, 0.9, 1.2, 0.5, 0.2, 1.1, 0.5)
    bound, gain, hot, hot_spread, hot_excess, told, power, reach, room, share, softness, onset, width = values
    features = belief_features(observed({at(-2, 0): 0.1, at(0, 2): 0.5, at(2, -1): 0.3})[None])[0].astype(np.float64)
    excess, spread, _, candidates = features[:-NUMBERS].reshape(MAPS, -1)
    cell, radius, least = features[-3:]
    assert (cell, radius, least) == pytest.approx((CELL / TIP, LESION_RADIUS / TIP, EXCESS_LEAST / EXCESS_SPREAD))
    steps = np.stack(np.divmod(np.arange(SITE_COUNT), MAP_SIDE), axis=-1) * cell
    squared = ((steps[:, None] - steps) ** 2).sum(axis=2)

    def blurred(what: np.ndarray, deviation: float) -> np.ndarray:
        return np.exp(-0.5 * squared / deviation**2) @ what * cell**2 / (2.0 * np.pi * deviation**2)

    fits = candidates / (1.0 + np.exp(-(blurred(candidates, room * radius) - share) / softness))
    unknown = np.maximum((spread - told) / (1.0 - told), 1e-6) ** power
    found = 1.0 / (1.0 + np.exp(-(excess / least - onset) / width))
    around = found * (hot + hot_spread * spread + hot_excess * excess)
    expected = excess + bound * spread + gain * blurred(fits * unknown, reach * radius) + around
    made = Acquisition()
    made.values.data = torch.tensor(values)
    maps = torch.as_tensor(features[:-NUMBERS].reshape(1, MAPS, MAP_SIDE, MAP_SIDE), dtype=torch.float32)
    worth = made(maps, torch.as_tensor(features[None, -NUMBERS:], dtype=torch.float32)).detach().numpy().ravel()
    np.testing.assert_allclose(worth, expected, atol=2e-5)


def test_a_face_that_is_pressed_everywhere_is_pressed_again():
    everything = observed(dict.fromkeys(np.flatnonzero(INSIDE).tolist(), 0.1))
    policy = SitePolicy(FEATURE_SPACE, CHOICE_SPACE, lambda _: 1e-3)
    chosen, _ = policy.predict(belief_features(everything[None]), deterministic=True)
    assert INSIDE.ravel()[chosen[0]]


def test_a_saved_policy_presses_what_its_scores_say(tmp_path):
    class Sites(gym.Env):
        """Just spaces: the policy is never asked to step."""

        observation_space = FEATURE_SPACE
        action_space = CHOICE_SPACE

    model = PPO(SitePolicy, Sites(), n_steps=8, batch_size=8)
    file = tmp_path / "p.safetensors"
    save_policy(model.policy, describe(model, None, env_id="SurgSim/PalpateSites-v0", belief=True), file)
    policy = load_policy(file)
    policy.reset(2)
    observations = np.stack([observed({at(-4, 0): 0.1, at(0, 2): 0.5}), observed({at(3, 3): 0.3})])
    actions = policy.act(observations, np.ones(2, dtype=bool))
    excess, spread, pressed, face = np.moveaxis(belief_features(observations)[:, :-NUMBERS].reshape(2, MAPS, -1), 1, 0)
    bound = np.where((pressed > 0.5) | (face < 0.5), -np.inf, excess + UCB_BETA * spread)
    np.testing.assert_array_equal(actions, site_actions(observations, bound.argmax(axis=1)))
    assert actions.dtype == np.float32
