"""The Python of docs/scripting.md runs as printed, one block after the other."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = (ROOT / "docs" / "scripting.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", DOCS, flags=re.S)


def test_the_examples_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for block in BLOCKS:
        exec(compile(block, "docs/scripting.md", "exec"), names)
    first, second = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"peak 0\.3\d N, [2-5]\.\d mm deep", first), first
    assert second == "True 0.19 N"
    assert {path.name for path in tmp_path.iterdir()} == {"run.csv", "run_control.csv", "run.png"}


@pytest.mark.slow
def test_the_guide_to_retraction_runs(capsys):
    text = (ROOT / "docs" / "retraction.md").read_text(encoding="utf-8")
    code = re.findall(r"```python\n(.*?)```", text, flags=re.S)[-1]  # the first one is run by tests/test_readme.py
    exec(compile(code, "docs/retraction.md", "exec"), {})
    grip, pull, left = map(float, re.findall(r"[\d.]+", capsys.readouterr().out))
    assert 0.3 < grip < 0.6 and pull < 0.3 and left > 0.2
