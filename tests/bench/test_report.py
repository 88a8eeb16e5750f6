"""Figures as tables, and what is absent with its reason."""

from surgsim_apps.bench.report import Figure, Section, absent, describe, version

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
    assert "## Presses\n\nA method.\n" in text
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
