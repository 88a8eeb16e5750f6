"""Environments on an organ that breathes keep the promises that those on one that holds still keep."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from surgsim_env.coupling.motion import CYCLE_COUNT, draw_drive
from surgsim_env.coupling.motion_kernels import signal_at
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import CyclicMotion
from surgsim_env.scene.save import scene_toml

BREATH = CyclicMotion("breathing", (0.004, 0.0, 0.001), period=(0.5, 0.7), rise=0.3, fall=0.5, variation=0.1)
BEAT = CyclicMotion(
    "heartbeat", (0.0, 0.0, 0.002), period=(0.2, 0.3), rise=0.2, fall=0.3, centre=(0.0, 0.0, 0.0), reach=0.05
)
IDS = ("SurgSim/Palpate-v0", "SurgSim/PalpateSites-v0")


@pytest.fixture(scope="module")
def scene():
    return replace(make_scene("phantom_small"), name="breathing", motions=(BREATH, BEAT))


@pytest.fixture(scope="module")
def scene_file(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "breathing.toml"
    path.write_text(scene_toml(scene))
    return str(path)


def test_cycles_rise_fall_and_rest():
    """From the definition: 0 before the first cycle, its size at u_r, smooth everywhere, and no cycle like another."""
    drive = draw_drive((BREATH, BEAT), 1e-3, np.random.default_rng(4))
    for number, motion in enumerate((BREATH, BEAT)):
        start, size, delay = drive.cycle_start[number], drive.cycle_size[number], drive.delay[number]
        assert 0.0 <= delay <= motion.period[1] and signal_at(drive, number, delay) == 0.0
        lengths = np.diff(start)
        for cycle in (0, 7, CYCLE_COUNT - 1):
            begin, length = delay + start[cycle], lengths[cycle]
            assert signal_at(drive, number, begin + motion.rise * length) == pytest.approx(size[cycle], rel=1e-9)
            assert signal_at(drive, number, begin + 0.5 * motion.rise * length) == pytest.approx(0.5 * size[cycle])
            assert abs(signal_at(drive, number, begin + (motion.rise + motion.fall) * length)) < 1e-9
            assert signal_at(drive, number, begin + 0.99 * length) == pytest.approx(0.0, abs=1e-12)
        time = np.arange(0.0, 3.0, 1e-4)
        speed = np.diff([signal_at(drive, number, one) for one in time]) / 1e-4
        # The largest acceleration: |p''| is at most 10 / sqrt(3).
        bend = size.max() * 10.0 / (np.sqrt(3.0) * (min(motion.rise, motion.fall) * lengths.min()) ** 2)
        assert np.abs(np.diff(speed)).max() < 1.05 * bend * 1e-4
        assert (np.ptp(lengths) > 1e-9) == (np.ptp(size) > 1e-9) == (motion.variation > 0.0)


def test_the_ground_is_where_the_signals_say_after_each_haptic_step(scene):
    anatomy = load_anatomy(scene)
    simulation = Simulation(anatomy)
    simulation.draw_motion(np.random.default_rng(2))
    at_rest = simulation.organ_state.node_position[anatomy.anchors].copy()
    farthest = 0.0
    for _ in range(900):
        assert simulation.haptic_step()
        signals = [signal_at(simulation.drive, number, simulation.time) for number in range(2)]
        shift = sum(s * one.shift(at_rest) for s, one in zip(signals, anatomy.ground_motions, strict=True))
        np.testing.assert_allclose(simulation.organ_state.node_position[anatomy.anchors], at_rest + shift, atol=1e-12)
        farthest = max(farthest, float(np.abs(shift).max()))
    assert farthest > 0.003


@pytest.mark.parametrize("env_id", IDS)
def test_a_saved_state_continues_as_the_episode_did(env_id, scene_file):
    """To the bit, with the cycles that were drawn; another environment that loads it too."""
    env = gym.make(env_id, scene=scene_file)
    env.reset(seed=1)
    env.action_space.seed(1)
    actions = [env.action_space.sample() for _ in range(6)]
    for action in actions[:3]:
        env.step(action)
    state = env.unwrapped.save_state()
    expected = [env.step(action)[0] for action in actions[3:]]
    other = gym.make(env_id, scene=scene_file)
    other.reset(seed=9)
    other.unwrapped.load_state(state)
    for action, observation in zip(actions[3:], expected, strict=True):
        assert other.step(action)[0].tobytes() == observation.tobytes()
    assert other.unwrapped.save_state() == env.unwrapped.save_state()


@pytest.mark.parametrize("env_id", IDS)
def test_organs_side_by_side_breathe_as_alone(env_id, scene_file):
    """Each lane its own cycles, to the bit."""
    lanes = {"vectorization_mode": "vector_entry_point", "autoreset_mode": "Disabled"}
    many = gym.make_vec(env_id, num_envs=3, scene=scene_file, **lanes)
    one = [gym.make(env_id, scene=scene_file) for _ in range(3)]
    first, _ = many.reset(seed=[3, 4, 5])
    for row, env, seed in zip(first, one, (3, 4, 5), strict=True):
        assert env.reset(seed=seed)[0].tobytes() == row.tobytes()
    one[0].action_space.seed(0)
    for _ in range(4):
        action = one[0].action_space.sample()
        rows = many.step(np.stack([action] * 3))[0]
        for row, env in zip(rows, one, strict=True):
            assert env.step(action)[0].tobytes() == row.tobytes()
    courses = [env.unwrapped.simulation.organ_state.motion[:, 0] for env in one]
    assert np.ptp(courses, axis=0).max() > 1e-3


def test_what_a_scene_says_of_motion_is_checked(scene):
    for changes, words in (
        ({"period": (0.0, 1.0)}, "period"),
        ({"rise": 0.7, "fall": 0.5}, "together at most 1"),
        ({"size": (2.0, 1.0)}, "size"),
        ({"variation": 0.9}, "variation is 0.9; it must be from 0 to 0.3"),
    ):
        with pytest.raises(ValueError, match=words):
            replace(BREATH, **changes)
