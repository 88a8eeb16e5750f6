"""SurgSim/Palpate-v0: what ends an episode, what it pays, and that a fault is clean."""

import re

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from surgsim_env.tasks.palpate import EPISODE_STEPS

SPEED = 0.02
STEP = 0.05


@pytest.fixture
def env():
    return gym.make("SurgSim/Palpate-v0", scaled=False).unwrapped


def place(env, x, y, gap=0.001):
    """Put the tip over a place of the phantom's top [m], at rest, `gap` above it."""
    env.simulation.restart(np.array([x, y, 0.03 + 0.008 + gap]))


def act(env, velocity=(0.0, 0.0, 0.0), declare=0.0):
    return env.step(np.array([*(np.asarray(velocity) / SPEED), declare], dtype=np.float32))


def lesion_place(env):
    return np.array(env.task.lesion.centre[:2])


def press_and_declare(env, x, y):
    """Press 3 mm deep at a place and declare till the episode ends; returns the last step and the return."""
    place(env, x, y)
    total = 0.0
    for _ in range(4):
        record = act(env, (0.0, 0.0, -SPEED))
        total += record[1]
    for _ in range(5):
        record = act(env, declare=1.0)
        total += record[1]
        if record[2]:
            break
    return record, total


def test_declaring_on_the_lesion_wins(env):
    env.reset(seed=1)
    (_, reward, terminated, truncated, info), total = press_and_declare(env, *lesion_place(env))
    assert terminated and not truncated
    assert info["declared"] and info["success"]
    assert 0.0 <= info["error_mm"] < 1.5  # pressed straight over it; the tip slips a little over a stiff lesion
    assert reward == pytest.approx(10.0 - 0.005 + info["reward_soft_force"])
    assert total > 9.5


def test_success_is_judged_at_the_smallest_lesions_radius_along_the_surface(env):
    for offset, success in ((0.0045, True), (0.0075, False)):
        env.reset(seed=1)
        x, y = lesion_place(env)
        inwards = np.sign(0.03 - x)
        (_, _, _, _, info), _ = press_and_declare(env, x + inwards * offset, y)
        assert info["declared"]
        assert info["success"] is success
        # The tissue between tip and lesion is squeezed aside: the touched patch comes from up to 1 mm further out.
        assert info["error_mm"] == pytest.approx(offset * 1000, abs=1.0)
    assert env.task.success_distance == 0.006


def test_declare_needs_contact_three_steps_and_a_value_above_0p8(env):
    env.reset(seed=2)
    for _ in range(6):
        assert not act(env, declare=1.0)[2], "not in contact"
    place(env, 0.03, 0.03)
    for _ in range(4):
        act(env, (0.0, 0.0, -SPEED))
    for value in (1.0, 1.0, 0.79, 1.0, 1.0):
        _, _, terminated, _, info = act(env, declare=value)
        assert not terminated and not info["declared"]
    _, _, terminated, _, info = act(env, declare=1.0)
    assert terminated and info["declared"]
    with pytest.raises(gym.error.ResetNeeded):
        act(env)


def test_hard_limit_is_judged_every_haptic_step(env):
    env.reset(seed=3)
    place(env, *lesion_place(env))
    for _ in range(40):
        _, _, terminated, _, info = act(env, (0.0, 0.0, -SPEED))
        if terminated:
            break
    assert info["hard_limit"] and info["sim_fault"] == ""
    # It stopped in the very haptic step that passed the limit: the force had no time to go on rising.
    assert 0.8 < info["force_peak"] < 0.81
    assert env.simulation.time % STEP != pytest.approx(0.0, abs=1e-6)


def test_time_runs_out_after_600_steps():
    env = gym.make("SurgSim/Palpate-v0")
    env.reset(seed=4)
    # A haptic step a control step keeps this test short; the count of control steps is what it is about.
    object.__setattr__(env.unwrapped.scene.timing, "haptic_steps_per_control", 1)
    try:
        for step in range(1, EPISODE_STEPS + 1):
            observation, _, terminated, truncated, _ = env.step(np.zeros(4, dtype=np.float32))
            assert not terminated
            assert truncated == (step == 600)
        assert observation[9] == 0.0
    finally:
        object.__setattr__(env.unwrapped.scene.timing, "haptic_steps_per_control", 50)


def inject_fault(env, kind):
    state = env.simulation.organ_state
    if kind == "not finite":
        state.node_velocity[700, 1] = np.nan
    elif kind == "inverted":
        tet = env.simulation.organ_model.tet_nodes[100]
        free = next(node for node in tet if env.simulation.organ_model.node_inverse_mass[node] > 0.0)
        others = [node for node in tet if node != free]
        state.node_position[free] = 2.5 * state.node_position[others].mean(axis=0) - 1.5 * state.node_position[free]
    elif kind == "force cap":
        env.simulation.contact = env.simulation.contact._replace(stiffness=1e12)
        place(env, 0.03, 0.03, gap=-0.004)
    elif kind == "MuJoCo":
        env.simulation.instrument.data.qvel[0] = 1e12


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("not finite", "no longer finite"),
        ("inverted", "turned inside out"),
        ("force cap", "cap of 100 N|inside out"),
        ("MuJoCo", "MuJoCo warning"),
    ],
)
def test_a_fault_ends_the_episode_with_a_finite_observation_and_a_clean_reset(env, kind, words):
    expected = env.reset(seed=6)[0]
    reference = [act(env, (0.0, 0.0, -SPEED))[0] for _ in range(3)]
    env.reset(seed=6)
    for _ in range(2):
        before = act(env, (0.0, 0.0, -SPEED))[0]
    contact = env.simulation.contact
    inject_fault(env, kind)
    observation, reward, terminated, truncated, info = act(env)
    env.simulation.contact = contact
    assert terminated and not truncated
    assert re.search(words, info["sim_fault"])
    assert np.isfinite(env.simulation.contact_wrench).all()
    np.testing.assert_array_equal(observation, before)
    assert reward == pytest.approx(-5.0 - 0.005 - 0.015 * (EPISODE_STEPS - 3) + info["reward_soft_force"])
    np.testing.assert_array_equal(env.reset(seed=6)[0], expected)
    for observation in reference:
        assert act(env, (0.0, 0.0, -SPEED))[0].tobytes() == observation.tobytes()


def test_force_reading_is_noisy_biased_and_flags_saturation(env):
    env.reset(seed=7)
    still = np.array([act(env)[0][6:9] for _ in range(60)])
    bias = env.runtime.sensors["contact_force"].bias
    assert (np.abs(bias) <= 0.01).all()
    # Mean of 60 readings: 0.005 / sqrt(60) N each; five of those.
    np.testing.assert_allclose(still.mean(axis=0), bias, atol=5 * 0.005 / np.sqrt(60))
    assert still.std(axis=0) == pytest.approx(0.005, rel=0.4)
    env.runtime.sensors["contact_force"].bias = np.array([0.0, 0.0, 3.0])
    observation, _, _, _, info = act(env)
    assert info["sensor_saturated"] is True
    assert observation[8] == np.float32(2.0)


def test_tip_follows_the_commanded_velocity(env):
    env.reset(seed=9)
    start = env.simulation.instrument.tip_position
    for _ in range(10):
        observation = act(env, (0.3 * SPEED, 0.0, 0.5 * SPEED))[0]
    moved = env.simulation.instrument.tip_position - start
    np.testing.assert_allclose(moved, [0.003, 0.0, 0.005], atol=1.5e-4)
    np.testing.assert_allclose(observation[3:6], [0.006, 0.0, 0.010], atol=2e-4)
