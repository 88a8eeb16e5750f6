"""Environments whose scene is a family: a member each episode, everything of it, alone and side by side."""

from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_env.palpation import chart, member_chart
from surgsim_env.palpation.chart import charted_face
from surgsim_env.scene.anatomy import MemberName, load_anatomy
from surgsim_env.scene.load import load_scene, scenes_folder
from tests.envs.test_vector_env import assert_equal

SITES, PALPATE = "SurgSim/PalpateSites-v0", "SurgSim/Palpate-v0"
FAMILY = """
description = "blocks"
[family]
template = "block.toml"
size = [0.9, 1.1]
aspect = [0.9, 1.1]
curvature = 2.0
bump_count = 2
bump_height = 0.001
bump_width = [0.008, 0.015]
train = 4
validation = 2
test = 2
"""


@pytest.fixture(scope="module")
def blocks(tmp_path_factory) -> str:
    """The file of a family of small blocks."""
    folder = tmp_path_factory.mktemp("blocks")
    block = (scenes_folder() / "organs" / "phantom_small.toml").read_text("utf-8")
    (folder / "block.toml").write_text(block, "utf-8")
    (folder / "blocks.toml").write_text(FAMILY, "utf-8")
    return str(folder / "blocks.toml")


def actions(env_id: str, count: int, rng: np.random.Generator) -> np.ndarray:
    """Places to press, or ways down and about."""
    if env_id == SITES:
        return rng.uniform(-1.0, 1.0, (count, 2)).astype(np.float32)
    moves = 0.3 * rng.normal(size=(count, 4)) + [0.0, 0.0, -0.5, 0.0]
    return np.clip(moves, -1.0, 0.6).astype(np.float32)


@pytest.mark.parametrize(("env_id", "settings"), [(SITES, {}), (PALPATE, {"level": "standard", "memory": True})])
def test_each_episode_plays_a_member_with_all_that_depends_on_it(blocks, env_id, settings):
    env = gym.make(env_id, scene=blocks, **settings).unwrapped
    template, space = env.simulation.anatomy, env.observation_space
    seen = {}
    for seed in range(12):
        observation, info = env.reset(seed=seed)
        task, anatomy = env.task, env.task.anatomy
        assert info["member"] == str(anatomy.member) == str(env.simulation.anatomy.member)
        assert env.simulation.anatomy is anatomy and anatomy.member.split == "train"
        assert env.observation_space is space and space.contains(observation)
        np.testing.assert_array_equal(env.simulation.organ_model.node_rest_position, anatomy.mesh.points)
        assert task.lesions[0].centre is not None
        anatomy.check_inside(task.lesions[0])
        if env_id == SITES:
            assert task.charted is charted_face(anatomy) and task.felt.charted is task.charted
            np.testing.assert_array_equal(task.estimator.extent, task.charted.chart.extent)
            assert task.truth.shape == (len(task.lesions), 3)
        else:
            assert task.memory.map is charted_face(anatomy).touch_map
        moved = env.step(actions(env_id, 1, np.random.default_rng(seed))[0])
        assert moved[-1]["member"] == info["member"] and not moved[-1]["sim_fault"]
        seen[info["member"]] = anatomy.mesh.points
    assert len(seen) == 4, "12 episodes play all four members"
    assert template.member is None and env.simulation.anatomy is not template
    for points in seen.values():
        assert (points > env.simulation.instrument.lower).all() and (points < env.simulation.instrument.upper).all()


@pytest.mark.parametrize("split", ["train", "validation", "test"])
def test_splits_have_members_of_their_own(blocks, split):
    env = gym.make(PALPATE, scene=blocks, split=split).unwrapped
    names = {env.reset(seed=seed)[1]["member"] for seed in range(12)}
    assert names == {f"{split} {number}" for number in range({"train": 4}.get(split, 2))}


def test_a_scene_of_one_organ_names_no_member():
    env = gym.make(PALPATE, scene="phantom_small").unwrapped
    assert "member" not in env.reset(seed=0)[1]


