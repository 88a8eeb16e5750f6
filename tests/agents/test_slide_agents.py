"""Scripted and learned slides: ways over a face, the map from readings, and the trainer on a recorded slide."""

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from surgsim_apps.scoring.episodes import check_agent, episode_facts, estimates_itself
from surgsim_apps.training.slide_agents import (
    SLIDES,
    SlideMemory,
    Way,
    lesion_numbers,
    less_surface,
    pressure_centres,
    spiral,
    sweep,
)
from surgsim_env.palpation import MAP_SIDE, TouchMap

SLIDE = "SurgSim/Slide-v0"
BLOCK = {"scene": "phantom_small", "level": "easy", "face": True}


@pytest.fixture(scope="module")
def oval():
    """An oval face of 12 x 8 tip radii."""
    extent = np.array([12.0, 8.0])
    plain = TouchMap(extent, 0.4, np.ones(MAP_SIDE**2, dtype=np.bool_))
    inside = np.square((plain.sites - 0.5 * extent) / (0.5 * extent)).sum(axis=1) <= 1.0
    return TouchMap(extent, 0.4, inside)


def travelled(way, place, steps=2000):
    """Places of a tip that follows a way at 0.2 tip radii a control step."""
    track = [place]
    for _ in range(steps):
        track.append(track[-1] + 0.2 * np.clip(way.velocity(track[-1]), -1.0, 1.0))
    return np.array(track)


@pytest.mark.parametrize("ways", [sweep, spiral])
def test_a_way_leads_over_the_whole_face(oval, ways):
    track = travelled(Way(ways(oval, 1.8)), np.array([6.0, 4.0]))
    sites = oval.sites[oval.pressable]
    nearest = np.array([np.linalg.norm(track - site, axis=1).min() for site in sites])
    # Half a row's distance and the place's tolerance; a spiral leaves the corners of its sectors.
    assert nearest.max() < 1.8
    assert np.linalg.norm(track[:, None] - sites, axis=2).min(axis=1).max() < 1.0, "the way leaves the face"


def test_the_surface_explains_what_follows_from_it():
    rng = np.random.default_rng(0)
    means = np.zeros((10, 60))
    means[6:9], means[9] = rng.normal(size=(3, 60)), rng.uniform(2.0, 8.0, 60)
    values = (3.0 - 0.5 * means[6] + 2.0 / means[9])[:, None]
    bump = np.zeros((60, 1))
    bump[7] = 1.0
    assert np.abs(less_surface(means, values)).max() < 1e-9
    assert less_surface(means, values + bump).argmax() == 7


def test_the_centre_of_pressure_of_a_patch():
    forces = np.zeros((4, 4, 3))
    forces[2, 3, 2] = 2.0  # third row, last column
    assert pressure_centres(forces.reshape(48, 1)) == pytest.approx(np.array([[1.5, 0.5]]))
    assert pressure_centres(np.zeros((48, 0))).shape == (0, 2)


def played(name, seed, **settings):
    """Mean score of a scripted slide, and its environment."""
    env: Any = gym.make(SLIDE, **BLOCK, **settings)
    observation, _ = env.reset(seed=seed)
    agent, over, info = SLIDES[name](), False, {}
    agent.reset(np.random.default_rng(seed), episode_facts(env, SLIDE, {}))
    if name == "slide_oracle":
        agent.see(env.unwrapped.task)
    while not over:
        observation, _, terminated, truncated, info = env.step(agent.act(observation))
        over = terminated or truncated
    return info["map_score"], env


@pytest.mark.parametrize("name", SLIDES)
def test_a_subclass_of_each_agent_may_be_submitted(name):
    agent = type("Mine", (SLIDES[name],), {})()
    check_agent(agent, "it")
    assert not estimates_itself(agent)


@pytest.mark.parametrize("name", SLIDES)
def test_each_agent_plays_gently(name):
    score, env = played(name, 4, episode_steps=120)
    assert 0.0 <= score <= 1.0
    assert env.unwrapped.task.path_length > 0.0


