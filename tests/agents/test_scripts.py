"""Every script in agents/ runs, on a few hundred steps or less, and leaves or says what it is for."""

import re
import runpy
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.agents
pytest.importorskip("sb3_contrib", reason="needs the `agents` extra")

ROOT = Path(__file__).resolve().parents[2]
AGENTS = ROOT / "agents"

# Arguments that make a run short, and what it has said or written by then; "OUT" is a folder.
SMALL: dict[str, tuple[list[str], str]] = {
    "expert_palpate": (["--envs", "1", "--episodes", "1"], r"1 episodes: success"),
    "learn_palpate": (
        ["--scene", "phantom_small", "--rounds", "2", "--steps", "40", "--envs", "8", "--out", "OUT/a.zip"],
        r"sample_count=640",
    ),
    "press_library": (["--scene", "phantom_small", "--organs", "1", "--out", "OUT/library.npz"], ""),
}
# Scripts that other tests run.
ELSEWHERE = {
    "behaviour_cloning": "test_demonstrations.py",
    "evaluate": "test_evaluate.py",
    "expert_retract": "test_retract_agents.py",
    "learn_retract": "test_retract_agents.py",
    "raster": "test_agents.py",
    "record_demonstrations": "test_demonstrations.py",
    "train": "test_training.py",
    "train_rllib": "test_rllib.py",
}


def scripts() -> set[str]:
    return {path.stem for path in AGENTS.glob("*.py") if '__name__ == "__main__"' in path.read_text(encoding="utf-8")}


def test_every_script_is_run_somewhere():
    assert scripts() == set(SMALL) | set(ELSEWHERE)
    for name, where in ELSEWHERE.items():
        imported = rf"(agents\.|import ){name}\b|from agents import .*\b{name}\b"
        assert re.search(imported, (Path(__file__).parent / where).read_text(encoding="utf-8")), name


@pytest.mark.parametrize("name", sorted(SMALL))
def test_it_runs(name, tmp_path, monkeypatch, capsys):
    arguments, said = SMALL[name]
    monkeypatch.setattr(sys, "argv", [name, *(part.replace("OUT", str(tmp_path)) for part in arguments)])
    runpy.run_module(f"agents.{name}", run_name="__main__")
    assert re.search(said, capsys.readouterr().out)
    if name == "press_library":
        assert (tmp_path / "library.npz").is_file()
    if "OUT/a.zip" in arguments:
        from agents.training.policy_files import load_policy

        assert load_policy(tmp_path / "a.zip").description.algorithm == "PPO"


def test_what_the_readme_names_is_there():
    text = (AGENTS / "README.md").read_text(encoding="utf-8")
    for file in re.findall(r"`([a-z_]+\.py|[a-z]+/)`", text):
        assert (AGENTS / file).exists(), file
    for module in re.findall(r"python -m agents\.(\w+)", text):
        assert (AGENTS / f"{module}.py").is_file(), module
    for config in re.findall(r"agents/configs/([a-z_]+\.\w+)", text):
        assert (AGENTS / "configs" / config).is_file(), config
