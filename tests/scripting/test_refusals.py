"""Scripts that are refused before anything runs."""

import math

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import surgsim_env  # noqa: F401
from surgsim_env.scripting import (
    Control,
    Declare,
    Hold,
    Lift,
    MoveTo,
    PressUntil,
    WaitUntil,
    run_script,
)

MADE = {
    "MoveTo": lambda **more: MoveTo(**{"point": (0.0, 0.0, 0.0), **more}),
    "PressUntil": lambda **more: PressUntil(**{"force": 0.2, "max_depth": 0.004, **more}),
    "Hold": lambda **more: Hold(**{"duration": 0.1, **more}),
    "Lift": lambda **more: Lift(**{"height": 0.01, **more}),
    "WaitUntil": lambda **more: WaitUntil(**{"predicate": bool, "timeout": 1.0, **more}),
    "Declare": lambda **more: Declare(**more),
    "Control": lambda **more: Control(**{"controller": np.zeros, "timeout": 1.0, **more}),
}
NUMBERS = [
    *(("MoveTo", field) for field in ("speed", "tolerance", "timeout")),
    *(("PressUntil", field) for field in ("force", "max_depth", "speed", "tolerance", "timeout")),
    ("Hold", "duration"),
    *(("Lift", field) for field in ("height", "speed", "timeout")),
    ("WaitUntil", "timeout"),
    ("Declare", "timeout"),
    ("Control", "timeout"),
]
NOT_ABOVE_ZERO = st.one_of(st.floats(max_value=0.0), st.sampled_from([math.nan, math.inf]), st.integers(-9, 0))


@given(st.sampled_from(NUMBERS), NOT_ABOVE_ZERO)
def test_numbers_that_are_not_above_zero(place, value):
    step, field = place
    with pytest.raises(ValueError) as caught:
        MADE[step](**{field: value})
    assert str(caught.value).startswith(f"{step}: {field} is {value!r}")


POINTS = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3)


@given(POINTS.filter(lambda values: np.linalg.norm(values) > 1e-3))
def test_directions_are_brought_to_length_one(values):
    for step in (PressUntil(0.2, 0.004, direction=values), Lift(0.01, direction=values)):
        assert np.linalg.norm(step.direction) == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_allclose(np.cross(step.direction, values), 0.0, atol=1e-12)
        assert np.dot(step.direction, values) > 0.0


@pytest.fixture(scope="module")
def env():
    env = gym.make("SurgSim/Palpate-v0")
    env.reset(seed=0)
    return env


def test_a_wrapper_that_changes_actions(env):
    changed = gym.wrappers.RescaleAction(env, np.float32(-2.0), np.float32(2.0))
    with pytest.raises(ValueError, match="RescaleAction"):
        run_script(changed, [Lift(0.01)], seed=0)
    # One that leaves them as they are is none, and a controller speaks the wrapper's language.
    run_script(gym.wrappers.ClipAction(env), [Lift(0.001)], seed=0)
    trace = run_script(changed, [Control(lambda seen: np.array([0.0, 0.0, 1.0, 0.0]), timeout=0.5)], seed=0)
    assert trace.tip_position[-1, 2] - trace.tip_position[0, 2] == pytest.approx(0.5 * 0.5 * 0.02, abs=2e-4)


def test_other_environments_and_several_at_once():
    with pytest.raises(TypeError, match="CartPoleEnv"):
        run_script(gym.make("CartPole-v1"), [Hold(0.1)])
    with pytest.raises(TypeError, match="VectorEnv"):
        run_script(gym.make_vec("CartPole-v1", num_envs=2), [Hold(0.1)])
    with pytest.raises(TypeError, match="PalpateSitesTask"):
        run_script(gym.make("SurgSim/PalpateSites-v0", scene="phantom_small"), [Hold(0.1)])


def test_before_the_first_reset():
    env = gym.make("SurgSim/Palpate-v0")
    with pytest.raises(gym.error.ResetNeeded):
        run_script(env, [Hold(0.1)])
