"""The Python of docs/arms.md runs as printed, one block after the other, and shows what it says."""

import re
import tomllib
from pathlib import Path

from surgsim_env.scene.load import read_toml, scene_from_table, scenes_folder

DOCS = (Path(__file__).resolve().parents[2] / "docs" / "arms.md").read_text(encoding="utf-8")


def test_the_examples_run(capsys):
    blocks = re.findall(r"```python\n(.*?)```", DOCS, flags=re.S)
    assert len(blocks) == 4
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, "docs/arms.md", "exec"), names)
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == "['psm_grasper', 'psm_palpator', 'psm_retractor', 'six_axis']"
    assert re.fullmatch(r"\S*e-1\d False", printed[1]), printed[1]
    assert printed[2].startswith("True [") and printed[2].endswith(" m")
    assert re.match(r"False \de-\d+ m", printed[3])
    assert re.fullmatch(r"0\.0\d\d mm", printed[4])


def test_the_scene_port_is_read():
    (port,) = re.findall(r"```toml\n(\[port\]\n.*?)```", DOCS, flags=re.S)
    organs = scenes_folder() / "organs"
    table = {**read_toml(organs / "phantom.toml", "scene"), **tomllib.loads(port)}
    scene = scene_from_table(table, name="mine", folder=organs)
    assert scene.port is not None and scene.port.into == (-0.5, 0.0, -0.866)