def test_the_oracle_declares_each_lesion_when_it_touches_it():
    score, env = played("slide_oracle", 4, episode_steps=120)
    assert env.unwrapped.task.error == pytest.approx(0.0, abs=0.0005) and env.unwrapped.task.dice > 0.97
    assert score > 0.5


def test_a_blind_guess_and_an_empty_map_score_less_than_a_sweep():
    """Eight blocks at level standard, half an episode; a map without touch has the same score in each step."""
    lanes = {"vectorization_mode": "vector_entry_point", "dtype": "float32", "autoreset_mode": "Disabled"}
    envs: Any = gym.make_vec(SLIDE, num_envs=8, scene="phantom", level="standard", face=True, **lanes)
    steps = 200

    def score(actions):
        """Mean score over `steps` control steps."""
        observations, infos = envs.reset(seed=100)
        for _ in range(steps):
            observations, _, _, _, infos = envs.step(actions(observations))
        return infos["map_score"].mean() * envs.unwrapped.envs[0].task.episode_steps / steps

    agents = [SLIDES["slide_sweep"]() for _ in range(8)]
    for agent in agents:
        agent.reset(np.random.default_rng(0), episode_facts(envs.unwrapped.envs[0], SLIDE, {}))
    sweep_score = score(lambda seen: np.stack([agent.act(row) for agent, row in zip(agents, seen, strict=True)]))
    still = np.full((8, 15), -1.0, dtype=np.float32)
    still[:, :2] = 0.0
    for middle in (still[:, 3:7], np.tile(np.array([1.0, 0.0, 0.0, 0.1], dtype=np.float32), (8, 1))):
        still[:, 3:7] = middle
        envs.reset(seed=100)
        blind = envs.step(still)[-1]["map_score"].mean() * envs.unwrapped.envs[0].task.episode_steps
        assert sweep_score > blind + 0.15


def test_lesions_as_numbers_of_an_action():
    rows = lesion_numbers(np.array([[3.0, 2.0]]), np.array([1.5]), np.array([12.0, 8.0])).reshape(3, 4)
    assert rows[0] == pytest.approx([1.0, -0.5, -0.5, 0.5])
    assert (rows[1:] == -1.0).all()


# ---- the learned agent -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded():
    """A slide of a sweep on a block: slices, observations, true map."""
    env: Any = gym.make(SLIDE, **BLOCK, episode_steps=60)
    observation, _ = env.reset(seed=6)
    agent, seen, over, info = SLIDES["slide_sweep"](), [observation], False, {}
    agent.reset(np.random.default_rng(0), episode_facts(env, SLIDE, {}))
    while not over:
        observation, _, terminated, truncated, info = env.step(agent.act(observation))
        seen.append(observation)
        over = terminated or truncated
    return env.unwrapped.observation_slices, np.array(seen), {name: [value] for name, value in info.items()}


@pytest.fixture
def learn():
    pytest.importorskip("torch", reason="needs the `agents` extra")
    from agents import learn_slide

    return learn_slide


@pytest.mark.agents
def test_a_recorded_slide_has_the_rasters_of_the_memory(recorded, learn):
    from surgsim_apps.training.slide_network import raster

    slices, observations, infos = recorded
    slide = learn.Slide.of(slices, observations, learn.true_map(infos))
    memory = SlideMemory(slices, observations[0])
    for observation in observations[1:]:
        memory.add(observation)
    assert np.allclose(slide.raster(60, remembers=True), raster(memory))
    alone = slide.raster(60, remembers=False)
    assert np.allclose(alone, raster(memory, remembers=False))
    assert alone[-4].sum() == pytest.approx(0.2) and slide.raster(60, remembers=True)[-4].sum() > 1.0


