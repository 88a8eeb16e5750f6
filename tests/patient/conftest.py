"""Fixtures for `surgsim organ` and `surgsim palpate`: a written organ, and the line of a refusal."""

from collections.abc import Callable
from pathlib import Path

import pytest

from surgsim_apps.cli.main import main
from tests.patient.scans import LABELS, scan


@pytest.fixture(scope="session")
def written(tmp_path_factory) -> Path:
    """The folder of an organ made from a scan with two lesions; to be read only."""
    folder = tmp_path_factory.mktemp("organ")
    file = scan(tmp_path_factory.mktemp("scan") / "ct.nii.gz", spacing=(1.5, 1.5, 2.5))
    given = ["organ", str(file), *LABELS, "--cell-size", "0.006", "--no-healthy-map"]
    assert main([*given, "--out", str(folder / "patient.vtu")]) == 0
    return folder


@pytest.fixture
def refusal(capsys) -> Callable[..., str]:
    """A function that gives a command line and returns the one line on standard error that refuses it."""

    def refuse(*arguments) -> str:
        assert main([str(argument) for argument in arguments]) == 2
        lines = [line for line in capsys.readouterr().err.splitlines() if "surgsim: warning" not in line]
        assert len(lines) == 1
        assert "Traceback" not in lines[0]
        return lines[0]

    return refuse
