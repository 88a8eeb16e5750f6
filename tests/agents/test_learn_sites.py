"""The evolution strategy that finds an acquisition function: its belief, its cost, and that a short search helps."""

import argparse
import itertools
import re
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cma", reason="needs the `agents` extra")

from agents import learn_sites
from agents.learn_sites import (
    FIRST_SPREAD,
    PARAMETER_STEPS,
    PRESSES_MOST,
    Evolution,
    cost,
    learn,
    play,
    played,
    presses_to_stay,
    weighted_sources,
)
from surgsim_apps.training.acquisition import Acquisition
from surgsim_apps.training.policy_files import load_policy
from surgsim_apps.training.recorded_faces import load_faces
from surgsim_apps.training.site_agent import GrowingBelief, SiteProcess, observed_facts
from surgsim_apps.training.site_surrogate import SiteSurrogate

pytestmark = pytest.mark.agents
FILE = Path(learn_sites.__file__).parent / "faces" / "phantom_standard_held.npz"
FACES = load_faces(FILE)


def test_a_growing_belief_is_that_of_all_presses_at_once():
    env, rng = SiteSurrogate(FACES), np.random.default_rng(0)
    observation, _ = env.reset(seed=11)
    process = SiteProcess(observed_facts(observation))
    growing = GrowingBelief(process, 20)
    for site in rng.choice(np.flatnonzero(env.face.map.pressable), 20, replace=False).tolist():
        observation, *_ = env.step(env.face.map.places[site].astype(np.float32))
        growing.add(site, env.values[-1])
    whole = process.belief(observation)
    # The observation holds contrasts and lengths in single precision.
    np.testing.assert_allclose(growing.belief.excess, whole.excess, atol=1e-6)
    np.testing.assert_allclose(growing.belief.spread, whole.spread, atol=1e-6)


def test_play_presses_what_the_policy_chooses():
    acquisition, env = Acquisition(tuple(value + 0.1 for value in Acquisition().values)), SiteSurrogate(FACES)
    (errors,) = play(acquisition, [7], FACES)
    observation, _ = env.reset(seed=7)
    errors_mm, over = [], False
    while not over:
        observation, _, over, _, info = env.step(acquisition.actions(observation[None])[0])
        errors_mm.append(info["error_mm"])
    assert len(errors) == min(len(errors_mm), PRESSES_MOST)
    np.testing.assert_allclose(errors, errors_mm[:PRESSES_MOST], atol=1e-9)


def test_processes_play_the_same_episodes():
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        shared = played(Acquisition(), range(3), FACES, pool=pool, shares=2)
    for episode, alone in zip(shared, play(Acquisition(), range(3), FACES), strict=True):
        np.testing.assert_array_equal(episode, alone)


def test_the_cost_is_lower_the_earlier_a_lesion_is_found():
    assert [presses_to_stay(np.array(episode), 5.0) for episode in ([4.0, 3.0], [9.0, 4.0], [4.0, 9.0])] == [1, 2, 3]
    early, late = (np.where(np.arange(25) < presses, 20.0, 1.0) for presses in (5, 15))
    # Means 4.8 and 12.4 mm over 20 mm; 6 and 16 of 25 presses; above 5 mm after 0 and 8 of the presses 8 to 20, where
    # errors of 1 and 20 mm count as 1 / (1 + e^4) and 1.
    low = 1.0 / (1.0 + np.exp(4.0))
    costs = 4.8 / 20.0 + 6 / 25 + low, 12.4 / 20.0 + 16 / 25 + (8 + 5 * low) / 13
    assert cost([early]) == pytest.approx(costs[0], abs=1e-6)
    assert cost([early, late]) == pytest.approx(np.mean(costs), abs=1e-6)


def test_sources_count_by_their_weights(monkeypatch):
    costs = {"first": 3.0, "second": 5.0, "unseen": 9.0}
    monkeypatch.setattr(learn_sites, "load_faces", str)
    monkeypatch.setattr(learn_sites, "cost", lambda played: costs[played])
    learned = weighted_sources([Path("first"), Path("second")], [1.5, 0.5])
    settings = {"population": 4, "episodes": 1, "seed": 0, "play": lambda acquisition, seeds, draw: draw}
    evolution = Evolution(sources=learned, **settings)
    assert evolution.cost(Acquisition(), [0], learned) == pytest.approx(0.75 * 3.0 + 0.25 * 5.0)
    assert evolution.cost(Acquisition(), [0], weighted_sources([Path("unseen")])) == 9.0


def test_a_search_of_few_generations_lowers_the_cost(monkeypatch):
    """On a cost whose least is known, so that the test says nothing of luck."""
    steps = np.array(PARAMETER_STEPS)
    wanted = np.array(Acquisition().values) + 0.7 * steps
    monkeypatch.setattr(learn_sites, "cost", lambda values: float((((values - wanted) / steps) ** 2).sum()))
    settings = {"sources": [(FACES, 1.0)]}
    settings["play"] = lambda acquisition, seeds, draw: np.array(acquisition.values)
    first, again = (Evolution(population=12, episodes=1, seed=3, **settings) for _ in range(2))
    begin = learn_sites.cost(np.array(first.best.values))
    for _ in range(30):
        first.step()
        again.step()
    assert learn_sites.cost(np.array(first.best.values)) < 0.2 * begin
    assert first.best.values == again.best.values and first.episode_count == 360


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_script_writes_a_policy_that_presses(tmp_path, capsys, monkeypatch, sign):
    """Of each generation where each costs less than the one before, else of the first."""
    costs = itertools.count(2)
    monkeypatch.setattr(learn_sites, "cost", lambda errors: sign / next(costs))
    out = tmp_path / "sites.json"
    sizes = {"generations": 2, "population": 4, "episodes": 2, "check_episodes": 2, "processes": 2}
    recordings = {"faces": [FILE], "weights": None, "check_faces": [FILE]}
    learn(argparse.Namespace(out=out, seed=0, spread=FIRST_SPREAD, **sizes, **recordings))
    assert len(re.findall(r"cost (-?\d+\.\d+)", capsys.readouterr().out)) == 3
    policy = load_policy(out)
    improved = policy.description.acquisition != Acquisition().values
    assert (improved, policy.description.trained_steps) == ((True, 16) if sign > 0.0 else (False, 0))
    observation, _ = SiteSurrogate(FACES).reset(seed=1)
    assert (np.abs(policy.act(observation[None], np.ones(1, dtype=bool))) <= 1.0).all()
