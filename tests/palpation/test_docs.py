"""The example of docs/palpation.md runs."""

import re
from pathlib import Path

import pytest

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "palpation.md").read_text(encoding="utf-8")


def test_the_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    exec(compile(code, "docs/palpation.md", "exec"), {})
    assert re.search(r"\d lesions estimated, error \d+\.\d mm", capsys.readouterr().out)
