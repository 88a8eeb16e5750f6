"""Palpate-v0 with memory: the observation holds what was felt, and it is all there is to it."""

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from surgsim_env.palpation.chart import MAP_SIDE
from surgsim_env.palpation.touches import stiffest_spots

ID = "SurgSim/Palpate-v0"
SITES = MAP_SIDE**2
CONTRAST, VISITED, FACE = (slice(10 + k * SITES, 10 + (k + 1) * SITES) for k in range(3))
STIFFEST = slice(FACE.stop, FACE.stop + 3)
DOWN, ACROSS, UP = [0.0, 0.0, -0.5, 0.0], [0.6, 0.3, 0.0, 0.0], [0.0, 0.0, 0.8, 0.0]
WALK = np.array([DOWN] * 16 + [ACROSS] * 10 + [UP] * 4, dtype=np.float32)


def walked(env, seed=3):
    observations = [env.reset(seed=seed)[0]]
    for action in WALK:
        observation, _, terminated, truncated, _ = env.step(action)
        assert not terminated and not truncated
        observations.append(observation)
    return np.array(observations)


def test_without_memory_nothing_has_changed_and_with_it_more_is_appended():
    plain, long = walked(gym.make(ID, scaled=False)), walked(gym.make(ID, memory=True, scaled=False))
    assert plain.shape[1] == 11 and long.shape[1] == 11 + 3 * SITES + 3
    np.testing.assert_array_equal(np.delete(long, slice(10, -1), axis=1), plain)


def test_contrasts_are_the_fit_of_the_readings_to_hertz():
    """Recomputed from the first ten entries alone: place, reading; the top of the phantom is at z = 30 mm."""
    env = gym.make(ID, memory=True, scaled=False)
    seen = walked(env)
    felt, healthy = np.zeros((2, SITES))
    for row in seen.astype(np.float64):
        depth = 0.008 + 0.030 - row[2]
        if depth < 0.002:
            continue
        # Sites of 3.2 mm around the middle of the top, at 30 mm.
        column, line = np.round((row[:2] - 0.030) / 0.0032).astype(int) + MAP_SIDE // 2
        hertz = 4 / 3 * 5000 / (1 - 0.45**2) * np.sqrt(0.008) * depth**1.5
        felt[MAP_SIDE * line + column] += row[8] * hertz
        healthy[MAP_SIDE * line + column] += hertz**2
    visited = healthy > 0.0
    assert 3 <= visited.sum() <= 20
    np.testing.assert_array_equal(seen[-1, VISITED], visited)
    # The observation is rounded to float32: 1 nm of 38 mm, so a part in 1e5 of a depth of 2 mm.
    np.testing.assert_allclose(seen[-1, CONTRAST][visited], felt[visited] / healthy[visited], rtol=1e-4)
    assert not seen[-1, CONTRAST][~visited].any()
    assert 0.5 < seen[-1, CONTRAST][visited].mean() < 3.0, "a tray stiffens Hertz's half space"


def test_the_stiffest_place_is_where_most_was_felt():
    env = gym.make(ID, memory=True, scaled=False)
    seen = walked(env)
    u, v, contrast = seen[-1, STIFFEST]
    touch_map = env.unwrapped.task.memory.map
    site = touch_map.nearest([u, v])
    # The centroid of few sites lies among them.
    near = np.abs(touch_map.numbers - touch_map.numbers[site]).max(axis=1) <= 3
    assert (seen[-1, VISITED][near] == 1.0).any()
    felt = seen[-1, CONTRAST][seen[-1, VISITED] > 0.0]
    assert felt.mean() <= contrast <= felt.max()


def test_the_stiffest_place_follows_each_reading():
    """The place kept between readings is that of the readings so far, also in a restored memory."""
    env = gym.make(ID, memory=True).unwrapped
    env.reset(seed=3)
    memory, rng = env.task.memory, np.random.default_rng(0)
    for place in rng.uniform(-0.9, 0.9, (30, 2)):
        memory.feel(place, 0.003, float(rng.uniform(0.1, 0.3)))
        fresh = stiffest_spots(memory.bell_fit, memory.product[None], memory.square[None])[0]
        np.testing.assert_array_equal(memory.stiffest(), fresh)
    last = memory.stiffest()
    other = memory.restored(2.0 * memory.product, memory.square)
    assert other.stiffest()[2] == pytest.approx(2.0 * last[2])
    np.testing.assert_array_equal(memory.stiffest(), last)
    memory.forget()
    np.testing.assert_array_equal(memory.stiffest(), 0.0)


def test_an_episode_begins_with_nothing_remembered():
    env = gym.make(ID, memory=True, scaled=False)
    assert walked(env)[-1, VISITED].any()
    begun = env.reset()[0]
    assert not begun[10 : FACE.start].any() and not begun[STIFFEST].any()
    assert begun[FACE].sum() == 13 * 13
