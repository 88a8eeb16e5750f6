"""Recording at haptic rate: the bits of the episode stay, and what is recorded is what happened."""

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401

RADIUS, TOP = 0.008, 0.03


def made(instrument="probe"):
    return gym.make("SurgSim/Palpate-v0", scene="phantom", instrument=instrument).unwrapped


def actions(count, seed=4):
    """A press that slides about, so that contact, friction and their loss are in play."""
    rng = np.random.default_rng(seed)
    for step in range(count):
        sideways = rng.uniform(-0.4, 0.4, 2)
        yield np.array([*sideways, -0.8 if step % 12 < 5 else 0.5, 0.0], dtype=np.float32)


def begin(env, gap=0.0005):
    env.reset(seed=3)
    env.simulation.restart(np.array([0.03, 0.03, TOP + RADIUS + gap]))


@pytest.mark.parametrize("instrument", ["probe", "psm_palpator"])
def test_a_recorded_episode_is_the_unrecorded_one_to_the_bit(instrument):
    plain, watched = made(instrument), made(instrument)
    assert plain.simulation.compiled and watched.simulation.compiled
    begin(plain), begin(watched)
    touched = False
    with watched.simulation.recording() as record:
        for action in actions(20):
            plain_step, other = plain.step(action), watched.step(action)
            assert plain_step[0].tobytes() == other[0].tobytes()
            assert plain_step[1:] == other[1:]
            touched |= plain_step[-1]["force_peak"] > 0.1
            # Nothing of the instrument's data differs either, poses included.
            for name in ("qpos", "qvel", "qacc", "ctrl", "xpos", "xipos", "site_xpos", "xfrc_applied"):
                mine = getattr(plain.simulation.instrument.data, name)
                its = getattr(watched.simulation.instrument.data, name)
                assert mine.tobytes() == its.tobytes(), name
    assert touched and len(record) == 1000
    assert plain.save_state() == watched.save_state()
    # And after it, compiled again.
    for action in actions(5, seed=9):
        assert plain.step(action)[0].tobytes() == watched.step(action)[0].tobytes()
    assert len(record) == 1000
    assert plain.save_state() == watched.save_state()


@pytest.mark.parametrize("instrument", ["probe", "psm_palpator"])
def test_each_entry_is_of_the_end_of_its_step(instrument):
    env = made(instrument)
    begin(env)
    with env.simulation.recording() as record:
        for count, action in enumerate(actions(10), start=1):
            env.step(action)
            # `end_control_step` brought the instrument's own poses up to the step's end.
            tool = env.simulation.instrument
            assert record.tip_position[-1].tobytes() == tool.tip_position.tobytes()
            assert record.tip_orientation[-1].tobytes() == tool.tip_pose_in(tool.data)[1].tobytes()
            assert record.wrench[-1].tobytes() == env.simulation.contact_wrench.tobytes()
            assert len(record) == 50 * count
    np.testing.assert_allclose(record.time, 0.001 * np.arange(1, 501), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(record.tip_orientation, axis=1), 1.0, atol=1e-12)
    # Positions are the integral of the velocity: no step is left out or there twice.
    assert 0.0 < np.abs(np.diff(record.tip_position, axis=0)).max() < 0.025 * 0.001


def test_first_contact_is_the_first_step_with_a_force():
    env = made()
    begin(env, gap=0.002)
    with env.simulation.recording() as record:
        assert record.first_contact() is None
        for _ in range(4):
            env.step(np.array([0.0, 0.0, -1.0, 0.0], dtype=np.float32))
    first = record.first_contact()
    assert not record.wrench[:first].any() and record.wrench[first:].any(axis=(1, 2)).all()
    # The ball meets a quadrature point d beside its lowest point d^2 / (2 R) later; with 5 mm cells d is below 2.2 mm.
    assert -0.0003 < record.tip_position_at(first)[2] - (TOP + RADIUS) < 1e-6
    assert record.first_contact(first + 7) == first + 7
    assert record.first_contact(len(record)) is None


def test_a_step_cut_short_by_the_hard_limit_is_recorded_as_far_as_it_went():
    env = made()
    begin(env)
    with env.simulation.recording() as record:
        over = False
        while not over:
            _, _, over, _, info = env.step(np.array([0.0, 0.0, -1.0, 0.0], dtype=np.float32))
    sizes = np.linalg.norm(record.wrench[:, :, :3].sum(axis=1), axis=1)
    assert info["hard_limit"] and len(record) % 50
    assert (sizes[:-1] <= env.runtime.force_limit).all() and sizes[-1] > env.runtime.force_limit
    assert sizes.max() == pytest.approx(info["force_peak"], rel=1e-15)
