"""The cases of `surgsim validate`: every row is met, or listed with its reason among the known shortfalls."""

import csv
import math
import re
from pathlib import Path

import pytest
from rich.console import Console

from surgsim_apps.reports.output_folder import OutputFolder
from surgsim_apps.validation import page, suite
from surgsim_apps.validation.row import Case, Row, bounded, compare

DOCS = Path(__file__).parents[2] / "docs"
TABLE = list(csv.DictReader((DOCS / "validation.csv").read_text(encoding="utf-8").splitlines()))
# Cases of a quick run that take more than a second each.
LONG = {
    *("passivity, bounces", "fitted springs, torsion", "cosine load", "capsule, pulled", "on supports", "deep presses"),
    *("contrast, coarse", "fitted springs, tension", "fitted springs, cantilever", "grasped strip"),
    *("flat punch", "cantilever", "clamped torsion", "graded prism", "lesion anywhere", "capsule, curved"),
    *("large strain, linear", "large strain, stiffening", "step strain", "step strain, stiffening", "creep"),
    *("creep, nu 0.45", "stiffening in all directions"),
    *("Eshelby, coarse", "energy", "fitted springs, rod", "capsule, faces", "bar in tension", "passivity, presses"),
}
PARAMETERS = [
    pytest.param(case, id=case.name, marks=[pytest.mark.slow] if case.slow or case.name in LONG else [])
    for case in suite.CASES
]


@pytest.mark.parametrize("case", PARAMETERS)
def test_case(case: Case):
    validation = suite.run_cases(quick=False, console=Console(quiet=True), cases=(case,))
    assert validation.rows
    rows = validation.unexplained
    unmet = [f"{row.case}: expected {row.expected:.6g}, measured {row.measured:.6g}" for row in rows]
    assert not unmet, "not met, and not a known shortfall or worse than known"
    assert not validation.outdated, "no longer a shortfall"
    missing = {row.case for row in validation.rows} - {line["case"] for line in TABLE}
    assert not missing, "docs/validation.csv is older than these rows: run surgsim validate"


def test_the_page_is_of_the_table(tmp_path):
    text = (DOCS / "validation.md").read_text(encoding="utf-8")
    written, plots = re.findall(r"Written by .*", text)[0], text.partition("</summary>\n\n")[2].split("\n\n")[:-1]
    causes = {case: shortfall.cause for case, shortfall in suite.load_shortfalls().items()}
    page.write_page(TABLE, causes, plots, written, OutputFolder(tmp_path, tmp_path))
    assert (tmp_path / "validation.md").read_text(encoding="utf-8") == text


def test_answers_of_other_pages_stand_there():
    answers = re.sub(r"\\\n", "", page.ELSEWHERE).splitlines()
    pages = [re.search(r"`docs/(\w+\.md)`", answer)[1] for answer in answers]
    assert pages == ["reliability.md", "real_tissue.md"]
    text = (DOCS / pages[1]).read_text(encoding="utf-8")
    for figure in re.findall(r"(\d[\d.]*) (?:%|to)", answers[1].partition("| presses")[2]):
        assert f"{figure} %" in text


def test_every_row_of_the_table_has_a_group():
    assert "Others" not in page.grouped(TABLE) and set(page.QUESTIONS) < set(page.grouped(TABLE))


def row(name: str, measured: float) -> Row:
    return compare(name, "by hand", expected=1.0, measured=measured, tolerance=0.05)


def test_verdicts():
    assert row("near", 1.049).verdict == "met"
    assert row("far", 0.94).verdict == "not met"
    assert row("nothing", math.nan).verdict == "not met"
    assert compare("pp", "", expected=-50.0, measured=-50.03, tolerance=0.02, absolute=True).verdict == "not met"


def test_a_bound_holds_on_its_side():
    assert [bounded("share", "", measured=value, most=0.4).verdict for value in (0.1, 0.4, 0.41)] == [
        "met",
        "met",
        "not met",
    ]
    assert [bounded("angle", "", measured=value, least=8.0).verdict for value in (9.0, 7.9)] == ["met", "not met"]
    assert bounded("nothing", "", measured=math.nan, most=1.0).verdict == "not met"
    assert bounded("share", "", measured=0.5, most=0.4).error == pytest.approx(0.25)


def test_a_run_passes_only_where_every_shortfall_is_known(monkeypatch):
    cases = (Case("good", lambda: [row("good", 1.0)]), Case("bad", lambda: [row("bad", 2.0)]))
    known = {"good": suite.Shortfall("once", 1.0, "")}
    monkeypatch.setattr(suite, "load_shortfalls", lambda: known)
    validation = suite.run_cases(quick=False, console=Console(quiet=True), cases=cases)
    assert not validation.passed and [row.case for row in validation.unexplained] == ["bad"]
    assert validation.outdated == ["good"]
    known.clear()
    known["bad"] = suite.Shortfall("soft", 1.0, "")
    validation = suite.run_cases(quick=False, console=Console(quiet=True), cases=cases)
    assert validation.passed and validation.reason(validation.rows[1]) == "soft"
    known["bad"] = suite.Shortfall("soft", 0.9, "")
    assert not suite.run_cases(quick=False, console=Console(quiet=True), cases=cases).passed
