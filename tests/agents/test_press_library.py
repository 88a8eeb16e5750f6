"""The library of presses: what is looked up is what would be simulated; it goes on where it was stopped."""

import sys
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from surgsim_env.scene.levels import LEVELS
from surgsim_env.training import press_library
from surgsim_env.training.press_library import FIRST_SEED, KEPT, PressLibraryEnv, load_library, make_library

SAMPLE = Path(press_library.__file__).with_name("press_library_sample.npz")


@pytest.mark.slow
def test_what_is_looked_up_is_what_would_be_simulated(tmp_path, monkeypatch):
    """Presses at sites of the grid, then between them, without noise: to float32, and within a few hundredths."""
    library = make_library(tmp_path / "small.npz", "phantom_small", "standard", 2, dtype=np.float64, lanes=8)
    looked_up = PressLibraryEnv(library)
    simulated = gym.make("SurgSim/PalpateSites-v0", scene="phantom_small").unwrapped
    rng = np.random.default_rng(0)
    sites = simulated.task.charted.chart.sites[rng.permutation(169)[:4]]
    between = rng.uniform(-1.0, 1.0, (4, 2))
    for number in range(2):
        drawn = LEVELS["standard"].draw(simulated.task.anatomy, np.random.default_rng(FIRST_SEED + number))
        assert drawn.to_json() == library.organs[number]
        monkeypatch.setattr(LEVELS["standard"].__class__, "draw", lambda *_, drawn=drawn: drawn)
        for env in (looked_up, simulated):
            env.task.reading.sensor = replace(env.task.reading.sensor, noise=0.0, bias=0.0)
        looked_up.reset(seed=0, options={"organ": number})
        simulated.reset(seed=0)
        for actions, tolerance in ((sites, 1e-5), (between, 0.06)):
            for action in actions.astype(np.float32):
                found, expected = looked_up.step(action), simulated.step(action)
                np.testing.assert_allclose(found[0], expected[0], atol=tolerance)
                assert found[2:4] == expected[2:4]
                assert set(found[4]) <= set(expected[4])
        monkeypatch.undo()


def test_the_script_makes_one(tmp_path, monkeypatch):
    from agents import make_press_library

    made = []
    monkeypatch.setattr(make_press_library, "make_library", lambda *given: made.append(given))
    monkeypatch.setattr(
        sys, "argv", ["make_press_library", "--scene", "phantom_small", "--out", str(tmp_path / "a.npz")]
    )
    make_press_library.main()
    assert made == [(tmp_path / "a.npz", "phantom_small", "standard", 400)]


def test_it_goes_on_where_it_was_stopped_and_may_be_used_meanwhile(tmp_path, monkeypatch):
    pressed = []

    def press_organs(anatomy, drawn, group):
        pressed.append(len(drawn))
        return np.full((len(drawn), 13, 13, len(KEPT)), float(len(pressed)))

    monkeypatch.setattr(press_library, "press_organs", press_organs)
    path = tmp_path / "library.npz"
    settings = {"dtype": np.float64, "lanes": 8}
    make_library(path, "phantom_small", "easy", 9, **settings)
    assert pressed == [8, 1]
    first = load_library(path)
    whole = make_library(path, "phantom_small", "easy", 12, **settings)
    assert pressed == [8, 1, 3]
    assert whole.organs[:9] == first.organs and len(set(whole.organs)) == 12
    assert load_library(path).organs == whole.organs
    assert sorted(item.name for item in tmp_path.iterdir()) == ["library.npz"]
    with pytest.raises(ValueError, match=r"holds presses of scene 'phantom_small', level 'easy', not of"):
        make_library(path, "phantom_small", "hard", 12, **settings)


def test_the_sample_is_an_environment_to_learn_on():
    assert SAMPLE.stat().st_size < 200_000
    env = PressLibraryEnv(SAMPLE)
    check_env(env, skip_render_check=True)
    observation, _ = env.reset(seed=1)
    again, _ = env.reset(seed=1)
    np.testing.assert_array_equal(observation, again)
    rng, total, over = np.random.default_rng(0), 0.0, False
    while not over:
        observation, reward, over, truncated, info = env.step(rng.uniform(-1.0, 1.0, 2).astype(np.float32))
        assert env.observation_space.contains(observation) and not truncated
        total += reward
    assert env.task.step_count == 25 and -1.3 < total <= 1.0
    assert 0.0 <= info["error_mm"] <= 20.0


def test_what_is_refused(tmp_path):
    (tmp_path / "no.npz").write_bytes(b"nothing")
    for path in (tmp_path / "no.npz", tmp_path / "gone.npz"):
        with pytest.raises(ValueError, match="is not a library of presses"):
            PressLibraryEnv(path)
    sample = load_library(SAMPLE)
    empty = replace(sample, organs=(), presses=sample.presses[:0])
    with pytest.raises(ValueError, match="no organ yet"):
        PressLibraryEnv(empty)
    env = PressLibraryEnv(SAMPLE)
    for options in ({"organ": 1000}, {"organ": 0, "seed": 2}):
        with pytest.raises(ValueError, match="reset options are"):
            env.reset(options=options)
