"""Figures as tables, and what is absent with its reason; the page of them."""

import re

from surgsim_apps.bench import page
from surgsim_apps.bench.report import Figure, Section, absent, describe, version
from surgsim_apps.reports.output_folder import OutputFolder

SECTION = Section(
    "press",
    "Presses",
    "A method.",
    [
        Figure("one peer", "wall", 12.3456, "s/s", "its setting"),
        Figure("one peer", "force", 0.25, "N"),
        absent("another", "wall", "s/s", "not\n installed"),
    ],
    "A closing.",
)


def test_table():
    text = SECTION.markdown()
    assert text.startswith("A method.\n")
    assert "|  | wall [s/s] | force [N] | note |" in text
    assert "| one peer | 12.35 | 0.25 | its setting |" in text
    assert "| another | absent |  | not installed |" in text
    assert text.endswith("A closing.\n")


def test_table_without_notes_has_no_column_for_them():
    assert "| a | 1 |\n" in Section("k", "h", "m", [Figure("a", "q", 1.0, "1")]).markdown()


def test_machine_names_versions_and_absent_packages():
    text = describe("0.5")
    assert f"mujoco {version('mujoco')}" in text
    assert version("no-such-package-as-this") == "absent"
    assert "cores of" in text and "date: 20" in text


def test_page_has_charts_ranges_of_simulators_and_folded_tables(tmp_path):
    presses = [
        *(Figure("surgsim", "processor", 0.704, "s/s"), Figure("surgsim", "error", 11.3, "%")),
        *(
            Figure("MuJoCo flex full, 1 ms", "processor", 25.14, "s/s"),
            Figure("MuJoCo flex full, 1 ms", "error", -15.7, "%"),
        ),
        *(
            Figure("MuJoCo flex full, 8 ms", "processor", 5.69, "s/s"),
            Figure("MuJoCo flex full, 8 ms", "error", 1971.0, "%"),
        ),
        absent("Newton vbd", "wall", "s/s", "not installed"),
    ]
    rates = [Figure(way, f"{count} envs", 10.0 * count, "1/s") for way in ("in turn", "abreast") for count in (4, 16)]
    sections = [Section("side_by_side", "Presses", "", presses), Section("control_steps", "Rates", "", rates)]
    page.write_page(sections, "* machine", OutputFolder(tmp_path, tmp_path), quick=False)
    text = (tmp_path / "benchmarks.md").read_text(encoding="utf-8")
    assert "surgsim 0.7 s (force 11 % off), MuJoCo flex full 5.7 to 25 s (force 16 to 2000 % off)." in text
    assert "16 environments: in turn: 160; abreast: 160 " in text and "<summary>Rates</summary>" in text
    assert all((tmp_path / picture).is_file() for picture in re.findall(r"\((images/[\w.]+)\)", text))
