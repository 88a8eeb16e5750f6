"""Environments on tissue that stiffens and relaxes keep the promises that those on linear tissue keep."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from msdm_core import Relaxation, Stiffening
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.palpation.press import SitePress, press_alone, press_phases
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.save import scene_toml

IDS = ("SurgSim/Palpate-v0", "SurgSim/PalpateSites-v0")


@pytest.fixture(scope="module")
def scene():
    plain = make_scene("phantom_small")
    material = replace(
        plain.material,
        stiffening=Stiffening(onset_strain=0.05, cap_strain=0.2, tangent_cap=8.0),
        relaxation=Relaxation(relative_moduli=(0.3, 0.3), times=(0.05, 0.5)),
    )
    return replace(plain, name="measured", material=material)


@pytest.fixture(scope="module")
def scene_file(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "measured.toml"
    path.write_text(scene_toml(scene))
    return str(path)


def press_once(simulation, scene):
    point = np.array([0.5, 0.5, 1.0]) * np.ptp(simulation.anatomy.mesh.points, axis=0)
    return press_alone(SitePress(simulation, point, np.array([0.0, 0.0, 1.0])), press_phases(scene))


def test_a_second_press_equals_the_first(scene):
    """A restart brings Maxwell arms to rest too."""
    simulation = Simulation(load_anatomy(scene))
    first, second = press_once(simulation, scene), press_once(simulation, scene)
    assert first.force_peak > 0.1
    np.testing.assert_array_equal(second.force, first.force)
    assert second.force_peak == first.force_peak


@pytest.mark.parametrize("env_id", IDS)
def test_a_saved_state_continues_as_the_episode_did(env_id, scene_file):
    """To the bit, with what the arms have given way to."""
    env = gym.make(env_id, scene=scene_file)
    env.reset(seed=1)
    env.action_space.seed(1)
    actions = [env.action_space.sample() for _ in range(6)]
    for action in actions[:3]:
        env.step(action)
    state = env.unwrapped.save_state()
    later = [env.step(action)[:2] for action in actions[3:]]
    env.reset(seed=2)
    env.unwrapped.load_state(state)
    for action, (observation, reward) in zip(actions[3:], later):
        again, same, *_ = env.step(action)
        np.testing.assert_array_equal(again, observation)
        assert same == reward
