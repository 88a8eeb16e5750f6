"""`surgsim doctor`: a sound installation, what is missing, what is broken."""

from importlib import metadata

import pytest
from packaging.requirements import Requirement

from surgsim_apps.cli import doctor
from surgsim_apps.cli.main import main
from surgsim_env.rendering import gl


def states(capsys):
    """The state of each subject of a run that just ended, and its text, from its table."""
    rows = [line.strip("│").split("│") for line in capsys.readouterr().out.splitlines() if line.startswith("│")]
    return {subject.strip(): (state.strip(), text.strip()) for subject, state, text in rows}


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    """A terminal of rows that are one line each."""
    monkeypatch.setenv("COLUMNS", "1000")


def test_this_installation_is_sound(capsys):
    assert main(["doctor"]) == 0
    report = states(capsys)
    assert list(report)[:7] == [
        *("Python", "processor", "OpenGL", "compiled code", "haptic steps", "self-test", "packages"),
    ]
    assert list(report)[7:] == sorted(doctor.FEATURES)
    assert {state for state, _ in report.values()} <= {"ok", "missing"}
    for subject in ("self-test", "haptic steps", "packages", "live"):
        assert report[subject][0] == "ok", report[subject]


def test_every_extra_has_its_feature_named():
    extras = set(metadata.metadata("surgsim").get_all("Provides-Extra"))
    assert set(doctor.FEATURES) == extras - {"dev"}


def test_another_force_is_broken(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "PRESS_FORCE", doctor.PRESS_FORCE * (1.0 + 2.0 * doctor.FORCE_TOLERANCE))
    assert main(["doctor"]) == 1
    state, text = states(capsys)["self-test"]
    assert state == "broken" and "it must be" in text


def test_a_check_that_fails_is_broken_and_the_others_go_on(monkeypatch, capsys):
    def fails():
        raise RuntimeError("no such\nthing")

    monkeypatch.setattr(doctor, "press", fails)
    assert main(["doctor"]) == 1
    report = states(capsys)
    assert report["fails"] == ("broken", "RuntimeError: no such thing") and "packages" in report


def test_packages_that_are_absent_or_of_another_version(monkeypatch):
    assert doctor.lack(Requirement("numpy>=2.0")) == ""
    assert "the rule is <1" in doctor.lack(Requirement("numpy<1"))
    assert doctor.lack(Requirement("no-such-package")) == "no-such-package is not installed"
    required = ["numpy<1", "no-such-package>=2; extra == 'live'"]
    monkeypatch.setattr(metadata, "requires", lambda name: required)
    report = {finding.subject: finding for finding in doctor.packages()}
    assert report["packages"].state == "broken" and "numpy is" in report["packages"].text
    assert report["live"].state == "missing" and "pip install 'surgsim[live]'" in report["live"].text
    assert report["video"].state == "ok"


def test_a_checkout_without_an_installation_is_a_row(monkeypatch):
    def absent(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "requires", absent)
    (row,) = doctor.packages()
    assert (row.subject, row.state) == ("packages", "missing") and "pip install -e" in row.text


def test_no_opengl_and_no_cache_are_missing_features(monkeypatch):
    def none():
        raise gl.NoGLError("install libegl1")

    monkeypatch.setattr(gl, "context", none)
    assert doctor.opengl().state == "missing" and "libegl1" in doctor.opengl().text
    monkeypatch.setattr(doctor.tempfile, "TemporaryFile", lambda dir: (_ for _ in ()).throw(OSError(30, "Read-only")))
    report = doctor.cache()
    assert report.state == "missing" and "NUMBA_CACHE_DIR" in report.text
