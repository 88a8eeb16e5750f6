"""The notebooks of docs/ run from their first cell to their last, and store nothing of a machine."""

import importlib.util
import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "notebooks"
NAMES = sorted(path.stem for path in FOLDER.glob("*.ipynb"))
NEEDS_AGENTS = {"train_an_agent"}
# About a minute each; `train_an_agent` takes as long, but is the one that is run where the `agents` extra is.
SLOW = {"stiffness_map", "two_arms"}
# Absolute paths of a machine, addresses of objects, and what IPython calls its cells.
OF_A_MACHINE = re.compile(r"(?:/(?:home|root|tmp|work|Users|usr|opt|var|mnt)/|[A-Z]:\\\\|0x[0-9a-f]{6,}|ipykernel)")


def script(path: Path):
    """A module of docs/, which is no package."""
    specification = importlib.util.spec_from_file_location(path.stem, path)
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def maker():
    return script(ROOT / "docs" / "make_notebooks.py")


def stored(name: str) -> dict:
    return json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))


def outputs(name: str) -> list[dict]:
    return [output for cell in stored(name)["cells"] for output in cell.get("outputs", [])]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.agents] * (name in NEEDS_AGENTS) + [pytest.mark.slow] * (name in SLOW))
        for name in NAMES
    ],
)
def test_it_runs(name, maker, tmp_path):
    if name in NEEDS_AGENTS:
        pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")
    notebook = maker.nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    done = maker.run_notebook(notebook, tmp_path)
    drawn = [output for cell in done.cells for output in cell.get("outputs", []) if maker.PNG in output.get("data", {})]
    assert drawn


@pytest.mark.parametrize("name", NAMES)
def test_what_is_stored_names_no_machine(name, maker):
    notebook = stored(name)
    assert notebook["metadata"] == maker.METADATA
    for cell in notebook["cells"]:
        assert cell["metadata"] == {}
        for output in cell.get("outputs", []):
            texts = [output.get("text", ""), output.get("data", {}).get("text/plain", "")]
            said = "".join("".join(text) for text in texts)
            assert OF_A_MACHINE.search(said) is None, said
            assert output.get("name") != "stderr" and output["output_type"] != "error"
            assert set(output.get("data", {})) <= {"image/png", "text/plain"}
