"""The example, the command and the ports file of docs/arms_report.md and the README do what they say."""

import re
import tomllib
from pathlib import Path

import pytest

from surgsim_apps.arms import study
from surgsim_apps.arms.ports import Wall, default_ports, ports_from_table
from surgsim_apps.arms.results import REASONS
from surgsim_apps.cli.main import main
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from tests.arms.made import made_evaluation

ROOT = Path(__file__).resolve().parents[2]
DOCS = (ROOT / "docs" / "arms_report.md").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_example_runs(capsys):
    (block,) = re.findall(r"```python\n(.*?)```", DOCS, flags=re.S)
    exec(compile(block, "docs/arms_report.md", "exec"), {})
    reachable, force = capsys.readouterr().out.splitlines()
    assert reachable == re.findall(r"# ([\d.]+)", block)[0]
    assert re.fullmatch(r"1\d\.\d N", force)


def test_every_reason_is_explained():
    for reason in REASONS[1:]:
        assert f"| {reason} |" in DOCS


def test_the_ports_file_is_read_and_is_where_ports_are_by_default():
    text = re.findall(r"```toml\n(.*?)```", DOCS, flags=re.S)[0]
    ports = ports_from_table(tomllib.loads(text), name="ports")
    anatomy = load_anatomy(make_scene("liver"))
    ports.check_outside(anatomy)
    usual = default_ports(anatomy)
    for name in ("left", "right", "endoscope"):
        for mine, theirs in zip(getattr(ports, name).point, getattr(usual, name).point, strict=True):
            assert abs(mine - theirs) < 1e-3
    assert ports.wall == usual.wall == Wall() and len(ports.targets) == 1


@pytest.mark.slow
@pytest.mark.usefixtures("few_maps")
def test_the_command_runs_and_writes_what_the_table_lists(tmp_path, monkeypatch):
    (command,) = set(re.findall(r"^surgsim (arms .*--compare.*)$", DOCS + README, flags=re.M))
    text = re.findall(r"```toml\n(.*?)```", DOCS, flags=re.S)[0]
    monkeypatch.chdir(tmp_path)
    for name in ("ports.toml", "wide.toml"):
        Path(name).write_text(text)
    monkeypatch.setattr(study, "evaluate_arms", lambda *_, **__: made_evaluation())
    assert main(command.split()) == 0
    listed = re.findall(r"^\| `([\w.*]+)` \|", DOCS.partition("\n## Ports")[0], flags=re.M)
    assert len(listed) == 4
    for pattern in listed:
        assert list(Path("runs/arms").glob(pattern)), pattern
