"""The notebooks of docs/ run from their first cell to their last."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "notebooks"
NAMES = sorted(path.stem for path in FOLDER.glob("*.ipynb"))
# A minute or half each. The tutorial of the same name has most of `own_patient`.
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


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in NAMES])
def test_it_runs(name, maker, tmp_path):
    notebook = maker.nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    done = maker.run_notebook(notebook, tmp_path)
    drawn = [output for cell in done.cells for output in cell.get("outputs", []) if maker.PNG in output.get("data", {})]
    assert drawn
