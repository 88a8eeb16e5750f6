"""Every script in agents/ runs, on a few hundred steps or less, and leaves or says what it is for."""

import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

pytestmark = pytest.mark.agents
pytest.importorskip("sb3_contrib", reason="needs the `agents` extra")

ROOT = Path(__file__).resolve().parents[2]
AGENTS = ROOT / "agents"

# Scripts that other tests run.
ELSEWHERE = {
    "behaviour_cloning": "test_demonstrations.py",
    "convert_policy": "test_policy_files.py",
    "learn_palpate": "test_palpate_agents.py",
    "learn_palpate_organs": "test_organ_agents.py",
    "learn_palpate_recurrent": "test_palpate_agents.py",
    "learn_retract": "test_retract_agents.py",
    "learn_retract_pixels": "test_pixel_agents.py",
    "learn_sites": "test_learn_sites.py",
    "leaderboard": "test_evaluate.py",
    "learning_curves": "test_from_scratch.py",
    "make_press_library": "test_press_library.py",
    "organ_film": "test_evaluate.py",
    "raster": "test_agents.py",
    "record_demonstrations": "test_demonstrations.py",
    "record_faces": "test_recorded_faces.py",
    "train_rllib": "test_rllib.py",
}


def scripts() -> set[str]:
    return {path.stem for path in AGENTS.glob("*.py") if '__name__ == "__main__"' in path.read_text(encoding="utf-8")}


def test_every_script_is_run_somewhere():
    assert scripts() == {*ELSEWHERE, "palpation_figures"}
    for name, where in ELSEWHERE.items():
        named = rf"(agents\.|import |\"){name}\b|from agents import .*\b{name}\b"
        assert re.search(named, (Path(__file__).parent / where).read_text(encoding="utf-8")), name


def test_the_picture_of_a_search_is_drawn(tmp_path, monkeypatch):
    from agents import palpation_figures

    monkeypatch.setattr(palpation_figures, "SHOWN_PRESSES", (1, 2))
    palpation_figures.draw_search(tmp_path / "search.png")
    image = imread(tmp_path / "search.png")
    assert len(np.unique(image.reshape(-1, image.shape[2]), axis=0)) > 100


def test_what_the_readme_names_is_there():
    text = (AGENTS / "README.md").read_text(encoding="utf-8")
    for file in re.findall(r"`([a-z_/]+\.(?:py|npz)|[a-z]+/)`", text):
        assert (AGENTS / file).exists() or (ROOT / file).is_file(), file
    for module in re.findall(r"python -m agents\.(\w+)", text):
        assert (AGENTS / f"{module}.py").is_file(), module
    for config in re.findall(r"agents/configs/([a-z_]+\.\w+)", text):
        assert (AGENTS / "configs" / config).is_file(), config
