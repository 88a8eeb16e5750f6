"""docs/training_loops.md runs: each trainer as a file of its own."""

import csv
from pathlib import Path
from typing import Any

import pytest

from tests.docs.test_tutorials import blocks

pytestmark = pytest.mark.agents
PAGE = Path(__file__).resolve().parents[2] / "docs" / "training_loops.md"
FILES = {block.title: block.text for block in blocks(PAGE.read_text(encoding="utf-8"))}
NEEDS = {
    "sb3.py": "stable_baselines3",
    "ppo.py": "torch",
    "torchrl_ppo.py": "torchrl",
    "rllib.py": "ray.rllib",
    "two_arms.py": "supersuit",
}


def run(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Names of a file of the page after it ran."""
    pytest.importorskip(NEEDS[name], reason="needs what docs/training_loops.md installs (`make test-agents`)")
    monkeypatch.chdir(folder)
    names: dict[str, Any] = {"__name__": "page"}
    exec(compile(FILES[name], name, "exec"), names)
    return names


def test_each_file_has_a_test() -> None:
    assert set(FILES) == set(NEEDS)


def test_stable_baselines3_evaluates_a_success_rate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("sb3.py", tmp_path, monkeypatch)
    assert len(names["evaluation"]._is_success_buffer) == 3
    assert names["model"].ep_success_buffer
    with (tmp_path / "runs" / "sb3" / "progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len([row for row in rows if row["eval/success_rate"]]) == 2


def test_a_loop_in_one_file_reads_ends_of_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    names = run("ppo.py", tmp_path, monkeypatch)
    # Eight lanes, in each update 32 steps, episodes of 20 steps at most: an untrained policy may declare before.
    assert capsys.readouterr().out.count("episodes") == 2 and len(names["successes"]) >= 8


def test_torchrl_collects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("torchrl_ppo.py", tmp_path, monkeypatch)
    # In each batch 32 steps of eight lanes, episodes of 20 steps at most.
    assert len(names["successes"]) >= 16


def test_rllib_trains_on_two_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # No cluster answers there: a local Ray is started.
    monkeypatch.setenv("RAY_ADDRESS", "192.0.2.1:6379")
    assert run("rllib.py", tmp_path, monkeypatch)["returns"] < 0.0


def test_torchrl_makes_one_environment_by_its_id() -> None:
    """It tries arguments that the environment does not have."""
    envs = pytest.importorskip("torchrl.envs", reason="needs torchrl (`make test-agents`)")
    env = envs.GymEnv("surgsim_env:SurgSim/Palpate-v0", scene="phantom_small")
    envs.check_env_specs(env)
    assert env.rollout(3)["next", "observation"].shape == (3, 11)


def test_supersuit_pads_the_arms_actions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("two_arms.py", tmp_path, monkeypatch)
    assert names["actions"].shape == (4, 7) and len(names["observations"]) == len(names["infos"]) == 4
    assert [info["is_success"] for info in names["infos"]] == [False] * 4
