"""The scripted expert of SurgSim/Retract-v0, how agents are scored on it, and a few steps of DAgger."""

import json
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401

pytestmark = pytest.mark.agents
pytest.importorskip("torch", reason="needs the `agents` extra")

ID = "SurgSim/Retract-v0"


def envs(count: int, mode: str = "Disabled", **settings) -> gym.vector.VectorEnv:
    lanes = {"vectorization_mode": "vector_entry_point", "autoreset_mode": mode, "threads": 1}
    return gym.make_vec(ID, num_envs=count, measure_tissue=True, **lanes, **settings)


def test_the_expert_succeeds_and_side_by_side_it_is_scored_as_alone():
    """Three seeds on two environments: each record is that of a single environment, to the bit; all succeed."""
    from surgsim_apps.scoring.episodes import play_tasks, task_columns
    from surgsim_apps.scoring.expert_retract import RetractExpert

    seeds = [21, 22, 23]
    records = play_tasks(RetractExpert().act_all, envs(2, scaled=False), seeds)
    single = gym.make(ID, measure_tissue=True, scaled=False)
    for seed, record in zip(seeds, records, strict=True):
        observation, info = single.reset(seed=seed)
        steps, total, loads, over = 0, 0.0, [], False
        while not over:
            observation, reward, terminated, truncated, info = single.step(RetractExpert().act(observation))
            steps, total, over = steps + 1, total + float(reward), terminated or truncated
            loads.append((info["tissue_pressure"], info["tissue_strain"]))
        assert (steps, total, loads) == (record.steps, record.total, record.loads)
        assert {name: record.last[name] for name in info} == info
        assert record.last["success"] and not record.last["torn"] and record.last["visible"] >= 0.8
    columns = task_columns(records, 0.05, 1.0)
    assert columns["success"].tolist() == [1.0] * 3
    assert columns["torn"].tolist() == columns["fault_share"].tolist() == [0.0] * 3
    pressures, strains = zip(*(np.max(record.loads, axis=0) for record in records), strict=True)
    assert columns["pressure_peak"].tolist() == list(pressures) and min(pressures) > 1000.0
    assert columns["strain_peak"].tolist() == list(strains) and min(strains) > 0.05
    pulls = [record.last["pull_force_peak"] for record in records]
    assert columns["pull_force_peak"].tolist() == pulls


def test_the_expert_follows_from_the_observation_alone():
    """Asked in another order, or again, it says the same; and it keeps still where enough is seen."""
    from surgsim_apps.scoring.expert_retract import GRIP, HOLDS, TIP, VISIBLE, RetractExpert

    random = np.random.default_rng(0)
    box = gym.make(ID).observation_space
    places = random.uniform(box.low, box.high, (20, *box.shape))  # type: ignore[attr-defined, misc]
    expert = RetractExpert()
    first = np.array([expert.act(place) for place in places])
    np.testing.assert_array_equal(first[::-1], [expert.act(place) for place in places[::-1]])
    assert (np.abs(first) <= 1.0).all()
    held = places[0].copy()
    held[TIP], held[GRIP], held[HOLDS], held[VISIBLE] = [0.04, 0.045, 0.03], 0.45, 1.0, 0.95
    np.testing.assert_array_equal(expert.act(held), [0.0, 0.0, 0.0, 0.0, -1.0])


def test_forces_are_those_entries_of_the_observation():
    """The wrench, grip and pull on tissue are in these entries alone."""
    env = gym.make(ID, scaled=False)
    observation, _ = env.reset(seed=3)
    assert env.unwrapped.layout.force_entries == list(range(13, 21))
    assert env.unwrapped.observation_slices["contact_force"] == slice(13, 16)
    assert observation[19] == observation[20] == 0.0 and observation[21] == 0.0


def test_dagger_leaves_a_policy_that_plays(tmp_path: Path, monkeypatch, capsys):
    """Two rounds of a few steps."""
    from agents import learn_retract
    from surgsim_apps.scoring.episodes import play_tasks
    from surgsim_apps.training.policy_files import load_policy

    out = tmp_path / "policy.json"
    arguments = ["--rounds", "2", "--envs", "2", "--steps", "4", "--updates", "3", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["learn_retract", *arguments])
    learn_retract.main()
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line.startswith("{")]
    assert [line["samples"] for line in lines] == [8, 16]
    policy = load_policy(out)
    assert policy.description.env_id == ID and policy.description.trained_steps == 16
    policy.check_environment(gym.make(ID))
    policy.reset(1)
    (record,) = play_tasks(policy.act, envs(1, max_episode_steps=3), [5])
    assert record.steps == 3 and not record.last["success"]


def test_dagger_goes_on_from_a_policy(tmp_path: Path, monkeypatch):
    """After one update its first action is nearly that of the policy; another network or none is refused."""
    from agents import learn_retract
    from surgsim_apps.scoring.evaluate import policies_folder
    from surgsim_apps.training.policy_files import load_policy

    shipped, out = policies_folder() / "retract_dagger.json", tmp_path / "policy.json"

    def learn(initial: Path) -> None:
        arguments = ["--rounds", "1", "--envs", "1", "--steps", "1", "--updates", "1", "--out", str(out)]
        monkeypatch.setattr(sys, "argv", ["learn_retract", *arguments, "--initial", str(initial)])
        learn_retract.main()

    learn(shipped)
    seen = gym.make(ID).reset(seed=0)[0][None]
    for policy in (before := load_policy(shipped), after := load_policy(out)):
        policy.reset(1)
    # Adam's first update changes each weight by up to 1e-3, and these actions by 0.15.
    np.testing.assert_allclose(after.act(seen), before.act(seen), atol=0.3)
    for other in ("retract_pixels.json", "sites_evolved.json"):
        with pytest.raises(ValueError, match="not a policy of the observations to learn from"):
            learn(policies_folder() / other)
