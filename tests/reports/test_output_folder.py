"""Results of commands appear at the end, and after an error none does."""

import contextlib
import errno
import itertools
import os
import signal
import subprocess
import sys

import pytest

from surgsim_apps.reports.output_folder import interrupts, lone_run, new_folder, output_folder
from tests.architecture import REPOSITORY

NAMES = ["a.csv", "b.png", "images/c.png"]


def write(files, text, names=NAMES):
    for name in names:
        (files / name).write_text(text, encoding="utf-8")


def content(folder):
    """Every file of a folder, hidden ones too."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_text(encoding="utf-8") for path in files}


def test_a_set_appears_at_the_end_and_replaces_the_older_one(tmp_path):
    out = tmp_path / "deep" / "out"
    with output_folder(out, [*NAMES, "only sometimes"]) as files:
        write(files, "old", [*NAMES, "only sometimes"])
        assert not any(path.is_file() for path in out.glob("*"))
    (out / "mine").write_text("mine", encoding="utf-8")
    with output_folder(out, [*NAMES, "only sometimes"]) as files:
        write(files, "new")
        assert content(out)["only sometimes"] == content(out)["a.csv"] == "old"
    assert content(out) == {**dict.fromkeys(NAMES, "new"), "mine": "mine"}
    assert files.path == out


@pytest.mark.parametrize("error", [ValueError("wrong"), KeyboardInterrupt()])
@pytest.mark.parametrize("there", [{}, dict.fromkeys(NAMES, "old")])
def test_an_error_leaves_what_was_there(tmp_path, there, error):
    out = tmp_path / "out"
    if there:
        with output_folder(out) as files:
            write(files, "old")
    with pytest.raises(type(error)), output_folder(out, NAMES) as files:
        write(files, "new")
        raise error
    assert (content(out) == there) if there else not out.exists()


def test_numbered_folders_and_files_are_taken_once(tmp_path):
    for number in (1, 2):
        with output_folder(tmp_path / "runs" / "palpate", numbered=True) as files:
            write(files, "new", ["a.csv"])
        assert files.path.name == f"palpate-{number}"
        with output_folder(tmp_path) as files:
            write(files, str(number), ["recording.csv"])
            assert files.number("recording.csv") == f"recording-{number}.csv"
    assert (tmp_path / "recording-2.csv").read_text() == "2"


def test_a_place_that_cannot_be_written_is_named_at_once(tmp_path):
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(OSError, match=r"--out .*file: cannot be written \(File exists\); choose another"):
        output_folder(tmp_path / "file").__enter__()


@pytest.mark.parametrize("kept", range(4))
def test_a_killed_process_leaves_no_new_result_beside_an_older_one(tmp_path, monkeypatch, kept):
    replace, calls = os.replace, itertools.count()

    def killed(*places):
        if next(calls) == kept:
            raise KeyboardInterrupt
        replace(*places)

    with output_folder(tmp_path) as files:
        write(files, "old")
    monkeypatch.setattr(os, "replace", killed)
    try:
        with output_folder(tmp_path, NAMES) as files:
            write(files, "new")
    except KeyboardInterrupt:
        assert kept < 3
    assert content(tmp_path) == (dict.fromkeys(NAMES[:kept], "new") if kept else {"a.csv": "old"})


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
@pytest.mark.parametrize("place", [None, "elsewhere/file"])
@pytest.mark.parametrize("writing", [output_folder, lone_run, new_folder])
def test_a_full_disk_is_named(tmp_path, number, place, writing):
    with pytest.raises(OSError) as refused, writing(tmp_path / "out"):
        raise OSError(number, os.strerror(number), place)
    assert str(refused.value).startswith(f"{place or tmp_path}") and "free disk space" in str(refused.value)
    assert not list(tmp_path.iterdir())


def test_a_new_folder_stays_whole_or_not_at_all(tmp_path):
    place = tmp_path / "deep" / "set"
    for error in (KeyboardInterrupt, None):
        with contextlib.suppress(KeyboardInterrupt), new_folder(place):
            place.mkdir(parents=True)
            (place / "a").write_text("a", encoding="utf-8")
            if error:
                raise error
        assert content(tmp_path) == ({} if error else {"deep/set/a": "a"})
    with pytest.raises(FileExistsError), new_folder(place):
        pass
    assert content(tmp_path) == {"deep/set/a": "a"}


HOLD = """
import sys, time
from pathlib import Path
from surgsim_apps.reports.output_folder import lone_run
with lone_run(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP])
def test_a_second_run_into_a_result_is_refused_until_the_first_ends(tmp_path, end):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    given = [sys.executable, "-c", HOLD, tmp_path / "link" / "policy.json"]
    first = subprocess.Popen(
        given, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env={**os.environ, "PYTHONPATH": str(REPOSITORY)}
    )
    assert first.stdout is not None and first.stdout.readline() == b"held\n"
    with pytest.raises(OSError, match=r"policy.json"), lone_run(tmp_path / "real" / "policy.json"):
        pass
    with lone_run(tmp_path / "real" / "other.json"):
        pass
    first.send_signal(end)
    first.communicate(timeout=60)
    with lone_run(tmp_path / "real" / "policy.json"):
        pass
    assert not content(tmp_path)


def test_signals_of_an_end_interrupt_once(monkeypatch):
    for number in (signal.SIGTERM, signal.SIGHUP):
        with pytest.raises(KeyboardInterrupt), interrupts(), interrupts():
            try:
                signal.raise_signal(number)
            finally:
                # While results are written.
                signal.raise_signal(signal.SIGHUP)
                signal.raise_signal(signal.SIGTERM)
        assert signal.getsignal(number) is signal.SIG_DFL
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interrupts():
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
