"""SurgSim/PalpateSites-v0: its press, its chart, what is felt and believed, what it pays, and many side by side."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from msdm_core.material import Relaxation
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.palpation import chart as healthy_module
from surgsim_env.palpation.chart import charted_face, healthy_map, interpolated
from surgsim_env.palpation.site_press import (
    HOLD_TIME,
    PRESS_SPEED,
    SitePress,
    press,
    press_alone,
    press_phases,
    stop_force,
)
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.levels import LEVELS, DrawnOrgan
from surgsim_env.scene.load import make_scene
from surgsim_env.tasks import palpate_sites
from surgsim_env.tasks.declaration import reward_weights
from surgsim_env.tasks.palpate_sites import PalpateSitesTask

ID = "SurgSim/PalpateSites-v0"
SMALL = {"scene": "phantom_small"}
MIDDLE = np.zeros(2, dtype=np.float32)


def small_anatomy(level: str = "standard"):
    return load_anatomy(LEVELS[level].scene(make_scene("phantom_small")))


def raster(side: int) -> np.ndarray:
    axis = (2.0 * np.arange(side) + 1.0) / side - 1.0
    return np.array([[u, v] for v in axis for u in axis], dtype=np.float32)


def play(env: gym.Env, seed: int, actions: np.ndarray) -> list[tuple]:
    env.reset(seed=seed)
    return [env.step(action) for action in actions]


# ---- the press ------------------------------------------------------------------------------------------------------


def full_phases(scene):
    """Phases of a press with its whole rest."""
    return tuple(replace(phase, settles=False) for phase in press_phases(scene))


def test_a_press_feels_what_the_scan_feels():
    """The same way in and hold; the mean is over four readings in 40 ms instead of forty."""
    simulation = Simulation(small_anatomy())
    site = charted_face(simulation.anatomy).site([0.2, -0.3])
    simulation.reset(simulation.anatomy.organ(), simulation.instrument.parked)
    result = press_alone(SitePress(simulation, site.point, site.normal), full_phases(simulation.anatomy.scene))
    expected = press(simulation, site.point, site.normal)
    assert not result.stopped and not result.fault and not expected.end
    assert result.force @ site.normal == pytest.approx(expected.force, rel=2e-3)
    assert result.depth == pytest.approx(expected.depth, rel=1e-3)
    assert result.force_peak == pytest.approx(expected.force_peak, rel=1e-12)
    assert result.duration == pytest.approx(expected.duration)


def test_a_press_ends_once_its_readings_agree_to_the_noise():
    """Sooner than its longest rest, with a contrast that changes by much less than the noise of a reading."""
    anatomy = small_anatomy()
    scene, simulation = anatomy.scene, Simulation(anatomy)
    site = charted_face(anatomy).site(MIDDLE)
    lesion = anatomy.lesion_below(site.point, 0.005, 0.003, 6.0, "hidden")

    def felt(phases):
        for organ in (anatomy.organ(), anatomy.organ((lesion,))):
            simulation.reset(organ, simulation.instrument.parked)
            yield press_alone(SitePress(simulation, site.point, site.normal), phases)

    def contrast(healthy, hard):
        return (hard.force @ site.normal / hard.depth) / (healthy.force @ site.normal / healthy.depth)

    early, full = list(felt(press_phases(scene))), list(felt(full_phases(scene)))
    assert all(one.duration < 0.9 * other.duration for one, other in zip(early, full, strict=True))
    noise = scene.sensor.noise / (early[0].force @ site.normal)
    assert contrast(*full) > 1.1
    assert contrast(*early) == pytest.approx(contrast(*full), rel=0.25 * noise)


def test_readings_without_noise_and_relaxing_tissue_take_their_full_rest():
    anatomy = small_anatomy()
    arms = replace(anatomy.scene.material, relaxation=Relaxation((0.3,), (0.05,)))
    for scene in (
        replace(anatomy.scene, sensor=replace(anatomy.scene.sensor, noise=0.0)),
        replace(anatomy.scene, material=arms),
    ):
        simulation = Simulation(replace(anatomy, scene=scene))
        site = charted_face(anatomy).site(MIDDLE)
        simulation.reset(simulation.anatomy.organ(), simulation.instrument.parked)
        result = press_alone(SitePress(simulation, site.point, site.normal), press_phases(scene))
        whole = (scene.palpation.clearance + scene.palpation.press_depth) / PRESS_SPEED + HOLD_TIME
        assert result.duration == pytest.approx(whole, abs=2.0 * scene.timing.haptic_step)


def test_the_organ_is_at_rest_again_before_the_next_press():
    """Displacement after a press and a move at 20 mm/s to the nearest site: below 0.1 % of the press depth."""
    simulation = Simulation(small_anatomy())
    scene = simulation.anatomy.scene
    simulation.reset(simulation.anatomy.organ(), simulation.instrument.parked)
    rest = simulation.organ_state.node_position.copy()
    site = charted_face(simulation.anatomy).site(MIDDLE)
    press_alone(SitePress(simulation, site.point, site.normal), press_phases(scene))
    assert np.abs(simulation.organ_state.node_position - rest).max() > 0.8 * scene.palpation.press_depth
    # Up by press depth and clearance, and over to the next site, half a tip radius on: 9 mm.
    simulation.instrument.command_velocity(0.02 * site.normal)
    simulation.control_step(round(0.009 / 0.02 / scene.timing.haptic_step))
    left = np.linalg.norm(simulation.organ_state.node_position - rest, axis=1).max()
    print(f"\nleft of the press: {left * 1e6:.2f} um of {scene.palpation.press_depth * 1e3:g} mm")
    assert left < 0.001 * scene.palpation.press_depth


@pytest.mark.slow
def test_force_stops_a_press_before_the_hard_limit_does():
    """On an organ four times as stiff: the tip stops above the stop force, below the hard limit, and not as deep."""
    anatomy = small_anatomy()
    simulation = Simulation(anatomy)
    simulation.reset(anatomy.organ(modulus_factor=4.0), simulation.instrument.parked)
    site = charted_face(anatomy).site(MIDDLE)
    result = press_alone(SitePress(simulation, site.point, site.normal), press_phases(anatomy.scene))
    limits = anatomy.scene.limits
    assert result.stopped and not result.fault
    assert stop_force(limits) < result.force_peak < limits.hard_force
    assert result.depth < 0.9 * anatomy.scene.palpation.press_depth
    # Its stiffness still tells: not quite four times the healthy one, as it rises with depth and contact stays as soft.
    healthy = float(healthy_map(make_scene("phantom_small")).stiffness(MIDDLE))
    assert 3.0 * healthy < result.force @ site.normal / result.depth < 4.0 * healthy


# ---- the chart ------------------------------------------------------------------------------------------------------


def test_a_place_beyond_the_liver_is_moved_to_its_nearest_site():
    anatomy = load_anatomy(make_scene("liver"))
    charted = charted_face(anatomy)
    corner = charted.site([-1.0, -1.0])
    assert corner.moved > 0.005
    way = 0.5 * (corner.place - [-1.0, -1.0]) * charted.chart.extent
    assert corner.moved == pytest.approx(float(np.linalg.norm(way)))
    for site in (corner, charted.site([0.1, 0.2])):
        assert anatomy.face.rim_distance(site.point) >= anatomy.scene.palpation.face_margin - 1e-9
        np.testing.assert_allclose(charted.chart.place(site.point), site.place, atol=1e-9)
    # Between points that were dropped onto it the surface is a little off, far less than an estimate.
    inside = charted.site([0.1, 0.2])
    assert np.linalg.norm(charted.surface(inside.place) - inside.point) < 1e-3


def test_interpolation_is_exact_for_bilinear_values():
    axis = np.linspace(-1.0, 1.0, 4)
    columns, rows = np.meshgrid(axis, axis)
    values = 2.0 + 3.0 * columns - rows + 0.5 * columns * rows
    places = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 2))
    u, v = places.T
    np.testing.assert_allclose(interpolated(values, places), 2.0 + 3.0 * u - v + 0.5 * u * v, rtol=1e-12)
    assert interpolated(values, [5.0, -1.0]) == values[0, -1], "beyond the chart its border counts"


# ---- the healthy map ------------------------------------------------------------------------------------------------


def test_healthy_tissue_of_nominal_modulus_has_contrast_one(monkeypatch):
    """Without lesions, noise and bias, between the map's points too: within the mesh's 3 %."""
    env = gym.make(ID, **SMALL).unwrapped
    env.reset(seed=0)
    task = env.task
    healthy = DrawnOrgan((), 1.0, 0.0)
    monkeypatch.setattr(type(task.level), "draw", lambda *_, **__: healthy)
    task.reading.sensor = replace(task.reading.sensor, noise=0.0, bias=0.0)
    records = play(env, 1, np.random.default_rng(2).uniform(-1.0, 1.0, (6, 2)).astype(np.float32))
    np.testing.assert_allclose([np.log(record[-1]["contrast"]) for record in records], 0.0, atol=0.03)
    assert records[-1][-1]["lesion_count_estimated"] == 0.0 and records[-1][-1]["found"] == 1.0


def test_the_map_is_made_once_for_an_organ(tmp_path, monkeypatch):
    monkeypatch.setenv("SURGSIM_CACHE", str(tmp_path / "cache"))
    made = []

    def pressed(anatomy, progress, dtype, between=1):
        made.append(anatomy.scene.name)
        return np.full((13, 13, 3), 50.0)

    monkeypatch.setattr(healthy_module, "_pressed", pressed)
    scene = make_scene("phantom_small")
    for times in (1, 1):
        healthy_module.healthy_map_of.cache_clear()
        assert healthy_module.healthy_map(scene).stiffness(MIDDLE) == 50.0
        assert len(made) == times
    healthy_module.healthy_map_of.cache_clear()
    healthy_module.healthy_map(replace(scene, material=replace(scene.material, youngs_modulus=6000.0)))
    assert len(made) == 2, "another organ has another map"
    healthy_module.healthy_map_of.cache_clear()


# ---- episodes -------------------------------------------------------------------------------------------------------


def test_presses_are_felt_remembered_and_believed():
    env = gym.make(ID, level="easy", budget=16, **SMALL).unwrapped
    records = play(env, 2, raster(4))
    task = env.task
    for count, (observation, _, terminated, truncated, info) in enumerate(records, start=1):
        assert observation[env.observation_slices["pressed_map"]].sum() == count
        assert observation[-1] == pytest.approx(1.0 - count / 16.0)
        assert (terminated, truncated) == (count == 16, False)
        site = task.charted.touch_map.nearest(observation[-6:-4])
        assert observation[site] == observation[-2] == pytest.approx(np.log(info["contrast"]), abs=1e-6)
        assert info["stiffness"] == info["force"] / info["depth"]
        assert 0.9 * 0.004 < info["depth"] < 0.004
        assert not info["sim_fault"] and not info["hard_limit"] and info["moved_mm"] == 0.0
    last = records[-1][-1]
    assert last["error_mm"] < 5.0 and last["found"] == 1.0 and last["success"]
    assert last["lesion_count_estimated"] == 1.0
    # Steps of 7.5 mm in four rows and three ways back at 20 mm/s; the way off; presses of 125 ms and a rest of 40 ms at
    # least and 100 ms at most.
    way = 12 * 0.0075 + 3 * np.hypot(0.0075, 0.0225)
    assert last["path_length"] == pytest.approx(way + 32 * 0.005, rel=0.01)
    presses = last["seconds"] - (way + 16 * 0.005) / 0.02
    assert 16 * 0.164 < presses < 16 * 0.226
    with pytest.raises(gym.error.ResetNeeded):
        env.step(MIDDLE)


def test_without_memory_the_last_press_alone_is_observed():
    actions = raster(2)
    with_memory = play(gym.make(ID, **SMALL), 4, actions)
    without = play(gym.make(ID, memory=False, **SMALL), 4, actions)
    for record, other in zip(with_memory, without, strict=True):
        np.testing.assert_array_equal(record[0][-6:], other[0])
        assert record[1:] == other[1:]


@pytest.mark.parametrize("scene", ["phantom", "phantom_small"])
def test_the_info_of_a_reset_does_not_tell_of_lesions(scene):
    """On `phantom` stiff lesions need added mass: among these seeds are three with, and one without lesions."""
    env = gym.make(ID, scene=scene).unwrapped
    infos = [env.reset(seed=seed)[1] for seed in (1, 3, 7, 8)]
    assert all(info == infos[0] for info in infos) and (infos[0]["error_mm"], infos[0]["found"]) == (-1.0, 0.0)
    assert len(env.task.truth) and env.reset(seed=3) and not len(env.task.truth)


def test_what_is_found_pays_by_its_change():
    """However often it is found and lost: the terms sum to what it ends with less what it began with."""
    for seed in (0, 1, 5):
        env = gym.make(ID, budget=9, **SMALL).unwrapped
        env.reset(seed=seed)
        began = env.task.found
        records = [env.step(action) for action in raster(3)]
        assert sum(record[-1]["reward_found"] for record in records) == pytest.approx(records[-1][-1]["found"] - began)
        errors = [record[-1]["error_mm"] / 20.0 / 9 for record in records]
        assert [-record[-1]["reward_error"] for record in records] == pytest.approx(errors)


def test_harm_never_pays():
    """The reckoning that stands beside the weights, for every number of presses made of the budget."""
    weights = reward_weights(PalpateSitesTask)
    assert weights["forgone"] == weights["error"] + weights["soft_force"]
    for done in np.linspace(0.0, 1.0, 11):
        for found_first in (0.0, 1.0):
            full = weights["error"] + weights["soft_force"] - found_first
            for harm in ("hard_force", "fault"):
                failed = (1.0 - found_first) * weights["found"] + weights[harm] + (1.0 - done) * weights["forgone"]
                assert full >= failed + 0.25 - 1e-12


def test_a_fault_ends_the_episode_with_the_last_finite_observation():
    env = gym.make(ID, **SMALL).unwrapped
    env.reset(seed=3)
    before = env.step(MIDDLE)[0]
    env.simulation._rest_position[40] = np.nan
    observation, reward, terminated, truncated, info = env.step(np.array([0.5, 0.5], dtype=np.float32))
    assert terminated and not truncated and info["sim_fault"]
    np.testing.assert_array_equal(observation, before)
    assert info["reward_fault"] == -2.5 and info["reward_forgone"] == pytest.approx(-1.25 * 23 / 25)
    assert reward < -3.0


def test_the_budget_of_a_wide_scene_is_larger(monkeypatch):
    flat = healthy_module.HealthyMap(np.full((25, 25, 3), 55.0))
    monkeypatch.setattr(palpate_sites, "healthy_map_of", lambda *_: flat)
    assert gym.make(ID, scene="phantom_wide").unwrapped.task.budget == 40
    assert gym.make(ID, scene="phantom_wide", budget=7).unwrapped.task.budget == 7


# ---- many side by side ----------------------------------------------------------------------------------------------


def test_a_press_that_was_begun_is_forgotten_with_its_episode():
    env = gym.make(ID, **SMALL).unwrapped
    env.reset(seed=9)
    saved = env.save_state()
    expected = env.step(MIDDLE)
    for forget in (lambda: env.reset(seed=9), lambda: env.load_state(saved)):
        env.begin(np.ones(2))
        forget()
        result = env.step(MIDDLE)
        np.testing.assert_array_equal(result[0], expected[0])
        assert result[1:] == expected[1:]
