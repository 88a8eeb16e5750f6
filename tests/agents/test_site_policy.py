"""The learned acquisition function: it sees the belief of the agents gp_*.py and names the site that is pressed."""

from dataclasses import asdict

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")
import gymnasium as gym
import torch
from stable_baselines3 import PPO

from agents.site_agent import SiteFacts
from agents.site_belief import BeliefSettings, SiteBelief
from agents.site_policy import CURIOSITY, SHARPNESS, SitePolicy
from agents.site_process import LENGTH_SHARE, SiteProcess
from agents.training.policy_files import PolicyDescription, load_policy, save_policy
from surgsim_env.palpation.lesion_estimator import BACKGROUND_SPREAD, EXCESS_LENGTH, EXCESS_SPREAD, LesionEstimator

pytestmark = pytest.mark.agents
SETTINGS = BeliefSettings(extent=(0.04, 0.03), site_count=7, tip_radius=0.008, noise=0.04)
SITES = SETTINGS.site_count**2
OUTERMOST = np.pad(np.zeros((5, 5), dtype=bool), 1, constant_values=True).ravel()


def observed(contrast: dict[int, float], left: float = 0.6) -> np.ndarray:
    """An observation that remembers the log contrast of some sites."""
    values = np.zeros(2 * SITES + 6, dtype=np.float32)
    for site, value in contrast.items():
        values[site], values[SITES + site] = value, 1.0
    values[-1] = left
    return values


def place(site: int) -> tuple[float, float]:
    row, column = divmod(site, SETTINGS.site_count)
    return column / 6 * SETTINGS.extent[0], row / 6 * SETTINGS.extent[1]


def test_belief_is_that_of_the_gaussian_process_agents():
    """They have it from scikit-learn."""
    observation = observed({3: 0.1, 17: 0.5, 24: -0.2, 40: 0.05})
    features = SiteBelief(SETTINGS).features(observation[None])[0].reshape(-1)
    process = SiteProcess(SiteFacts(SETTINGS.extent, SETTINGS.site_count, SETTINGS.tip_radius, SETTINGS.noise, 25))
    belief = process.belief(observation)
    np.testing.assert_allclose(features[:SITES][process.candidates] * EXCESS_SPREAD, belief.excess, atol=1e-6)
    np.testing.assert_allclose(
        features[SITES : 2 * SITES][process.candidates] * EXCESS_SPREAD, belief.spread, atol=1e-5
    )
    # A belief of the estimator's own length is another one.
    estimator = LesionEstimator(SETTINGS.extent, tip_radius=0.008, noise=0.04)
    estimator.axes = tuple(np.linspace(0.0, extent, 7) for extent in SETTINGS.extent)
    pressed = [3, 17, 24, 40]
    _, excess = estimator.posterior(np.array([place(site) for site in pressed]), observation[pressed])
    assert np.abs(features[:SITES] * EXCESS_SPREAD - excess.ravel()).max() > 0.01


def test_doubt_is_that_of_the_joint_normal_distribution():
    belief, visited = SiteBelief(SETTINGS), [3, 17, 24]
    assert belief.features(observed({})[None])[0][SITES : 2 * SITES].tolist() == [1.0] * SITES
    doubt = belief.features(observed(dict.fromkeys(visited, 0.1))[None])[0][SITES : 2 * SITES] * EXCESS_SPREAD
    # Bayes' rule in terms of precisions: excess at every site and the background, then the presses.
    places = np.array([place(site) for site in range(SITES)])
    squared = ((places[:, None] - places) ** 2).sum(axis=2)
    prior = np.zeros((SITES + 1, SITES + 1))
    prior[:-1, :-1] = EXCESS_SPREAD**2 * np.exp(-0.5 * squared / (LENGTH_SHARE * EXCESS_LENGTH) ** 2) + 1e-8 * np.eye(
        SITES
    )
    prior[-1, -1] = BACKGROUND_SPREAD**2
    seen = np.eye(SITES + 1)[visited]
    seen[:, -1] = 1.0
    posterior = np.linalg.inv(np.linalg.inv(prior) + seen.T @ seen / belief.noise_variance)
    np.testing.assert_allclose(doubt, np.sqrt(np.diag(posterior)[:-1]), atol=1e-4)


def test_sites_and_actions_are_the_grids():
    belief = SiteBelief(SETTINGS)
    np.testing.assert_allclose(belief.action(np.array([0, 6, 42, 24])), [[-1, -1], [1, -1], [-1, 1], [0, 0]], atol=1e-7)


def test_an_untrained_policy_is_an_upper_confidence_bound():
    belief = SiteBelief(SETTINGS)
    policy = SitePolicy(belief.space, gym.spaces.Discrete(SITES), lambda _: 1e-3)
    features = belief.features(np.stack([observed({3: 0.1, 17: 0.5}), observed({40: 0.3})]))
    logits = policy.get_distribution(torch.as_tensor(features)).distribution.logits
    bound = SHARPNESS * (features[:, :SITES] + CURIOSITY * features[:, SITES : 2 * SITES])
    touched = (features[:, 2 * SITES : 3 * SITES] > 0.5) | OUTERMOST
    # Site 3 lies in the outermost row.
    assert touched.sum(axis=1).tolist() == [24 + 1, 24 + 1]
    assert (logits.exp().detach().numpy()[touched] == 0.0).all()
    difference = logits.detach().numpy() - bound
    for one, hidden in zip(difference, touched, strict=True):
        np.testing.assert_allclose(one[~hidden], one[~hidden][0], atol=1e-4)
    chosen, _ = policy.predict(features, deterministic=True)
    assert chosen.tolist() == np.where(touched, -np.inf, bound).argmax(axis=1).tolist()


def test_a_saved_policy_presses_what_its_scores_say(tmp_path):
    class Sites(gym.Env):
        """Just spaces: the policy is never asked to step."""

        observation_space = SiteBelief(SETTINGS).space
        action_space = gym.spaces.Discrete(SITES)

    model = PPO(SitePolicy, Sites(), n_steps=8, batch_size=8)
    save_policy(model, PolicyDescription("PPO", "SurgSim/PalpateSites-v0", belief=asdict(SETTINGS)), tmp_path / "p.zip")
    policy = load_policy(tmp_path / "p.zip")
    policy.reset(2)
    observations = np.stack([observed({3: 0.1, 17: 0.5}), observed({40: 0.3})])
    actions = policy.act(observations, np.ones(2, dtype=bool))
    belief = SiteBelief(SETTINGS)
    features = belief.features(observations)
    bound = features[:, :SITES] + CURIOSITY * features[:, SITES : 2 * SITES]
    bound[(features[:, 2 * SITES : 3 * SITES] > 0.5) | OUTERMOST] = -np.inf
    np.testing.assert_array_equal(actions, belief.action(bound.argmax(axis=1)))
    assert actions.dtype == np.float32
