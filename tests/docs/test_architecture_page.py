"""The page on the architecture names the places of common changes."""

import ast
import re

import pytest

from tests.architecture import REPOSITORY, room_imports

PAGE = (REPOSITORY / "docs" / "architecture.md").read_text(encoding="utf-8")
# A row: question | files | names.
ROWS = re.findall(
    r"^\| ([^|`]+) \| (`[^|]+) \| (`[^|]+) \|$", PAGE.partition("## Places of common changes")[2], re.MULTILINE
)


def defined_names(text: str) -> set[str]:
    """Names that a source text defines: functions, classes, variables and fields."""
    names = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {target.id for target in targets if isinstance(target, ast.Name)}
    return names


@pytest.mark.parametrize(("question", "files", "names"), ROWS, ids=[row[0] for row in ROWS])
def test_place_of_a_change_is_at_most_two_files(question, files, names):
    paths = re.findall(r"`([\w/]+\.py)`", files)
    assert 1 <= len(paths) <= 2
    defined = set().union(*(defined_names((REPOSITORY / path).read_text(encoding="utf-8")) for path in paths))
    assert set(re.findall(r"`(\w+)`", names)) <= defined


@pytest.mark.parametrize("subject", ["contact force", "reward term", "URDF", "field of scene files"])
def test_four_questions_have_a_row(subject):
    assert [question for question, _, _ in ROWS if subject in question]


def test_every_room_has_a_row():
    for package in ("msdm_core", "surgsim_env", "surgsim_apps"):
        table = PAGE.partition(f"| `{package}` | owns")[2].partition("\n\n")[0]
        named = set(re.findall(r"`(\w+)`", "\n".join(row.split("|")[1] for row in table.splitlines()[2:])))
        assert set(room_imports(package)) - {"errors", "numba_cache"} == named
