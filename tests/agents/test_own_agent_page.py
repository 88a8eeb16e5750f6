"""docs/own_agent.md runs: its file is written, its commands run in order, on fewer and shorter episodes."""

import shlex
import sys
from pathlib import Path

import pytest

from surgsim_apps.scoring.results import load_result
from tests.agents.commands import surgsim
from tests.docs.test_tutorials import blocks

pytestmark = pytest.mark.agents
PAGE = Path(__file__).resolve().parents[2] / "docs" / "own_agent.md"


def shorter(arguments: list[str]) -> list[str]:
    """Two organs and three presses, on a small scene, in place of a whole evaluation."""
    if "--compare" in arguments:
        return ["--compare", *sorted(map(str, Path("scores").iterdir()))]
    if "--agent" not in arguments:
        return arguments
    if "--env" in arguments:
        return [*arguments, "--episodes", "1"]
    return [*arguments, "--episodes", "2", "--budget", "3", "--scene", "phantom_small"]


def test_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])
    commands = 0
    for block in blocks(PAGE.read_text(encoding="utf-8")):
        if block.title:
            Path(block.title).write_text(block.text, encoding="utf-8")
        for line in block.text.splitlines() if block.language == "sh" else ():
            program, *arguments = shlex.split(line)
            assert [program, arguments[0]] == ["surgsim", "evaluate"]
            surgsim("evaluate", *shorter(arguments[1:]))
            commands += 1
    sys.modules.pop("my_agent", None)
    printed = capsys.readouterr().out
    assert commands == 6
    assert "presses to 5 mm: my_agent.Spread " in printed
    assert load_result(Path("scores/Palpate_phantom_small_my_agent.Descend.json")).env_id == "SurgSim/Palpate-v0"