@pytest.mark.parametrize(
    ("env_id", "settings"),
    [
        (SITES, {"budget": 2}),
        (PALPATE, {}),
        (PALPATE, {"motion": "calm", "level": "standard", "memory": True}),
    ],
)
def test_side_by_side_equals_one_after_the_other(blocks, env_id, settings):
    """Members of several episodes in one register, to the bit."""
    count = 3
    settings = {"scene": blocks, **settings}
    together = gym.make_vec(
        env_id, num_envs=count, vectorization_mode="vector_entry_point", autoreset_mode="SameStep", **settings
    )
    apart = gym.make_vec(
        env_id, num_envs=count, vectorization_mode="sync", vector_kwargs={"autoreset_mode": "SameStep"}, **settings
    )
    assert_equal(together.reset(seed=[4, 5, 6]), apart.reset(seed=[4, 5, 6]))
    rng, names = np.random.default_rng(0), set()
    for step in range(5 if env_id == SITES else 12):
        moves = actions(env_id, count, rng)
        result, expected = together.step(moves), apart.step(moves)
        assert_equal(result[:4], expected[:4])
        assert_equal(result[4], expected[4])
        singles = [env.unwrapped for env in together.envs]  # type: ignore[attr-defined]
        names.add(tuple(str(single.task.anatomy.member) for single in singles))
        if step == 6:
            assert_equal(together.reset(seed=[7, 8, 9]), apart.reset(seed=[7, 8, 9]))
    assert len(names) > 1 and any(len(set(beside)) > 1 for beside in names), "other members come into the lanes"
    for env, other in zip(together.envs, apart.envs, strict=True):  # type: ignore[attr-defined]
        assert env.unwrapped.save_state() == other.unwrapped.save_state()
    together.close()
    apart.close()


# ---- healthy maps of members ----------------------------------------------------------------------------------------


def test_the_map_of_a_member_is_made_once_from_its_template_and_few_presses(blocks, tmp_path, monkeypatch):
    monkeypatch.setenv("SURGSIM_CACHE", str(tmp_path / "cache"))
    pressed = []
    member_chart.member_map.cache_clear()

    def press_sites(anatomy, sites, progress, dtype=None, name=""):
        """Twice as stiff as the template, its centre of pressure 2 mm further along, everywhere."""
        pressed.append((str(anatomy.member), len(sites), name))
        return np.tile([100.0, 0.001, 0.005], (len(sites), 1))

    monkeypatch.setattr(member_chart, "press_sites", press_sites)
    flat = chart.HealthyMap(np.tile([50.0, 0.001, 0.003], (13, 13, 1)))
    monkeypatch.setattr(member_chart, "healthy_map_of", lambda anatomy, between: flat)
    template = load_anatomy(load_scene(Path(blocks)))
    for number in (0, 1, 0):
        healthy = member_chart.member_map(template, MemberName("test", number))
        np.testing.assert_allclose(healthy.grid, np.tile([100.0, 0.001, 0.005], (13, 13, 1)), rtol=1e-12)
    count = member_chart.PRESS_COUNT
    assert pressed == [("test 0", count, "test 0"), ("test 1", count, "test 1")]
    assert len(list((tmp_path / "cache").iterdir())) == 2
    member_chart.member_map.cache_clear()
    member_chart.member_map(template, MemberName("test", 0))
    assert len(pressed) == 2, "it is read from the cache"
    member_chart.member_map.cache_clear()


def test_healthy_members_have_contrast_one(blocks):
    """Between the few sites that are pressed too, of a block so thin that its tray is felt: within the mesh's 3 %."""
    scene = load_scene(Path(blocks))
    template = load_anatomy(replace(scene, family=replace(scene.family, thickness=(0.6, 0.62))))
    name = MemberName("train", 1)
    member = member_chart.make_member(template, name)
    charted = charted_face(member)
    sites = charted.grid_sites()[::9]
    with chart.StepProgress(None) as progress:
        presses = chart.press_sites(member, sites, progress)
    healthy, places = member_chart.member_map(template, name), np.array([site.place for site in sites])
    error = np.log(presses[:, 0] / healthy.stiffness(places))
    print(f"\nlog contrast of healthy presses: deviation {error.std():.4f}, largest {np.abs(error).max():.4f}")
    assert np.abs(error).max() < 0.03 and error.std() < 0.01
    # The centre of pressure: within a share of the contact radius that the mesh moves it by.
    assert np.abs(presses[:, 1:] - healthy.centre(places)).max() < 0.1 * np.sqrt(0.008 * scene.palpation.press_depth)
