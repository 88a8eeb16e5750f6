"""The learned acquisition function: it sees the belief of the searches gp_* and names the site that is pressed."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")
import gymnasium as gym
import torch
from stable_baselines3 import PPO

from agents.evaluate import POLICIES
from agents.scoring.site_agent import LENGTH_SHARE, SiteFacts, SiteProcess
from agents.training.policy_files import describe, load_policy, save_policy
from agents.training.site_policy import CURIOSITY, SHARPNESS, SiteBelief, SitePolicy
from surgsim_env.palpation.lesion_estimator import (
    BACKGROUND_SPREAD,
    EXCESS_LENGTH,
    EXCESS_SPREAD,
    MODEL_SPREAD,
    contrast_process,
)

pytestmark = pytest.mark.agents
SETTINGS = SiteFacts(extent=(0.04, 0.03), site_count=7, tip_radius=0.008, noise=0.04)
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


@pytest.mark.parametrize("pressed", [{3: 0.1, 17: 0.5, 24: -0.2, 40: 0.05}, {24: 0.3}])
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
    sites = np.array([place(site) for site in range(SITES)])
    peer.fit(sites[list(pressed)], observation[list(pressed)])
    covariance = excess(sites, peer.X_train_)
    explained = solve_triangular(peer.L_, covariance.T, lower=True)
    belief = SiteProcess(SETTINGS).belief(observation)
    np.testing.assert_allclose(belief.excess, covariance @ peer.alpha_, atol=1e-12)
    np.testing.assert_allclose(belief.spread, np.sqrt(EXCESS_SPREAD**2 - (explained**2).sum(axis=0)), atol=1e-10)
    features = SiteBelief(SETTINGS).features(observation[None])[0]
    np.testing.assert_allclose(features[:SITES] * EXCESS_SPREAD, belief.excess, atol=1e-7)
    np.testing.assert_allclose(features[SITES : 2 * SITES] * EXCESS_SPREAD, belief.spread, atol=1e-7)
    # A belief of the estimator's own length is another one.
    longer = contrast_process(SETTINGS.axes, tip_radius=SETTINGS.tip_radius, noise=SETTINGS.noise)
    _, other = longer.mean(sites[list(pressed)], observation[list(pressed)])
    assert np.abs(belief.excess - other.ravel()).max() > 0.01


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
    posterior = np.linalg.inv(np.linalg.inv(prior) + seen.T @ seen / belief.process.process.noise_variance)
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


@pytest.mark.parametrize("path", sorted(POLICIES.glob("sites_*.safetensors")), ids=lambda path: path.stem)
def test_shipped_policies_load(path):
    policy = load_policy(path)
    assert isinstance(policy.networks, SitePolicy) and policy.belief is not None
    count = policy.belief.site_count**2
    actions = policy.act(np.zeros((1, 2 * count + 6), dtype=np.float32), np.ones(1, dtype=bool))
    assert (np.abs(actions) < 1.0).all()


def test_a_saved_policy_presses_what_its_scores_say(tmp_path):
    class Sites(gym.Env):
        """Just spaces: the policy is never asked to step."""

        observation_space = SiteBelief(SETTINGS).space
        action_space = gym.spaces.Discrete(SITES)

    model = PPO(SitePolicy, Sites(), n_steps=8, batch_size=8)
    file = tmp_path / "p.safetensors"
    save_policy(model.policy, describe(model, None, env_id="SurgSim/PalpateSites-v0", belief=SETTINGS), file)
    policy = load_policy(file)
    policy.reset(2)
    observations = np.stack([observed({3: 0.1, 17: 0.5}), observed({40: 0.3})])
    actions = policy.act(observations, np.ones(2, dtype=bool))
    belief = SiteBelief(SETTINGS)
    features = belief.features(observations)
    bound = features[:, :SITES] + CURIOSITY * features[:, SITES : 2 * SITES]
    bound[(features[:, 2 * SITES : 3 * SITES] > 0.5) | OUTERMOST] = -np.inf
    np.testing.assert_array_equal(actions, belief.action(bound.argmax(axis=1)))
    assert actions.dtype == np.float32
