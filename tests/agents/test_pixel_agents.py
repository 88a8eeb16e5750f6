"""Policies that see a picture and the force: their network, their files, the shipped one, and a few steps of DAgger."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the `agents` extra")
import torch

import surgsim_env  # noqa: F401
from agents.learn_retract import IMAGINED_PULL, UNHELD_PULLS, Player
from surgsim_apps.scoring.evaluate import policies_folder
from surgsim_apps.scoring.expert_retract import GRIP, HOLDS, PLAN, PULL, SLICES, TIP, RetractExpert, TolerantExpert
from surgsim_apps.training.picture_features import PictureAndForce
from surgsim_apps.training.policy_files import load_policy
from surgsim_env.rendering import gl

pytestmark = pytest.mark.agents


@pytest.fixture(scope="module")
def opengl():
    try:
        gl.context()
    except gl.NoGLError as reason:
        pytest.skip(f"no OpenGL: {reason}")


def observations(count: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    pictures = rng.integers(256, size=(count, 84, 84, 3), dtype=np.uint8)
    return {"picture": pictures, "force": rng.uniform(-1.0, 1.0, (count, 8)).astype(np.float32)}


def test_a_place_in_the_picture_is_where_the_feature_is():
    """One bright feature moved by a whole stride of the convolutions moves its place by as much, and nothing else."""
    features, force = PictureAndForce(), torch.zeros(1, 8)
    with torch.no_grad():
        for layer in (features.convolutions[0], features.convolutions[2], features.convolutions[4]):
            layer.weight.fill_(1.0)
            layer.bias.fill_(0.0)
        features.sharpness.fill_(1e-2)
        places = []
        for column in (40, 44, 48):
            picture = torch.full((1, 3, 84, 84), 0.5)
            picture[:, :, 38:42, column : column + 4] = 1.5
            places.append(features({"picture": picture, "force": force})[0, :2])
    row, across = torch.stack(places).T
    assert torch.allclose(row, row[:1].expand(3), atol=1e-5)
    # Columns of the last map are four pixels apart and 2 / (count - 1) in the unit of places.
    count = features.places[:, 1].unique().numel()
    assert torch.allclose(across.diff(), torch.full((2,), 2.0 / (count - 1)), rtol=0.02)


def test_the_shipped_policy_sees_a_picture_and_the_force_alone():
    policy = load_policy(policies_folder() / "retract_pixels.json")
    assert policy.description.env_kwargs == {"obs_mode": "rgb_force", "looks": "test"}
    felt = {"contact_force", "contact_torque", "grip_force", "pull_force"}
    assert set(policy.description.observation or {}) == {"picture", *felt}
    env = gym.make(policy.description.env_id, **policy.description.env_kwargs)
    policy.check_environment(env)
    for settings in ({"obs_mode": "rgb"}, {}, {"obs_mode": "rgb_force", "scaled": False}):
        with pytest.raises(ValueError, match="make the environment as the policy's file says"):
            policy.check_environment(gym.make(policy.description.env_id, **settings))
    seen = observations(4)
    policy.reset(4)
    actions = policy.act(seen)
    assert actions.shape == (4, 5) and (np.abs(actions) <= 1.0).all() and len(np.unique(actions, axis=0)) == 4
    policy.reset(4)
    np.testing.assert_array_equal(policy.act(seen), actions)


def held_lobe(pull: float) -> np.ndarray:
    """An observation in SI units of a jaw that holds a lobe half folded, the target hidden, and pulls it [N]."""
    observation = np.zeros(max(part.stop for part in SLICES.values()))
    observation[TIP], observation[[HOLDS, GRIP, PULL]] = [0.04, 0.030, 0.045], [1.0, 0.3, pull]
    return observation


def test_the_teacher_gives_way_to_a_hard_pull():
    """Back towards the place between lifting and folding, the jaw closed; below the limit it goes on folding."""
    teacher, limit = TolerantExpert(grasp_along=0.04), PLAN.pull_most
    goes_on, gives_way = (teacher.act(held_lobe(limit + change)) for change in (-0.01, 0.01))
    back, on = (np.array(goal) - [0.030, 0.045] for goal in (PLAN.risen, PLAN.folded))
    for action, way in ((gives_way, back), (goes_on, on)):
        assert action[1:3] @ way > 0.99 * np.linalg.norm(action[1:3]) * np.linalg.norm(way) > 0.0
        assert action[3] == 0.0 and action[4] == -1.0
    # Where the edge has slipped out of the jaw, the pads still push: outwards, and the jaw opens.
    slipped = [held_lobe(PLAN.push_most + change) for change in (-0.01, 0.01)]
    for observation in slipped:
        observation[HOLDS] = 0.0
    still_in, away = (teacher.act(observation) for observation in slipped)
    assert away[1] > 0.0 and away[0] == away[2] == 0.0 and away[4] == 1.0
    assert not np.array_equal(still_in, away)
    # The plain expert pulls on.
    np.testing.assert_array_equal(
        RetractExpert().act(held_lobe(limit + 0.01))[:3],
        RetractExpert().act(held_lobe(0.3))[:3],
    )


def imagined(pulls: list[float], *, holds: bool) -> tuple[Player, np.ndarray, np.ndarray, np.ndarray]:
    """A player of states with these pulls; forces, labels and numbers of the states that it imagines from them."""
    player, count = Player.__new__(Player), len(pulls)
    player.singles = [SimpleNamespace(task_observation=held_lobe(pull)) for pull in pulls]
    for single in player.singles:
        single.task_observation[[HOLDS, GRIP]] *= holds
    player.rng, player.expert = np.random.default_rng(0), TolerantExpert(grasp_along=0.04)
    player.pulled = np.arange(8) != 6
    force = np.full((count, 8), 0.4, dtype=np.float32)
    player.seen = {"force": force}
    kept, forces, actions = player.imagined()
    assert len(forces) == len(actions) == len(kept)
    # The states themselves stay as they are.
    assert (force == np.float32(0.4)).all()
    assert [single.task_observation[PULL] for single in player.singles] == pulls
    return player, forces, actions, kept


def test_imagined_pulls_scale_all_readings_but_the_grip_and_are_labelled():
    """Of states that pull some come again, with forces of a harder pull and the teacher's answer to it."""
    count = 800
    player, forces, actions, kept = imagined([0.4, 0.0] * (count // 2), holds=True)
    assert 0.1 * count / 2 < len(kept) < 0.3 * count / 2 and (kept % 2 == 0).all()
    made, slipped = forces[:, 7], forces[:, 6] == 0.0
    assert 0.2 < slipped.mean() < 0.4
    np.testing.assert_allclose(forces[:, :6], np.repeat(made[:, None], 6, axis=1), rtol=1e-6)
    assert (forces[~slipped, 6] == np.float32(0.4)).all()
    assert made.min() >= IMAGINED_PULL[0] and made.max() <= IMAGINED_PULL[1]
    assert np.ptp(made) > 0.8 * np.ptp(IMAGINED_PULL)
    for pull, gone, action in zip(made, slipped, actions, strict=True):
        state = held_lobe(float(pull))
        state[[HOLDS, GRIP]] *= not gone
        np.testing.assert_array_equal(action, player.expert.act(state))
    # Where the edge has slipped out, the teacher goes back with an open jaw.
    back = actions[slipped & (made > PLAN.push_most)]
    assert len(back) and (back == np.float32([0.0, 0.75, 0.0, 0.0, 1.0])).all()


def test_all_pulls_that_hold_nothing_are_imagined_several_times():
    _, forces, _, kept = imagined([0.4, 0.0, 0.04, 0.4], holds=False)
    assert kept.tolist() == [0] * UNHELD_PULLS + [3] * UNHELD_PULLS
    assert len(np.unique(forces[:, 7])) == len(kept)


@pytest.mark.slow
@pytest.mark.usefixtures("opengl")
def test_dagger_leaves_a_policy_that_plays(tmp_path: Path, monkeypatch, capsys):
    """Two rounds of a few steps; each state is kept under two looks."""
    from agents import learn_retract
    from surgsim_apps.scoring.episodes import make_envs, play_tasks

    out = tmp_path / "policy.json"
    arguments = ["--pictures", "--rounds", "2", "--envs", "2", "--steps", "3", "--updates", "2", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["learn_retract", *arguments])
    learn_retract.main()
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line.startswith("{")]
    assert [line["samples"] for line in lines] == [12, 24]
    policy = load_policy(out)
    envs = make_envs("SurgSim/Retract-v0", 1, max_episode_steps=3, **policy.description.env_kwargs)
    (record,) = play_tasks(policy.act, envs, [5])
    assert record.steps == 3 and not record.last["success"]
