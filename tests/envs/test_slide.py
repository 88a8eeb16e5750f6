"""SurgSim/Slide-v0: the tip holds its force and stays on the face; the map's score, and when the true map is shown."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from surgsim_env.palpation.scores import dice
from surgsim_env.tasks.declaration import reward_weights
from surgsim_env.tasks.slide import DOSE, SlideTask

BLOCK = {"scene": "phantom_small", "level": "easy", "episode_steps": 40}


def action(slide=(0.0, 0.0), press=0.4, lesions=()):
    """An action with a map of rows (presence, across, along, radius)."""
    rows = np.full((3, 4), -1.0)
    for row, lesion in zip(rows, lesions):
        row[:] = lesion
    return np.concatenate([slide, [press], rows.ravel()]).astype(np.float32)


def true_rows(task):
    """The true map as an action declares it."""
    assert task.true_map[:, 2].tolist() == [lesion.radius for lesion in task.lesions]
    return [(1.0, across, along, radius / task.charted.tip_radius - 1.0) for across, along, radius in task.true_map]


@pytest.fixture
def made():
    env: Any = gym.make("SurgSim/Slide-v0", scaled=False, **BLOCK)
    env.reset(seed=3)
    return env


def test_a_resting_tip_holds_the_set_point_of_its_force(made):
    task = made.unwrapped.task
    for _ in range(30):
        made.step(action(press=0.5))
    force = np.linalg.norm(made.unwrapped.simulation.contact_force)
    # The sensor's bias is the controller's error.
    assert force == pytest.approx(0.5 * task.limits.soft_force, abs=2.0 * task.anatomy.scene.sensor.bias + 0.02)


def test_a_negative_set_point_lifts_the_tip(made):
    for _ in range(15):
        made.step(action(press=0.5))
    for _ in range(20):
        made.step(action(press=-0.1))
    simulation, task = made.unwrapped.simulation, made.unwrapped.task
    assert simulation.contact_centre is None
    assert task.tip_depth == pytest.approx(-0.5 * task.charted.tip_radius, rel=0.05)


@pytest.mark.parametrize("way", [(1.0, 0.0), (0.0, -1.0), (-0.7, 0.7)])
def test_the_tip_stays_on_pressable_sites(made, way):
    task = made.unwrapped.task
    chart, touch_map = task.charted.chart, task.charted.touch_map
    sites = chart.lower + touch_map.sites[touch_map.pressable]
    for _ in range(35):
        made.step(action(way))
        away = np.linalg.norm(sites - chart.plane_point(task.place), axis=1).min()
        assert away < touch_map.cell
    assert np.abs(task.place).max() > 0.8, "the way must lead to the border to prove anything"


def test_the_tip_slides_at_the_commanded_speed(made):
    task = made.unwrapped.task
    for _ in range(15):
        made.step(action((-1.0, 0.0)))
    before = task.charted.chart.plane_point(task.place)
    for _ in range(4):
        made.step(action((0.5, 0.0)))
    way = task.charted.chart.plane_point(task.place) - before
    # The first step turns round.
    assert way[0] == pytest.approx(0.5 * 4.0 * task.charted.tip_radius * 0.2, rel=0.2)
    assert abs(way[1]) < 0.1 * way[0]


def test_the_true_map_has_the_full_score_and_pays_it_in_each_step(made):
    task = made.unwrapped.task
    _, reward, *_, info = made.step(action(lesions=true_rows(task)))
    # A radius of the action, and the surface between the sites of its table, are rounded.
    assert info["dice"] == pytest.approx(1.0, abs=0.03) and info["error_mm"] < 0.5
    assert task.score == pytest.approx(1.0, abs=0.05)
    assert info["map_score"] == pytest.approx(task.score / 40) == pytest.approx(reward)


def test_a_false_map_scores_less_than_an_empty_one_of_an_organ_without_lesions(made):
    task = made.unwrapped.task
    task.lesions, task.drawn = (), type(task.drawn)(())
    assert made.step(action())[-1]["map_score"] == 1.0 / 40
    _, _, _, _, info = made.step(action(lesions=[(1.0, 0.0, 0.0, 0.0)]))
    assert info["dice"] == 0.0 and info["error_mm"] == pytest.approx(1000.0 * task.cutoff)


def test_only_the_last_info_shows_the_true_map(made):
    names = [f"lesion_1_{part}" for part in ("presence", "across", "along", "radius")]
    *_, info = made.step(action())
    assert [info[name] for name in names] == [-1.0] * 4
    over = False
    while not over:
        _, _, terminated, truncated, info = made.step(action())
        over = terminated or truncated
    assert terminated and not truncated
    assert [info[name] for name in names] == pytest.approx(list(true_rows(made.unwrapped.task)[0]))
    assert info["lesion_2_presence"] == -1.0


def test_the_error_of_registration_moves_the_known_surface_and_not_the_tip():
    settings = {"scene": "kidney_family", "motion": "none", "scaled": False}
    exact, shifted = (gym.make("SurgSim/Slide-v0", level=level, **settings) for level in ("standard", "clinical"))
    shifted.reset(seed=2)
    tasks: list[Any] = [env.unwrapped.task for env in (exact, shifted)]
    exact.reset(seed=2)
    offsets = [np.linalg.norm(task.registration) for task in tasks]
    assert offsets[0] == 0.0 and offsets[1] > 0.0001
    task, tip = tasks[1], shifted.unwrapped.simulation.instrument.tip_position
    assert task.place == pytest.approx(task.charted.chart.place(tip))
    _, normal = task.anatomy.face.project(tip)
    assert not np.allclose(task.surface_normal, normal, atol=1e-4)


def test_dice_of_masks():
    first, second = np.array([1, 1, 0, 0], dtype=bool), np.array([0, 1, 1, 1], dtype=bool)
    assert dice(first, second) == pytest.approx(2 / 5)
    assert dice(first & second & ~second, ~first & first) == 1.0 and dice(first, ~first) == 0.0


def test_a_scene_without_a_dose_limit_gets_the_tasks(made):
    assert made.unwrapped.task.limits.dose == DOSE
    assert made.step(action())[-1]["tissue_dose"] == 0.0  # the tip is still above the surface


def test_no_failure_pays_more_than_going_on():
    """What is left pays at least the cost of force; the step of the failure, here one of 10, pays its map."""
    weights = reward_weights(SlideTask)
    for failure in ("hard_force", "fault"):
        assert weights[failure] + weights["map"] / 10 < weights["soft_force"]


@pytest.mark.parametrize("steps", [0, -3])
def test_refuses_a_number_of_steps(steps):
    with pytest.raises(ValueError, match=f"episode_steps is {steps}"):
        gym.make("SurgSim/Slide-v0", scene="phantom_small", episode_steps=steps)
