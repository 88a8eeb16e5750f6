"""The notebooks of docs/ run from their first cell to their last."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "notebooks"
NAMES = sorted(path.stem for path in FOLDER.glob("*.ipynb"))
NEEDS_AGENTS = {"train_an_agent"}
# A minute or half each; `train_an_agent` takes as long, but is the one that is run where the `agents` extra is. The
# tutorial of the same name has most of `own_patient`.
SLOW = {"stiffness_map", "two_arms", "own_patient"}


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
