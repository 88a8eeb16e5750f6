"""What docs/evaluation.md shows is so."""

import re
import tomllib
from pathlib import Path

import pytest

from surgsim_apps.arms.ports import Wall, default_ports, ports_from_table
from surgsim_apps.arms.results import REASONS
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene

DOCS = (Path(__file__).resolve().parents[2] / "docs" / "evaluation.md").read_text(encoding="utf-8")


def test_the_example_runs(capsys):
    (block,) = re.findall(r"```python\n(.*?)```", DOCS, flags=re.S)
    exec(compile(block, "docs/evaluation.md", "exec"), {})
    reachable, force = capsys.readouterr().out.splitlines()
    assert reachable == re.findall(r"# ([\d.]+)", block)[0]
    assert re.fullmatch(r"1\d\.\d N", force)


def test_the_ports_are_read_and_their_wall_is_the_default():
    (block,) = re.findall(r"```toml\n(.*?)```", DOCS, flags=re.S)
    ports = ports_from_table(tomllib.loads(block), name="docs")
    assert ports.wall == Wall()
    shipped = default_ports(load_anatomy(make_scene("phantom")))
    assert ports.left.point == pytest.approx(shipped.left.point)
    assert ports.endoscope.point == pytest.approx(shipped.endoscope.point)


def test_every_reason_is_explained():
    for reason in REASONS[1:]:
        assert f"| {reason} |" in DOCS
