"""The force sensor's errors: drift and hysteresis, and what levels make of them."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_env.coupling.sensors import ForceReading
from surgsim_env.scene.levels import LEVELS
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import ForceSensor

QUIET = ForceSensor(noise=0.0, bias=0.0, range=2.0)
RNG = np.random.default_rng(0)


def readings(sensor: ForceSensor, forces: list[float]) -> list[float]:
    reading = ForceReading(sensor)
    reading.reset(RNG)
    return [float(reading.read(np.array([0.0, 0.0, force]), RNG, 0.0)[0][2]) for force in forces]


def test_hysteresis_is_a_loop_of_twice_its_value():
    """The play operator: behind by its value on the way up, ahead by it on the way down, still where the way turns."""
    sensor = replace(QUIET, hysteresis=0.01)
    up, down = readings(sensor, [0.0, 0.1, 0.5, 0.495, 0.48, 0.1, 0.0])[1:3], readings(sensor, [0.5, 0.495, 0.48, 0.1])
    np.testing.assert_allclose(up, [0.09, 0.49])
    np.testing.assert_allclose(down, [0.49, 0.49, 0.49, 0.11])
    assert readings(QUIET, [0.1, 0.5, 0.495]) == [0.1, 0.5, 0.495]


def test_drift_is_drawn_once_and_grows_with_time():
    reading = ForceReading(replace(QUIET, drift=0.001))
    reading.reset(np.random.default_rng(1))
    assert (np.abs(reading.drift) <= 0.001).all() and np.ptp(reading.drift) > 0.0
    for time in (0.0, 10.0, 40.0):
        np.testing.assert_allclose(reading.read(np.zeros(3), RNG, time)[0], reading.drift * time)


def test_a_plain_sensor_draws_what_it_did():
    """A sensor without drift takes no further random numbers, so that episodes of seeds stay what they were."""
    first, second = np.random.default_rng(3), np.random.default_rng(3)
    reading = ForceReading(replace(QUIET, bias=0.02))
    reading.reset(first)
    np.testing.assert_array_equal(reading.bias, second.uniform(-0.02, 0.02, 3))
    assert first.random() == second.random()


def test_clinical_has_all_that_a_patient_brings():
    scene, level = make_scene("phantom_small"), LEVELS["clinical"]
    made = level.scene(scene)
    assert made.sensor.drift == pytest.approx(2e-4 * scene.sensor.range)
    assert made.sensor.hysteresis == pytest.approx(0.005 * scene.sensor.range)
    law, own = made.material, scene.material
    assert law.stiffening is not None and law.relaxation is not None
    assert (law.youngs_modulus, law.density) == (own.youngs_modulus, own.density)
    assert made.timing.substep_count == 2 * scene.timing.substep_count
    env = gym.make("SurgSim/Palpate-v0", scene="phantom_small", level="clinical").unwrapped
    assert env.scene.motions and not gym.make("SurgSim/Palpate-v0", scene="phantom_small").unwrapped.scene.motions
    still = gym.make("SurgSim/Palpate-v0", scene="phantom_small", level="clinical", motion="none").unwrapped
    assert not still.scene.motions
