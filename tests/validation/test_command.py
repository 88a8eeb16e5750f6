"""`surgsim validate` as a user meets it: the table, the report and the exit status, on two cheap cases."""

import pytest

from surgsim_apps.cli.main import main
from surgsim_apps.validation import suite
from surgsim_apps.validation.row import Case, Row, compare


def wrong() -> list[Row]:
    return [compare("a wrong one", "by hand", expected=1.0, measured=2.0, tolerance=0.1, unit="N")]


@pytest.mark.parametrize(("spoilt", "status"), [(False, 0), (True, 1)])
def test_validate(tmp_path, monkeypatch, capsys, spoilt, status):
    chosen = tuple(case for case in suite.CASES if case.name in ("Table I", "bar in tension"))
    cases = (*chosen, Case("wrong", wrong)) if spoilt else chosen
    run = suite.run_cases
    monkeypatch.setattr(suite, "run_cases", lambda **given: run(**given, cases=cases))
    assert main(["validate", "--quick", "--out", str(tmp_path)]) == status
    printed = capsys.readouterr().out
    assert "Table I" in printed and f"{int(spoilt)} not met" in printed
    report = (tmp_path / "validation.md").read_text(encoding="utf-8")
    assert f"{13 + spoilt} comparisons" in report and f"{int(spoilt)} for an unknown" in report
    assert "bar in tension, cell 5.0 mm: +7.2 %, tolerance 7 %" in report
    table = (tmp_path / "validation.csv").read_text(encoding="utf-8")
    assert '"Table I, h/a 0.40365, min cell","Sala 2011, Table I",-50.74 %,' in table
    assert ("a wrong one" in table) == spoilt
    assert (tmp_path / "images" / "validation_convergence.png").read_bytes().startswith(b"\x89PNG")
    assert "images/validation_convergence.png" in report
