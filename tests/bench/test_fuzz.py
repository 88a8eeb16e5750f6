"""The fuzz script: what it calls a finding, that a seed gives the same input again, and that workers may end."""

import json
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from benchmarks import fuzz
from surgsim_env.scene.load import read_toml

CASE = fuzz.Case({"a.toml": b"x = 1\n"})


def raises(error):
    def read(_path):
        raise error

    return read


def warns(_path):
    warnings.warn("of numpy", RuntimeWarning, stacklevel=1)


READERS = {
    "valid": (lambda path: None, "valid", ""),
    "refused by the project": (
        lambda path: read_toml(path.with_name("none.toml"), "scene"),
        "refused",
        "cannot be read",
    ),
    "file of the system": (lambda path: path.with_name("none").read_text(), "refused", "No such file"),
    "error of a library": (lambda path: json.loads(path.read_text()), "finding", "JSONDecodeError"),
    "ValueError of a library": (lambda path: np.zeros(3).reshape(2, 2), "finding", "ValueError of a library"),
    "another exception": (lambda path: {}["x"], "finding", "KeyError"),
    "several lines": (raises(OSError(2, "a\nb", "file")), "finding", "message of 2 lines"),
    "warning": (warns, "finding", "output 'RuntimeWarning: of numpy"),
    "printed": (lambda path: print("hello"), "finding", "output 'hello'"),
}


@pytest.mark.parametrize("name", READERS)
def test_what_is_a_finding(name, tmp_path, capsys):
    read, status, said = READERS[name]
    got = fuzz.attempt(fuzz.Kind("k", lambda _: iter(()), read), CASE, tmp_path, lambda: "".join(capsys.readouterr()))
    assert got[0] == status
    assert said in got[1]


@pytest.mark.parametrize("name", ["arms", "csv", "meshes"])
def test_a_seed_gives_its_input_again(name, tmp_path):
    kind = fuzz.KINDS[name]
    inputs = []
    for turn in ("first", "second"):
        (tmp_path / turn).mkdir()
        cases = list(kind.cases(tmp_path / turn))
        inputs.append([fuzz.made_input(kind, cases, seed) for seed in range(20)])
    assert inputs[0] == inputs[1]
    originals = [case.files for case in cases]
    assert sum(case.files not in originals for case, _ in inputs[0]) >= 18
    assert all(mutation for _, mutation in inputs[0])


@pytest.mark.skipif(sys.platform != "linux", reason="the memory of a process is read from /proc")
def test_a_worker_that_ends_or_takes_too_much_is_a_finding(monkeypatch):
    worker = fuzz.Worker(["csv"])
    try:
        assert worker.read("csv", 1).status in ("valid", "refused")
        worker.process.kill()
        worker.process.join()
        # The pipe of an ended process may still take what is sent.
        ended = worker.read("csv", 2)
        assert (ended.status, ended.said) == ("finding", "the process ended with -9")
        with monkeypatch.context() as patched:
            patched.setattr(fuzz, "MEMORY_MOST", 1e6)
            taken = worker.read("csv", 3)
        assert taken.status == "finding" and taken.said.startswith("memory: ")
        assert worker.read("csv", 4).status in ("valid", "refused")
    finally:
        worker.close()


def test_replay_says_what_was_changed(capsys):
    assert fuzz.replay("csv:5") == 0
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first.startswith("csv:5: ")
    assert second.startswith(("valid", "refused"))
    with pytest.raises(SystemExit, match=r"--replay is 'nothing:1'; the form is KIND:SEED"):
        fuzz.replay("nothing:1")


def test_files_of_the_repository_are_ours():
    assert fuzz.is_ours(str(Path(fuzz.__file__)))
    assert not fuzz.is_ours(np.__file__)
