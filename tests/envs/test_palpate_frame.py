"""Palpate-v0 in the frame of the face, and the length of its episodes by the size of the face."""

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from surgsim_env.palpation.chart import MAP_SIDE
from surgsim_env.tasks.palpate import EPISODE_STEPS, EPISODE_STEPS_WIDE

ID = "SurgSim/Palpate-v0"


@pytest.fixture(scope="module")
def liver():
    return gym.make(ID, scene="liver", memory=True, frame="face", scaled=False).unwrapped


def read(env, observation):
    return {name: observation[part].astype(np.float64) for name, part in env.observation_slices.items()}


def test_the_world_frame_has_no_further_channels():
    plain, turned = gym.make(ID), gym.make(ID, frame="face")
    assert plain.observation_space.shape == (11,) and turned.observation_space.shape == (20,)
    assert gym.make(ID, frame="face", memory=True).observation_space.shape == (11 + 3 * MAP_SIDE**2 + 3 + 12,)
    first, second = read(plain.unwrapped, plain.reset(seed=4)[0]), read(turned.unwrapped, turned.reset(seed=4)[0])
    for name in filter(lambda name: first[name].size, first):
        np.testing.assert_array_equal(first[name], second[name])


def test_place_depth_and_normal_are_those_of_the_surface_at_rest(liver):
    seen = read(liver, liver.reset(seed=11)[0])
    approach, tip = liver.simulation.anatomy.face.approach, seen["tip_position"]
    surface, normal = liver.simulation.anatomy.face.project(tip)
    radius, chart = liver.scene.instrument.tip_radius, liver.task.charted.chart
    assert seen["tip_depth"] == pytest.approx(radius - (tip - surface) @ normal, abs=1e-6)
    assert -0.006 <= seen["tip_depth"] <= -0.002, "an episode begins 2 to 6 mm above the surface"
    place = seen["tip_place"]
    # Sides of the chart, and heights against the approach.
    np.testing.assert_allclose(place[:2], 0.5 * chart.place(tip) * chart.extent, atol=1e-6)
    points = liver.simulation.anatomy.face.points[liver.simulation.anatomy.face.triangles]
    assert place[2] == pytest.approx(tip @ -approach - (points @ -approach).max(), abs=1e-6)
    assert seen["surface_normal"][2] == pytest.approx(normal @ -approach, abs=1e-6)
    assert np.linalg.norm(seen["surface_normal"]) == pytest.approx(1.0, abs=1e-6)
    assert np.linalg.norm(seen["face_force"]) == pytest.approx(np.linalg.norm(seen["contact_force"]), abs=1e-6)
    cell = seen["map_cell"][0] * radius
    np.testing.assert_allclose(seen["chart_share"] * (MAP_SIDE - 1) * cell, chart.extent, rtol=1e-5)


@pytest.mark.parametrize("axis", range(3))
def test_a_command_moves_the_tip_along_an_axis_of_the_face(liver, axis):
    before = read(liver, liver.reset(seed=11)[0])
    action = np.zeros(4, dtype=np.float32)
    # Outward at the end, away from the tissue.
    action[axis] = 0.5
    for _ in range(6):
        observation = liver.step(action)[0]
    moved = read(liver, observation)["tip_place"] - before["tip_place"]
    assert moved[axis] > 0.0015
    assert np.abs(np.delete(moved, axis)).max() < 0.1 * moved[axis]
    # The action of a velocity in the world is that of the frame.
    world = liver.task.frame.axes[axis] * 0.01
    np.testing.assert_allclose(liver.layout.action(world)[:3], action[:3], atol=1e-7)


def test_a_member_of_a_family_has_its_own_frame():
    env = gym.make(ID, scene="kidney_family", frame="face").unwrapped
    env.reset(seed=1)
    first = env.task.frame
    env.reset(seed=2)
    assert not np.array_equal(first.origin, env.task.frame.origin)


def test_an_episode_is_longer_on_a_wide_face(liver):
    """60 s where the chart is longer than ten tip radii: in time_left, at the end, in lanes, in the page's number."""
    assert gym.make(ID).unwrapped.task.episode_steps == EPISODE_STEPS == 600
    assert liver.task.episode_steps == EPISODE_STEPS_WIDE == 1200
    liver.reset(seed=3)
    observation, _, _, truncated, _ = liver.step(np.zeros(4, dtype=np.float32))
    assert read(liver, observation)["time_left"] == pytest.approx(1.0 - 1.0 / 1200, abs=1e-6) and not truncated
