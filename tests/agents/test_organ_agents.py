"""Agents that palpate any organ: the features, the expert that acts on them, the network that learned it."""

import sys
from dataclasses import fields, replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from surgsim_env.palpation.chart import MAP_SIDE

pytestmark = pytest.mark.agents
pytest.importorskip("torch", reason="needs the `agents` extra")

POLICY = Path(__file__).parents[2] / "agents" / "policies" / "palpate_organs.json"
ID = "SurgSim/Palpate-v0"
SETTINGS = {"memory": True, "frame": "face"}


@pytest.fixture(scope="module")
def first():
    """An environment of the phantom and its first observation."""
    env = gym.make(ID, level="standard", **SETTINGS)
    return env, env.reset(seed=700_000)[0]


def changed(observation, **channels):
    """Observations (n, n_observation) with some channels replaced; arrays are flattened."""
    from surgsim_apps.training.face_features import FACE

    made = np.array(observation, dtype=np.float32)[None]
    for name, values in channels.items():
        made[0, FACE[name]] = np.asarray(values, dtype=np.float32).ravel()
    return made


def features(observations):
    import torch

    from surgsim_apps.training.face_features import face_features

    values = face_features(torch.as_tensor(observations))
    return {field.name: getattr(values, field.name).numpy()[0] for field in fields(values)}


def actions(observations):
    from surgsim_apps.scoring.expert_organs import OrganExpert

    return OrganExpert().act(observations)[0]


# ---- features -------------------------------------------------------------------------------------------------------


def test_the_channels_are_the_environments(first):
    from surgsim_apps.training.face_features import FACE, OBSERVATION_SIZE

    env, observation = first
    assert env.unwrapped.observation_slices == FACE and observation.shape == (OBSERVATION_SIZE,)


def test_rows_are_gone_through_one_after_the_other(first):
    """Going to each next site in turn visits three rows of the phantom's face, each from one end to the other."""
    _, observation = first
    cell, visited = 0.4, np.zeros((MAP_SIDE, MAP_SIDE))
    place, way = np.array([-2.0, -2.2, 0.5]), []
    for _ in range(200):
        seen = features(changed(observation, visited=visited, tip_place=place))
        if seen["rows_left"] == 0.0:
            break
        gap = seen["row_way"]
        place[:2] += gap * min(1.0, cell / np.abs(gap).max())
        column, row = np.round(place[:2] / cell).astype(int) + MAP_SIDE // 2
        visited[row, column] = 1.0
        way.append((column, row))
    assert seen["rows_left"] == 0.0 and len(way) < 60
    # Twelve cells wide, rows four cells apart and two from the border.
    rows = [row for _, row in way]
    assert sorted({row for row in rows if rows.count(row) > 5}) == [16, 20, 24]
    assert rows == sorted(rows)


def test_a_search_begins_at_the_row_that_is_nearer(first):
    _, observation = first
    for v in (-2.0, 2.0):
        way = features(changed(observation, tip_place=[1.0, v, 0.5]))["row_way"]
        assert np.sign(v) * (v + way[1]) == pytest.approx(1.6, abs=1e-5) and 1.0 + way[0] == pytest.approx(
            2.4, abs=1e-5
        )


def test_a_peak_is_passed_when_both_sides_were_felt(first):
    _, observation = first
    middle, contrast, visited = MAP_SIDE // 2, np.zeros((MAP_SIDE, MAP_SIDE)), np.zeros((MAP_SIDE, MAP_SIDE))
    columns = np.arange(middle - 5, middle + 1)
    contrast[middle, columns], visited[middle, columns] = 1.0, 1.0
    contrast[middle, middle] = 2.0
    known = {"contrast": contrast, "visited": visited, "stiffest": [0.0, 0.0, 1.5]}
    seen = features(changed(observation, **known, tip_place=[0.0, 0.0, 0.5]))
    assert seen["excess"] == pytest.approx(0.5, abs=1e-6) and seen["passed"] == 0.0 and seen["across_left"] == 1.0
    np.testing.assert_allclose(seen["stiffest_way"], 0.0, atol=1e-6)
    visited[middle, middle + 2] = 1.0
    assert features(changed(observation, **known, tip_place=[0.0, 0.0, 0.5]))["passed"] == 1.0
    # Sites across the row, up to 1.4 tip radii away, are felt next.
    visited[middle - 4 : middle + 5, middle] = 1.0
    assert features(changed(observation, **known, tip_place=[0.0, 0.0, 0.5]))["across_left"] == 0.0


def test_sizes_are_relative_to_the_tip(first):
    """Half as large cells on a tip of twice the radius are the same organ."""
    _, observation = first
    wide = features(changed(observation, tip_place=[0.5, 0.5, 0.3]))
    assert wide["row_way"] == pytest.approx([1.9, 1.1], abs=1e-5)
    small = features(changed(observation, tip_place=[0.25, 0.25, 0.3], map_cell=[0.2]))
    # Rows stand a fixed number of tip radii apart: of a face half as wide fewer.
    assert np.abs(small["row_way"]).max() <= 1.2


# ---- the expert -----------------------------------------------------------------------------------------------------


