"""Limits on what tissue bears, in `info` and as the end of an episode."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from msdm_core.material import Stiffening
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.save import as_toml

DOWN = np.array([0.0, 0.0, -1.0], dtype=np.float32)


def written(tmp_path, **limits):
    scene = make_scene("phantom_small")
    path = tmp_path / "limited.toml"
    path.write_text(as_toml(replace(scene, limits=replace(scene.limits, **limits))))
    return str(path)


def made(tmp_path, **limits):
    return gym.make("SurgSim/Palpate-v0", scene=written(tmp_path, **limits))


def pressed(env, steps=60):
    """Press down until the episode ends, and one info per control step."""
    env.reset(seed=0)
    infos = []
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    action[:3] = DOWN
    for _ in range(steps):
        _, reward, terminated, truncated, info = env.step(action)
        infos.append((reward, info))
        if terminated or truncated:
            break
    return infos


def test_an_infinite_limit_measures_only(tmp_path):
    infos = pressed(made(tmp_path, strain=np.inf))
    assert infos[-1][1]["hard_limit"] and not infos[-1][1]["damaged"]
    strains = [info["tissue_strain"] for _, info in infos]
    pressures = [info["tissue_pressure"] for _, info in infos]
    assert strains[0] < 0.01 < 0.1 < max(strains) and max(pressures) > 1000.0


def test_a_strain_beyond_the_law_is_extrapolated(tmp_path):
    """The flag follows the scene's bound, and is never set where the material has none."""
    scene = make_scene("phantom_small")
    law = Stiffening(0.1, 0.3, 2.0, strain_supported=0.12)
    path = tmp_path / "supported.toml"
    limits, material = replace(scene.limits, strain=np.inf), replace(scene.material, stiffening=law)
    path.write_text(as_toml(replace(scene, limits=limits, material=material)))
    infos = [info for _, info in pressed(gym.make("SurgSim/Palpate-v0", scene=str(path)))]
    flags = [info["tissue_extrapolated"] for info in infos]
    # Tissue is softest to shear: its equivalent strain is within a fifth of the principal strain.
    assert all(flag for flag, info in zip(flags, infos) if info["tissue_strain"] > 1.2 * 0.12)
    assert not any(flag for flag, info in zip(flags, infos) if info["tissue_strain"] < 0.12 / 1.2)
    assert {*flags} == {False, True}
    assert not any(info["tissue_extrapolated"] for _, info in pressed(made(tmp_path, strain=np.inf)))


@pytest.mark.parametrize(
    ("limit", "entry"),
    [({"strain": 0.15}, "tissue_strain"), ({"pressure": 1500.0}, "tissue_pressure"), ({"dose": 200.0}, "tissue_dose")],
)
def test_too_much_ends_the_episode_as_a_safety_stop(tmp_path, limit, entry):
    infos = pressed(made(tmp_path, **limit))
    (most,) = limit.values()
    assert [info["damaged"] for _, info in infos] == [False] * (len(infos) - 1) + [True]
    assert infos[-1][1][entry] > most >= max(info[entry] for _, info in infos[:-1])
    assert not infos[-1][1]["hard_limit"] and not infos[-1][1]["success"]
    assert infos[-1][0] < -1.0


@pytest.mark.parametrize("steps_per_control", [50, 20])
def test_dose_of_a_held_press_is_pressure_times_time(tmp_path, steps_per_control):
    """A ball held still: its pressure is constant to 1e-3, and the dose rises by p t at the node below it."""
    scene = make_scene(written(tmp_path, dose=1e5))
    simulation = Simulation(load_anatomy(scene))
    face = simulation.anatomy.face
    middle = face.points.mean(axis=0)
    top = simulation.anatomy.mesh.points[:, 2].max()
    simulation.reset(simulation.organ_model, np.array([middle[0], middle[1], top + scene.instrument.tip_radius]))

    def advance(seconds, velocity):
        for _ in range(round(seconds / (steps_per_control * simulation.haptic_dt))):
            simulation.instrument.command_velocity(np.array([0.0, 0.0, velocity]))
            simulation.control_step(steps_per_control)
            assert simulation.end_control_step(), simulation.fault

    advance(0.2, -0.01)
    advance(1.0, 0.0)
    before, start = simulation.tissue_load, simulation.node_dose.copy()
    advance(1.0, 0.0)
    after, risen = simulation.tissue_load, simulation.node_dose - start
    assert after.pressure == pytest.approx(before.pressure, rel=1e-3) and after.pressure > 1000.0
    assert risen[after.pressure_node] == pytest.approx(after.pressure * 1.0, rel=1e-3)
    assert risen.max() == risen[after.pressure_node]
    assert simulation.tissue_dose == simulation.node_dose.max()
    np.testing.assert_array_equal(simulation.damage, simulation.node_dose / 1e5)
    assert 0.0 < simulation.damage.max() < 1.0


