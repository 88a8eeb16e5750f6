"""Errors of joints: those of shipped arms at the tip, closed forms of offset and play, episodes that repeat."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments import load_arm
from surgsim_env.instruments.arm.joint_deviation import JointDeviation
from surgsim_env.scene import JointErrors, load_anatomy, make_scene, read_description

# Mean error of the tip of a da Vinci Research Kit before calibration [m]: Hwang 2020.
MEASURED = 2.96e-3


@pytest.mark.parametrize("name", ["psm_palpator", "psm_grasper", "psm_retractor"])
def test_shipped_errors_are_those_measured(name):
    arm = load_arm(name)
    offset, play = (np.array(getattr(arm.description.joint_errors, name)) for name in ("offset", "play"))
    joints = arm.home + np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0])
    rng = np.random.default_rng(0)
    draws = joints + rng.uniform(-offset, offset, (500, 6)) + rng.uniform(-play, play, (500, 6))
    tip = arm.tip_pose(joints).position
    errors = [np.linalg.norm(arm.tip_pose(row).position - tip) for row in draws]
    assert np.mean(errors) == pytest.approx(MEASURED, rel=0.1)


@pytest.fixture(scope="module")
def simulation():
    scene = make_scene("phantom")
    return Simulation(load_anatomy(replace(scene, instrument=replace(scene.instrument, model="psm_palpator"))))


def slide(**errors):
    """Errors of the insertion alone."""
    none = dict.fromkeys(("offset", "play", "drift"), 0.0)
    return JointErrors(**{name: (0.0, 0.0, value, 0.0, 0.0, 0.0) for name, value in (none | errors).items()})


def moved(simulation, errors, *velocities):
    """Tip less its reading [m] (3,) at rest after each velocity [m/s] (3,) of 0.25 s, above the organ."""
    arm = simulation.instrument.steered
    arm.deviation = JointDeviation(errors)
    simulation.instrument.draw_errors(np.random.default_rng(1))
    simulation.restart(simulation.instrument.parked)
    gaps = [arm.tip_position - arm.tip_reading]
    for velocity in velocities:
        for step in range(8):
            simulation.instrument.command_velocity(velocity if step < 5 else np.zeros(3))
            simulation.control_step(50)
            simulation.end_control_step()
        gaps.append(arm.tip_position - arm.tip_reading)
    return gaps


def test_a_joint_lags_by_its_play_on_both_ways(simulation):
    arm = simulation.instrument.steered
    _, into = arm.arm.shaft_line(arm.arm.home)
    simulation.restart(simulation.instrument.parked)
    into = arm.arm.shaft_line(arm.joint_positions)[1]
    still, out, back = moved(simulation, slide(play=5e-4), -0.02 * into, 0.02 * into)
    np.testing.assert_allclose(still, 0.0, atol=1e-12)
    np.testing.assert_allclose(out, 5e-4 * into, atol=1e-5)
    np.testing.assert_allclose(back, -5e-4 * into, atol=1e-5)


def test_an_offset_of_the_joints_moves_the_tip_by_the_jacobian(simulation):
    (gap,) = moved(
        simulation, JointErrors(offset=(0.01, 0.01, 0.001, 0.01, 0.01, 0.01), play=(0.0,) * 6, drift=(0.0,) * 6)
    )
    arm = simulation.instrument.steered
    expected = arm.arm.tip_jacobian(arm.joint_positions)[:3] @ arm.deviation.offset
    assert np.linalg.norm(gap) > 2e-4
    np.testing.assert_allclose(gap, expected, atol=0.02 * np.linalg.norm(gap))


def test_a_command_that_is_cut_short_leaves_the_tip_there(simulation):
    """As a press that meets its force limit; the first direction is against the play."""
    moved(simulation, read_description("psm_palpator").joint_errors, np.array([0.02, 0.02, 0.02]))
    arm = simulation.instrument.steered
    for velocity, count in ((np.full(3, -0.02), 20), (np.zeros(3), 50)):
        before = arm.tip_position
        simulation.instrument.command_velocity(velocity)
        simulation.control_step(count)
        simulation.end_control_step()
    assert np.linalg.norm(arm.tip_position - before) < 1e-4


def test_offsets_drift(simulation):
    start, later = moved(simulation, slide(drift=1e-3), np.zeros(3))
    drift = np.linalg.norm(later - start)
    assert 0.0 < drift == pytest.approx(0.4 * abs(simulation.instrument.steered.deviation.drift[2]))


def play(env, seed=0, steps=15):
    env.reset(seed=seed)
    return [env.step(np.array([0.2, 0.0, -0.3, 0.0], dtype=np.float32)) for _ in range(steps)]


def test_clinical_episodes_of_an_arm_have_errors_that_repeat_and_are_saved():
    env = gym.make("SurgSim/Palpate-v0", scene="phantom_small", instrument="psm_palpator", level="clinical").unwrapped
    first, again = play(env), play(env)
    assert all((one[0] == other[0]).all() for one, other in zip(first, again, strict=True))
    instrument = env.simulation.instrument
    gap = np.linalg.norm(instrument.tip_position - instrument.tip_reading)
    assert 2e-4 < gap < 8e-3
    seen = 0.01 * first[-1][0][:3] + 0.5 * (instrument.lower + instrument.upper)
    np.testing.assert_allclose(seen, instrument.tip_reading, atol=1e-6)
    state = env.save_state()
    ahead = [env.step(env.action_space.low * 0.1) for _ in range(5)]
    play(env, seed=1)
    assert np.linalg.norm(instrument.tip_position - instrument.tip_reading) != gap
    env.load_state(state)
    assert all((env.step(env.action_space.low * 0.1)[0] == one[0]).all() for one in ahead)


@pytest.mark.parametrize(("arm", "level"), [("psm_palpator", "standard"), ("six_axis", "clinical")])
def test_other_levels_and_arms_that_state_no_errors_are_exact(arm, level):
    env = gym.make("SurgSim/Palpate-v0", scene="phantom_small", instrument=arm, level=level).unwrapped
    play(env, steps=3)
    instrument = env.simulation.instrument
    assert instrument.steered.deviation.errors is None and (instrument.tip_reading == instrument.tip_position).all()


@pytest.mark.parametrize(("name", "values"), [("play", (-1.0,) * 6), ("offset", (0.1,)), ("drift", (np.inf,) * 6)])
def test_wrong_errors_are_refused(name, values):
    description = read_description("psm_palpator")
    with pytest.raises(ValueError, match=rf"joint_errors\.{name} is .* for 6 joints"):
        replace(description, joint_errors=replace(description.joint_errors, **{name: values}))
