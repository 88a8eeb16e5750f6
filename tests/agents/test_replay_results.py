"""Results whose first episodes are the same with another source say so; others are left alone."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from agents import replay_results
from surgsim_env.scoring.results import Result, load_result
from tests.agents.commands import surgsim

OLD_SOURCE = "0" * 24


def replay(monkeypatch: pytest.MonkeyPatch, file: Path, episodes: int = 2) -> None:
    monkeypatch.setattr(sys, "argv", ["replay_results", str(file), "--episodes", str(episodes)])
    replay_results.main()


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """Three episodes that another source is said to have played."""
    file = tmp_path_factory.mktemp("played") / "made.json"
    surgsim(
        "evaluate",
        "--agent",
        "sobol",
        "--scene",
        "phantom_small",
        "--seeds",
        "3:5",
        "--budget",
        "9",
        "--submit",
        str(file),
    )
    made = load_result(file)
    return replace(
        made,
        origin={**made.origin, "environment": {**made.origin["environment"], "source": OLD_SOURCE}},
    )


def test_a_result_whose_first_episodes_are_the_same_can_be_compared_again(
    played: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (file := tmp_path / "old.json").parent.mkdir(exist_ok=True)
    # An error that another processor rounds the other way is no difference.
    errors = [[played.errors_mm[0][0] + 0.01, *played.errors_mm[0][1:]], *played.errors_mm[1:]]
    played = replace(played, errors_mm=errors)
    played.write(file)
    with pytest.raises(ValueError, match=f"source is {OLD_SOURCE}, here"):
        surgsim("evaluate", "--check", str(file))
    replay(monkeypatch, file)
    surgsim("evaluate", "--check", str(file))
    found = load_result(file)
    assert found.origin["replayed"] == {"episodes": 2, "environment": played.origin["environment"]}
    assert replace(found, origin=played.origin) == load_result_of(played, tmp_path)
    # The digests with which all episodes were played stay, however often some are played again.
    replay(monkeypatch, file, episodes=1)
    assert load_result(file).origin["replayed"] == {"episodes": 1, "environment": played.origin["environment"]}


def load_result_of(result: Result, folder: Path) -> Result:
    """A result as it is read."""
    result.write(folder / "read.json")
    return load_result(folder / "read.json")


@pytest.mark.parametrize("name", ["errors_mm", "lesion_counts", "successes", "agent"])
def test_a_result_that_differs_is_left_alone(
    played: Result, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    errors = [list(row) for row in played.errors_mm]
    errors[1][-1] += 0.02
    changed = {
        "errors_mm": {"errors_mm": errors},
        "lesion_counts": {"lesion_counts": [played.lesion_counts[0] + 1, *played.lesion_counts[1:]]},
        "successes": {"successes": [not played.successes[0], *played.successes[1:]]},
        "agent": {"origin": {**played.origin, "agent": dict.fromkeys(played.origin["agent"], "0" * 64)}},
    }[name]
    replace(played, **changed).write(file := tmp_path / "old.json")
    before = file.read_bytes()
    with pytest.raises(SystemExit, match="1"):
        replay(monkeypatch, file)
    assert file.read_bytes() == before
    assert f"DIFFERS: {name}" in capsys.readouterr().out.replace("site_search.py of the ", "")