def test_dose_adds_the_pressure_at_the_end_of_each_control_step(tmp_path):
    """The probe goes straight down: the largest of pressure and dose are of one node once it presses."""
    env = made(tmp_path, dose=np.inf)
    infos = [info for _, info in pressed(env)]
    doses = np.array([info["tissue_dose"] for info in infos])
    duration = env.unwrapped.scene.timing.control_step
    upper = duration * np.cumsum([info["tissue_pressure"] for info in infos])
    assert (doses[:-1] <= upper[:-1] * (1.0 + 1e-12)).all() and doses[-2] > 0.7 * upper[-2]
    # The step beyond the hard limit is cut short.
    assert doses[-2] < doses[-1] < upper[-1]
    assert env.reset(seed=1)[1]["tissue_dose"] == env.unwrapped.simulation.tissue_dose == 0.0


def test_a_dose_goes_on_in_a_saved_state(tmp_path):
    env, other = made(tmp_path, dose=np.inf).unwrapped, made(tmp_path, dose=np.inf).unwrapped
    pressed(env, steps=8)
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    other.reset(seed=5)
    other.load_state(env.save_state())
    assert other.simulation.tissue_dose == env.simulation.tissue_dose > 0.0
    doses = [[lane.step(action)[4]["tissue_dose"] for _ in range(3)] for lane in (env, other)]
    assert doses[0] == doses[1]
    assert doses[0][0] < doses[0][2]


def test_side_by_side_doses_are_those_alone(tmp_path):
    scene, count = written(tmp_path, dose=np.inf), 3
    vector = {"vectorization_mode": "vector_entry_point", "autoreset_mode": "Disabled"}
    lanes = gym.make_vec("SurgSim/Palpate-v0", num_envs=count, scene=scene, **vector)
    actions = np.zeros(lanes.action_space.shape, dtype=np.float32)
    actions[:, :3] = DOWN
    actions[1, :3] *= 0.8
    lanes.reset(seed=[3, 4, 5])
    together = [lanes.step(actions)[4]["tissue_dose"] for _ in range(8)]
    for lane in range(count):
        alone = gym.make("SurgSim/Palpate-v0", scene=scene)
        alone.reset(seed=3 + lane)
        doses = [alone.step(actions[lane])[4]["tissue_dose"] for _ in range(8)]
        assert doses == [step[lane] for step in together] and doses[-1] > 0.0


def test_presses_at_one_site_add_their_doses(tmp_path):
    """Each press starts from rest: the second adds what the first did, and a press elsewhere nothing to the largest."""
    env = gym.make("SurgSim/PalpateSites-v0", scene=written(tmp_path, dose=np.inf), level="easy")
    env.reset(seed=0)
    here, there = np.array([-0.5, -0.5], dtype=np.float32), np.array([0.5, 0.5], dtype=np.float32)
    first, second, third = (env.step(place)[4] for place in (here, here, there))
    assert first["tissue_dose"] > 0.0
    assert second["tissue_dose"] == pytest.approx(2.0 * first["tissue_dose"], rel=1e-12)
    assert third["tissue_dose"] == second["tissue_dose"]
    # Inward for 0.1 s, at rest for at most 0.1 s.
    assert 0.04 < first["tissue_dose"] / first["tissue_pressure"] < 0.2


@pytest.mark.parametrize("limit", [{"dose": 0.0}, {"dose": -1.0}, {"dose": np.nan}, {"pressure": 0.0}])
def test_a_limit_above_0_is_the_rule(tmp_path, limit):
    ((name, _),) = limit.items()
    with pytest.raises(ValueError, match=f"limits.{name} is"):
        replace(make_scene("phantom_small").limits, **limit)


def test_load_is_measured_without_limits_and_changes_nothing():
    """`measure_tissue` adds entries of `info`; observations and rewards keep their bits."""
    plain, measured = (
        gym.make("SurgSim/Palpate-v0", scene="phantom_small", **own) for own in ({}, {"measure_tissue": True})
    )
    (rewards, infos), (same, more) = (zip(*pressed(env, steps=10), strict=True) for env in (plain, measured))
    assert rewards == same
    np.testing.assert_array_equal(plain.unwrapped.observation, measured.unwrapped.observation)
    added = {"tissue_pressure", "tissue_strain", "tissue_extrapolated", "damaged"}
    assert all(
        {name: info[name] for name in info if name not in added} == least
        for info, least in zip(more, infos, strict=True)
    )
    assert more[-1]["tissue_pressure"] > 1000.0 and more[-1]["tissue_strain"] > 0.05
