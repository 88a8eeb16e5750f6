"""SurgSim/Retract-v0: what it observes and measures."""

from dataclasses import replace

import numpy as np
import pytest

from surgsim_env.tasks.retract import EPISODE_STEPS, RetractionRecord, region_strains
from tests.envs.retract_steps import EMPTY, HELD, STEP, act

# ---- what it observes and measures --------------------------------------------------------------------------------


def test_the_observation_is_what_its_table_says(retract_env):
    tip = retract_env.simulation.instrument.tip_position
    for _ in range(4):
        observation = act(retract_env, (0.004, 0.0, 0.002), jaw=1.0)[0]
    # 6 numbers more than the table's 50, as the grasper turns.
    assert observation.shape == (56,)
    np.testing.assert_allclose(observation[:3], tip + np.array([0.004, 0.0, 0.002]) * 4 * STEP, atol=2e-4)
    np.testing.assert_allclose(observation[3:6], [0.004, 0.0, 0.002], atol=5e-4)
    axes = observation[6:12].reshape(2, 3)
    np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-6)
    assert observation[12] == pytest.approx(retract_env.simulation.instrument.jaw.opening, abs=1e-6)
    bias = retract_env.runtime.sensors["contact_force"].bias
    np.testing.assert_allclose(observation[13:16], bias, atol=6 * retract_env.scene.sensor.noise)
    assert retract_env.observation_slices["contact_force"] == slice(13, 16)
    np.testing.assert_array_equal(observation[19:22], 0.0)
    nodes = retract_env.simulation.organ_state.node_position[retract_env.task.tracked_nodes]
    np.testing.assert_allclose(observation[22:52].reshape(-1, 3), nodes, atol=1e-7)
    place = retract_env.task.drawn.target[:2]
    np.testing.assert_allclose(observation[52:], [0.0, *place, 1.0 - 4 / EPISODE_STEPS], atol=1e-6)


def test_an_action_is_read_as_it_was_made(retract_env):
    velocity, turning = np.array([0.004, -0.008, 0.012]), np.array([0.2])
    action = retract_env.layout.action(velocity, turning=turning, jaw=0.3)
    np.testing.assert_allclose(action, [0.2, -0.4, 0.6, 0.4, 0.3])
    # What is not said stays: the jaw's last target, and no turning.
    act(retract_env, jaw=0.3)
    np.testing.assert_allclose(retract_env.layout.action(np.zeros(3)), [0.0, 0.0, 0.0, 0.0, 0.3])


def test_wrist_turns_at_the_commanded_rate(retract_env):
    before = retract_env.simulation.instrument.pitch
    for _ in range(10):
        act(retract_env, turning=np.array([0.4]))
    assert retract_env.simulation.instrument.pitch - before == pytest.approx(0.4 * 10 * STEP, rel=0.05)


def test_path_and_peaks_are_the_episodes(retract_env):
    for _ in range(10):
        info = act(retract_env, (0.0, 0.006, 0.008))[-1]
    # The servo lags a little at its start.
    assert info["path_length"] == pytest.approx(0.01 * 9 * STEP, rel=0.03)
    assert info["pull_force_peak"] == info["grip_force_peak"] == info["pull_impulse"] == info["slips"] == 0.0


def test_forces_slips_and_impulse_are_counted_as_told():
    record, tip = RetractionRecord(), np.zeros(3)
    slipping, calm = replace(HELD, friction_left=0.0), [0.0, 0.0, 0.0]
    for grasp in (HELD, slipping, slipping, HELD, slipping, EMPTY, EMPTY):
        record.note(grasp, 0.15, tip, calm, closing=True, duration=STEP)
    info = record.info()
    # Two holds that began to slip, and one that was lost with the jaw closing.
    assert info["slips"] == 3.0
    assert info["grip_force_mean"] == pytest.approx(0.4) and info["grip_force_peak"] == 0.4
    assert info["pull_force_mean"] == pytest.approx(0.1) and info["pull_force_peak"] == 0.15
    assert info["pull_impulse"] == pytest.approx(0.1 * 5 * STEP)
    opened = RetractionRecord()
    for grasp in (HELD, EMPTY):
        opened.note(grasp, 0.1, tip, calm, closing=False, duration=STEP)
    assert opened.info()["slips"] == 0.0


def test_strains_are_those_of_a_stretched_lobe(retract_env):
    """Stretched by 5 % along y in its free third and by 2 % elsewhere, edges along y strain by just that."""
    model = retract_env.simulation.organ_model
    rest = model.node_rest_position
    length = rest[:, 1].max()
    moved = rest.copy()
    # From the first layer of nodes in that third on.
    moved[:, 1] += 0.02 * rest[:, 1] + 0.03 * np.maximum(rest[:, 1] - 9.0 / 13.0 * length, 0.0)
    np.testing.assert_allclose(
        region_strains(model, moved, (rest.min(axis=0), rest.max(axis=0))), [0.02, 0.02, 0.05], rtol=1e-6
    )
    np.testing.assert_allclose(region_strains(model, 0.9 * rest, (rest.min(axis=0), rest.max(axis=0))), 0.0)
