"""The fuzz script: its findings, that a seed gives the same input again, and that its worker may end."""

import json

import numpy as np
import pytest

from benchmarks import fuzz
from surgsim_env.scene.load import read_toml


def raises(error):
    def read(_path):
        raise error

    return read


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
}


@pytest.mark.parametrize("name", READERS)
def test_what_is_a_finding(name):
    read, status, message = READERS[name]
    outcome = fuzz.attempt(fuzz.Kind("k", lambda _: iter(()), read), {"a.toml": b"x = 1\n"})
    assert outcome.status == status and message in outcome.message


@pytest.mark.parametrize("name", ["arms", "csv", "meshes"])
def test_a_seed_gives_its_input_again(name):
    kind = fuzz.KINDS[name]
    inputs = [[fuzz.mutated_input(kind, fuzz.valid_inputs(kind), seed) for seed in range(20)] for _ in range(2)]
    assert inputs[0] == inputs[1]
    assert sum(files not in fuzz.valid_inputs(kind) for files, _ in inputs[0]) >= 18


def test_a_worker_that_ended_is_a_finding():
    worker = fuzz.Worker(["csv"])
    try:
        worker.process.kill()
        worker.process.join()
        assert worker.read("csv", 2).status == "finding"
        assert worker.read("csv", 4).status in ("valid", "refused")
    finally:
        worker.close()


def test_a_run_leaves_no_files_of_a_worker_that_was_too_slow(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(fuzz, "SECONDS_MOST", 0.05)
    monkeypatch.setattr("sys.argv", ["fuzz", "--only", "scenes", "--inputs", "1"])
    fuzz.main()
    assert not list(tmp_path.iterdir())
