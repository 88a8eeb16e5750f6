"""The examples of the README and of two guides run as printed, and files that the README names exist."""

import ast
import re
from pathlib import Path

import pytest

from surgsim_env.rendering import gl

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def examples(path: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / path).read_text(encoding="utf-8"), flags=re.S)


def test_python_example_runs(capsys):
    (code,) = examples("README.md")
    exec(compile(code, "README.md", "exec"), {})
    assert re.search(r"contact force \[.*\] N, largest 0\.\d\d N", capsys.readouterr().out)


def test_retraction_example_runs(capsys):
    (code,) = (example for example in examples("docs/retraction.md") if "oracle_script" in example)
    exec(compile(code, "docs/retraction.md", "exec"), {})
    grip, pull, seen = re.findall(r"[\d.]+", capsys.readouterr().out)
    assert 0.3 < float(grip) < 0.6 and 0.1 < float(pull) < 1.0 and float(seen) >= 80


@pytest.mark.agents
def test_video_example_runs_and_writes_a_video(tmp_path, monkeypatch):
    (code,) = (example for example in examples("docs/rendering.md") if "RecordVideo" in example)
    pytest.importorskip("moviepy", reason="needs the `video` extra")
    try:
        gl.context()
    except gl.NoGLError as error:
        pytest.skip(f"no pictures on this machine: {error}")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "docs/rendering.md", "exec"), {})
    (video,) = (tmp_path / "runs" / "videos").glob("*.mp4")
    assert video.stat().st_size > 1000


# A file of the checkout by its whole path; NAME and SEED stand for what a user puts there.
FILE = re.compile(r"(?<![\w./-])(?:agents|docs|scenes|tests|surgsim_\w+|msdm_core)/[\w./-]*?\.[a-z]{2,4}\b")
NAMING = [ROOT / "README.md", ROOT / "agents" / "README.md", *sorted((ROOT / "agents").glob("*.py"))]


@pytest.mark.parametrize("file", NAMING, ids=lambda file: str(file.relative_to(ROOT)))
def test_files_named_in_full_exist(file):
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".py":
        text = ast.get_docstring(ast.parse(text)) or ""
    for path in FILE.findall(text):
        assert "NAME" in path or (ROOT / path).exists(), path
    for module in re.findall(r"python -m (agents\.\w+)", text):
        assert (ROOT / module.replace(".", "/")).with_suffix(".py").is_file(), module


def test_linked_pictures_and_pages_exist():
    for target in re.findall(r"\]\(([^)#]*)\)", README):
        assert (ROOT / target).is_file(), target