def test_the_expert_follows_slopes_and_lifts_before_the_soft_limit(first):
    import torch

    from surgsim_apps.scoring.expert_organs import DEPTH, expert_actions
    from surgsim_apps.training.face_features import face_features

    _, observation = first
    there = face_features(torch.as_tensor(changed(observation)))
    normal = torch.tensor([[0.6, 0.0, 0.8]])
    along = replace(
        *(there,), normal=normal, begun=torch.ones(1), depth=torch.full((1,), DEPTH), force=torch.full((1,), 0.3),
        row_way=torch.tensor([[1.0, 0.0]]), rows_left=torch.full((1,), 0.5),
    )  # fmt: skip
    sliding = expert_actions(along)
    assert float((sliding[0, :3] * normal[0]).sum()) == pytest.approx(0.0, abs=1e-6) and sliding[0, 0] > 0.9
    lifted = expert_actions(replace(along, force=torch.full((1,), 0.9)))
    assert float((lifted[0, :3] * normal[0]).sum()) > 0.5


def test_the_expert_finds_the_lesion_gently_on_the_organ():
    env = gym.make(ID, level="standard", **SETTINGS)
    observation, _ = env.reset(seed=700_001)
    ended, peak, info = False, 0.0, {}
    while not ended:
        observation, _, terminated, truncated, info = env.step(actions(observation[None]))
        ended, peak = terminated or truncated, max(peak, info["force_peak"])
    assert info["success"] and peak <= env.unwrapped.scene.limits.soft_force


# ---- the network ----------------------------------------------------------------------------------------------------


def test_teaching_writes_a_policy_that_plays(tmp_path: Path, monkeypatch):
    from agents import learn_palpate_organs
    from surgsim_apps.training.policy_files import load_policy

    path = tmp_path / "taught.json"
    arguments = ["--out", path, "--scenes", "phantom_small", "--rounds", 2, "--imagined", 600, "--epochs", 1]
    monkeypatch.setattr(sys, "argv", ["learn", *map(str, arguments)])
    learn_palpate_organs.main()
    policy = load_policy(path)
    env = gym.make(ID, scene="phantom_small", level="standard", **SETTINGS)
    policy.check_environment(env)
    policy.reset(1)
    assert policy.act(env.reset(seed=0)[0][None])[0] in env.action_space


# ---- the surrogate --------------------------------------------------------------------------------------------------


def surrogate(scene, seed=3):
    from surgsim_apps.training.face_surrogate import FaceSurrogate

    env = gym.make(ID, scene=scene, level="standard", scaled=True, **SETTINGS)
    return FaceSurrogate([env], np.random.default_rng(seed))


def test_the_surrogate_presses_as_the_organ_does():
    """On the liver, away from the lesion: the same depth, and a force of the same size along the same normal."""
    from surgsim_apps.training.face_features import FACE

    made = surrogate("liver")
    made.reset()
    env = made.envs[0]
    observation, _ = env.reset(seed=700_003)
    made.tips[0].tip_reading = env.simulation.instrument.tip_position.copy()
    made.excess[0], made.amplitude[0], made.stiffness[0] = 0.0, 0.0, 1.5
    down = np.array([0.0, 0.0, -0.5, 0.0], dtype=np.float32)
    while observation[FACE["tip_depth"]][0] < 0.35:
        observation, *_ = env.step(down)
    # The task is shared: the surrogate's step looks at its own tip.
    organ = {name: observation[FACE[name]].copy() for name in ("tip_depth", "face_force", "surface_normal")}
    made.tips[0].tip_reading = env.simulation.instrument.tip_position.copy()
    formula = made.step(np.zeros((1, 4)))[0]
    assert formula[FACE["tip_depth"]] == pytest.approx(organ["tip_depth"], abs=1e-4)
    np.testing.assert_allclose(formula[FACE["surface_normal"]], organ["surface_normal"], atol=1e-4)
    along = [force @ organ["surface_normal"] for force in (formula[FACE["face_force"]], organ["face_force"])]
    assert along[0] == pytest.approx(along[1], rel=0.4) and along[1] > 0.1


def test_the_expert_finds_the_lesion_on_the_surrogate_of_a_family():
    from surgsim_apps.scoring.expert_organs import OrganExpert

    made, expert = surrogate("kidney_family"), OrganExpert()
    observations = made.reset()
    while not made.over.all():
        observations = made.step(expert.act(observations))
    assert made.infos[0]["success"] and not made.infos[0]["hard_limit"]
    assert made.envs[0].task.anatomy.member is not None


# ---- the committed policy -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", ["phantom", "phantom_wide", "liver", "kidney_family"])
def test_the_committed_policy_takes_any_organ(scene):
    from surgsim_apps.training.policy_files import load_policy

    load_policy(POLICY).check_environment(gym.make(ID, scene=scene, **SETTINGS))


def test_the_committed_policy_does_as_it_was_taught(first):
    """The network slides, crosses and declares where the expert does."""
    import torch

    from agents.learn_palpate_organs import imagined
    from surgsim_apps.scoring.expert_organs import expert_actions
    from surgsim_apps.training.face_features import face_summary
    from surgsim_apps.training.policy_files import load_policy

    network = load_policy(POLICY).decider
    made = imagined(4000, np.random.default_rng(5))
    with torch.no_grad():
        wanted = expert_actions(made)
        played = network.layers(face_summary(made)).clamp(-1.0, 1.0)  # type: ignore[attr-defined]
    missed = (played - wanted).square().mean(dim=0)
    assert missed[:3].max() < 0.03, "of actions with a variance of 0.3 to 0.5"
    declared = wanted[:, 3] > 0.5
    assert (played[declared, 3] > 0.8).float().mean() > 0.7 and (played[~declared, 3] > 0.8).float().mean() < 0.02
