"""The notebooks of docs/ run from their first cell to their last, and what they store is small and names no machine."""

import base64
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


@pytest.fixture(scope="module")
def pages():
    return script(ROOT / "docs" / "hooks" / "notebook_pages.py")


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


def test_what_is_of_the_machine_is_left_out(maker):
    new = maker.nbformat.v4
    cell = new.new_code_cell("draw()", metadata={"execution": {"iopub.execute_input": "2025-01-01"}})
    cell.outputs = [
        new.new_output("stream", name="stderr", text="/tmp/ipykernel_1/2.py:1: UserWarning"),
        new.new_output("execute_result", data={"text/plain": "<Figure at 0x7f1234567890>"}),
    ]
    kept = maker.cleaned(
        new.new_notebook(cells=[cell], metadata={"language_info": {"name": "python", "version": "3.11.7"}})
    )
    assert kept.metadata == maker.METADATA and kept.cells[0].metadata == {}
    (output,) = kept.cells[0].outputs
    assert output.data["text/plain"] == "<Figure>"


def test_a_page_has_text_code_outputs_and_pictures(pages):
    picture = base64.b64encode(b"\x89PNG...").decode()
    cells = [
        {"cell_type": "markdown", "source": ["# Press\n", "\n", "See [another](own_patient.ipynb)."]},
        {
            "cell_type": "code",
            "source": "press()",
            "outputs": [
                {"output_type": "stream", "name": "stdout", "text": "0.40 N\n"},
                {"output_type": "display_data", "data": {"image/png": picture}},
            ],
        },
    ]
    text, pictures = pages.page_of({"cells": cells}, "press")
    assert pictures == {"press/0.png": b"\x89PNG..."}
    assert text.startswith("# Press\n\nSee [another](own_patient.md).\n\n[Save this notebook](press.ipynb)")
    assert text.endswith('```python\npress()\n```\n\n```text title="prints"\n0.40 N\n```\n\n![Press](press/0.png)\n')
    cells[1]["outputs"] = [{"output_type": "error", "ename": "ValueError"}]
    with pytest.raises(pages.PluginError, match=r"press.ipynb: an output of the kind 'error'"):
        pages.page_of({"cells": cells}, "press")


def test_the_site_has_each_notebook_with_its_pictures(site_folder):
    for name in NAMES:
        page = (site_folder / "notebooks" / f"{name}.html").read_text(encoding="utf-8")
        count = sum("image/png" in output.get("data", {}) for output in outputs(name))
        assert len(re.findall(rf'<img[^>]+src="{name}/\d+\.png"', page)) == count > 0
        assert (site_folder / "notebooks" / f"{name}.ipynb").is_file()
    index = (site_folder / "notebooks" / "index.html").read_text(encoding="utf-8")
    assert all(f'href="{name}.html"' in index for name in NAMES)
