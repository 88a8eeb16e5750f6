"""The fast surrogate of SurgSim/PalpateSites-v0: what it observes and pays, and that its lesions can be found."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")
import gymnasium as gym

from surgsim_env.tasks.palpate_sites import BUDGET, BUDGET_WIDE, PalpateSitesTask
from surgsim_env.training.bell_sites import TIP, BellDraws, BellSites
from surgsim_env.training.site_agent import SLICES, observed_facts

pytestmark = pytest.mark.agents
QUIET = BellDraws(background=0.0, model=(0.0, 0.0), offset=0.0, noise=(1e-6, 1.0001e-6), count_weights=(0.0, 1.0))


def test_it_observes_what_the_environment_does():
    observation, _ = BellSites().reset(seed=0)
    original = gym.make("SurgSim/PalpateSites-v0", scene="phantom_small").unwrapped
    assert observation.shape == original.observation_space.shape and original.observation_slices == SLICES
    for seed in range(20):
        env = BellSites()
        observation, _ = env.reset(seed=seed)
        facts = observed_facts(observation)
        np.testing.assert_allclose(facts.extent, env.map.extent, rtol=1e-5)
        assert facts.map.pressable.tolist() == env.map.pressable.tolist() and env.map.pressable.sum() > 20
        assert env.budget == (BUDGET_WIDE if env.map.extent.max() > 10.0 else BUDGET)
        again, _ = BellSites().reset(seed=seed)
        np.testing.assert_array_equal(again, observation)


def test_a_press_over_a_lesion_feels_its_amplitude():
    env = BellSites(QUIET)
    env.reset(seed=3)
    np.testing.assert_allclose(env.contrast(env.truth), env.amplitude)
    beside = env.truth + np.array([env.spread[0], 0.0])
    np.testing.assert_allclose(env.contrast(beside), env.amplitude * np.exp(-0.5))
    place = (2.0 * env.truth[0] / TIP / env.map.extent - 1.0).astype(np.float32)
    observation, *_ = env.step(np.clip(place, -1.0, 1.0))
    felt = observation[SLICES["contrast_map"]][observation[SLICES["pressed_map"]] > 0.5]
    np.testing.assert_allclose(felt, env.contrast(np.array(env.places)), atol=1e-5)


def test_pressing_everywhere_finds_a_lesion_and_pays_it_once():
    env = BellSites(QUIET)
    env.reset(seed=5)
    found, total, over, rng = env.found, 0.0, False, np.random.default_rng(0)
    sites = env.map.places[env.map.pressable]
    worst = 0.0
    while not over:
        _, reward, over, _, info = env.step(sites[rng.integers(len(sites))].astype(np.float32))
        total += reward
        worst += abs(PalpateSitesTask.weights["error"]) / env.budget
    assert info["success"] and info["error_mm"] < 3.0 and env.found == 1.0
    gained = PalpateSitesTask.weights["found"] * (1.0 - found)
    assert gained - worst <= total <= gained
