"""Every script in agents/ runs, on a few hundred steps or less, and leaves or says what it is for."""

import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.agents

ROOT = Path(__file__).resolve().parents[2]
AGENTS = ROOT / "agents"

# Scripts that other tests run.
ELSEWHERE = {
    "behaviour_cloning": "test_demonstrations.py",
    "learn_palpate_organs": "test_organ_agents.py",
    "learn_retract": "test_retract_agents.py",
    "learn_sites": "test_learn_sites.py",
    "learn_slide": "test_slide_agents.py",
    "leaderboard": "test_evaluate.py",
    "record_demonstrations": "test_demonstrations.py",
    "record_faces": "test_recorded_faces.py",
}


def scripts() -> set[str]:
    return {path.stem for path in AGENTS.glob("*.py") if '__name__ == "__main__"' in path.read_text(encoding="utf-8")}


def test_every_script_is_run_somewhere():
    assert scripts() == set(ELSEWHERE)
    for name, where in ELSEWHERE.items():
        named = rf"(agents\.|import |\"){name}\b|from agents import .*\b{name}\b"
        assert re.search(named, (Path(__file__).parent / where).read_text(encoding="utf-8")), name


def test_what_the_readme_names_is_there():
    text = (AGENTS / "README.md").read_text(encoding="utf-8")
    for file in re.findall(r"`([a-z_/]+\.(?:py|npz)|[a-z]+/)`", text):
        assert (AGENTS / file).exists() or (ROOT / file).is_file(), file
    for module in re.findall(r"python -m agents\.(\w+)", text):
        assert (AGENTS / f"{module}.py").is_file(), module
