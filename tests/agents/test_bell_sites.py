"""The fast surrogate of SurgSim/PalpateSites-v0: what it observes and pays, and that its lesions can be found."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")
import gymnasium as gym

from surgsim_env.tasks.palpate_sites import BUDGET, BUDGET_WIDE, PalpateSitesTask
from surgsim_env.training.bell_sites import BellDraws, BellFaces
from surgsim_env.training.site_agent import SLICES, observed_facts
from surgsim_env.training.site_surrogate import SiteSurrogate

pytestmark = pytest.mark.agents
QUIET = BellDraws(
    tip_radius=(0.008, 0.008),
    amplitude=(0.4, 0.4),
    spread=(1.0, 1.0),
    background=0.0,
    model=(0.0, 0.0),
    offset=0.0,
    noise=(1e-6, 1.0001e-6),
    count_weights=(0.0, 1.0),
)


def test_it_observes_what_the_environment_does():
    observation, _ = SiteSurrogate(BellFaces()).reset(seed=0)
    original = gym.make("SurgSim/PalpateSites-v0", scene="phantom_small").unwrapped
    assert observation.shape == original.observation_space.shape and original.observation_slices == SLICES
    for seed in range(20):
        env = SiteSurrogate(BellFaces())
        observation, _ = env.reset(seed=seed)
        facts, known = observed_facts(observation), env.face.map
        np.testing.assert_allclose(facts.extent, known.extent, rtol=1e-5)
        assert facts.map.pressable.tolist() == known.pressable.tolist() and known.pressable.sum() > 20
        assert env.budget == (BUDGET_WIDE if known.extent.max() > 10.0 else BUDGET)
        again, _ = SiteSurrogate(BellFaces()).reset(seed=seed)
        np.testing.assert_array_equal(again, observation)


def test_a_press_feels_the_bell_of_a_lesion():
    env = SiteSurrogate(BellFaces(QUIET))
    env.reset(seed=3)
    face = env.face
    distance = np.linalg.norm(face.map.sites * face.tip_radius - face.truth, axis=1)
    np.testing.assert_allclose(face.log_contrast, 0.4 * np.exp(-0.5 * (distance / face.estimator.lesion_radius) ** 2))
    place = (2.0 * face.truth[0] / face.tip_radius / face.map.extent - 1.0).astype(np.float32)
    observation, *_ = env.step(np.clip(place, -1.0, 1.0))
    felt = observation[SLICES["contrast_map"]][observation[SLICES["pressed_map"]] > 0.5]
    np.testing.assert_allclose(felt, face.log_contrast[env.sites], atol=1e-5)
    assert env.sites == [int(np.argmin(np.where(face.map.pressable, distance, np.inf)))]


def test_pressing_everywhere_finds_a_lesion_and_pays_it_once():
    env = SiteSurrogate(BellFaces(QUIET))
    # Its lesion is not at the border, where few random presses lie around it.
    env.reset(seed=7)
    found, total, over, rng = env.found, 0.0, False, np.random.default_rng(0)
    sites = env.face.map.places[env.face.map.pressable]
    worst = 0.0
    while not over:
        _, reward, over, _, info = env.step(sites[rng.integers(len(sites))].astype(np.float32))
        total += reward
        worst += abs(PalpateSitesTask.weights["error"]) / env.budget
    assert info["success"] and info["error_mm"] < 3.0 and env.found == 1.0
    gained = PalpateSitesTask.weights["found"] * (1.0 - found)
    assert gained - worst <= total <= gained
