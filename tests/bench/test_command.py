"""`surgsim bench` as a user meets it, on the smallest of everything: report, absent peers, exit status."""

import re

import pytest

from surgsim_apps.bench import measurement as effort
from surgsim_apps.bench import peers, side_by_side, start
from surgsim_apps.bench.measurement import Effort
from surgsim_apps.cli.main import main

TINY = Effort(
    blocks=((4, 4, 4), (7, 7, 5), (8, 8, 5)), substep_rounds=1, scenes=("bovine_liver_block",), haptic_steps=20,
    env_counts=(1, 2), control_steps=2, control_rounds=1, organ_cells=(6, 6, 3), grid=(4, 4, 3), press_rounds=1,
    longer_steps=(2,), starts=1, memory_envs=1, rollout_steps=2, training_rounds=1,
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:scene:UserWarning")
def test_bench(tmp_path, monkeypatch, capsys):
    def missing(name: str):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(effort, "QUICK", TINY)
    monkeypatch.setattr(peers, "import_module", missing)
    monkeypatch.setattr(side_by_side, "reference_force", lambda contact: 0.2)
    # Starts from an empty cache take half a minute.
    monkeypatch.setattr(start, "printed_number", lambda code, environment=None: 1.5)
    assert main(["bench", "--quick", "--out", str(tmp_path / "deep")]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("written: ")
    report = (tmp_path / "deep" / "benchmarks.md").read_text(encoding="utf-8")
    for heading in ("Substep cost", "Haptic step", "Control steps a second", "Beside MuJoCo flex", "Start and memory"):
        assert f"<summary>{heading}" in report
    for case in ("205 nodes", "exponent", "bovine_liver_block", "single", "processes", "surgsim", "Retract, pictures"):
        assert f"\n| {case} |" in report, case
    for name in ("Newton explicit", "Newton vbd"):
        assert re.search(rf"\| {name} \| absent \|.*not installed", report)
    assert "trilinear 1x1x1" in report and side_by_side.LIMITS.strip() in report


def test_no_folder_can_be_made_of_a_file(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["bench", "--quick", "--out", str(tmp_path / "file")]) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_a_fresh_interpreter_prints_a_number():
    assert start.printed_number("import os; print('noise'); print(os.environ['MARK'])", {"MARK": "2.5"}) == 2.5