@pytest.mark.agents
def test_the_labels_are_the_true_map_and_the_oracles_way(recorded, learn):
    slices, observations, infos = recorded
    slide = learn.Slide.of(slices, observations, learn.true_map(infos))
    spots, areas, goal = slide.labels(0)
    (centre,), radius = slide.lesions[:, :2], slide.lesions[0, 2]
    for label in (spots, goal):
        assert np.linalg.norm(slide.map.sites[label.argmax()] - centre) < slide.map.cell
    assert areas.sum() * slide.map.cell**2 == pytest.approx(np.pi * radius**2, rel=0.15)
    touched = np.linalg.norm(slide.place - centre, axis=1).min() < learn.REACHED
    assert slide.labels(60)[2].sum() == pytest.approx(0.0 if touched else 1.0)
    # Its radius is the one that scripts declare, not its own.
    assert learn.score_of(slide, slide.lesions[:, :2]) > 0.6 > learn.score_of(slide, np.zeros((0, 2)))


@pytest.mark.agents
@pytest.mark.parametrize("axis", [0, 1])
def test_a_mirror_image_of_a_mirror_image_is_the_example(recorded, learn, axis):
    slices, observations, infos = recorded
    slide = learn.Slide.of(slices, observations, learn.true_map(infos))
    example = slide.raster(50, remembers=True), slide.labels(50)
    once = learn.mirrored(*example, axis)
    assert not np.allclose(once[0], example[0])
    # The force across changes its sign where it is felt, and its place.
    across = np.flip(example[0][3 + axis], axis=1 - axis)
    assert np.allclose(once[0][3 + axis], -across)
    for again, first in zip(learn.mirrored(*once, axis), example, strict=True):
        assert np.array_equal(again, first)


@pytest.mark.agents
@pytest.mark.parametrize("without", [None, "taxels", "memory"])
def test_a_network_fits_a_slide_and_plays_from_its_file(recorded, learn, tmp_path, without):
    import safetensors.torch
    import torch

    from surgsim_apps.training.slide_network import SlideLearned, load_network

    slices, observations, infos = recorded
    slide = learn.Slide.of(slices, observations, learn.true_map(infos))
    network = learn.train([slide], [slide], steps=40, seed=0, without=without)
    scores = {least: np.mean(values) for least, values in learn.check(network, [slide]).items()}
    if without != "memory":
        assert max(scores.values()) > learn.score_of(slide, np.zeros((0, 2)))
    path = tmp_path / "slide.safetensors"
    path.write_bytes(safetensors.torch.save(network.state_dict()))
    assert bool(load_network(path).remembers) is (without != "memory")
    inputs = torch.as_tensor(slide.raster(30, remembers=True))[None]
    with torch.no_grad():
        assert torch.equal(load_network(path)(inputs), network(inputs))
        changed = inputs.clone()
        changed[:, 10:-4] += 1.0
        assert torch.equal(network(changed), network(inputs)) is (without == "taxels")

    class Trained(SlideLearned):
        weights = path

    env: Any = gym.make(SLIDE, **BLOCK, episode_steps=20)
    observation, _ = env.reset(seed=1)
    agent = Trained()
    agent.reset(np.random.default_rng(0), episode_facts(env, SLIDE, {}))
    for _ in range(20):
        action = agent.act(observation)
        assert env.action_space.contains(action)
        observation, *_ = env.step(action)


@pytest.mark.agents
def test_the_shipped_agent_presses_on_and_takes_a_new_goal_each_time(recorded):
    pytest.importorskip("torch", reason="needs the `agents` extra")
    from surgsim_apps.training.slide_network import SlideLearned

    slices, observations, _ = recorded
    agent = SlideLearned()
    agent.reset(np.random.default_rng(0), SimpleNamespace(observation_slices=slices))
    actions = np.array([agent.act(observation) for observation in observations])
    assert (np.abs(actions) <= 1.0).all() and (actions[:, 2] > 0.0).all()
    assert len(np.unique(agent.goals, axis=0)) == len(agent.goals) > 0
