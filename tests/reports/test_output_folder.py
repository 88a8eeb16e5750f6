"""Results of commands appear together or not at all: errors, Ctrl-C, kills, two runs at once, a full disk."""

import errno
import importlib.util
import os
import signal
import subprocess
import sys
import threading
from contextlib import ExitStack
from types import SimpleNamespace

import pytest

from surgsim_env.cli.main import main
from surgsim_env.reports import output_folder as module
from surgsim_env.reports.output_folder import PART, OutputError, output_folder

NAMES = ["a.csv", "b.png", "images/c.png"]


def write(files, text, names=NAMES):
    for name in names:
        (files / name).write_text(text, encoding="utf-8")


def content(folder):
    """Every file of a folder, hidden ones too."""
    return {
        path.relative_to(folder).as_posix(): path.read_text(encoding="utf-8")
        for path in folder.rglob("*")
        if path.is_file()
    }


def full(path):
    """Every write to this path finds no space; as on a full disk, the error names no file."""
    path.symlink_to("/dev/full")
    return path


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


@pytest.mark.parametrize("error", [ValueError("wrong"), KeyboardInterrupt(), OSError(errno.ECONNRESET, "a socket")])
@pytest.mark.parametrize("there", [{}, dict.fromkeys(NAMES, "old")])
def test_an_error_leaves_what_was_there(tmp_path, there, error):
    out = tmp_path / "out"
    if there:
        with output_folder(out) as files:
            write(files, "old")
    with pytest.raises(type(error)) as raised, output_folder(out, NAMES) as files:
        write(files, "new")
        raise error
    assert raised.value is error
    assert (content(out) == there) if there else not out.exists()


@pytest.mark.parametrize(
    ("words", "fail"),
    [
        (r"images/c.png cannot be written \(No space left on device\)", lambda files: full(files / "images/c.png")),
        # Matplotlib's and Pillow's writers remove the file.
        (r"b.png cannot be written \(No space left on device\)", lambda files: raise_at(files / "b.png")),
        (r"b.png cannot be written \(encoder error", lambda files: raise_encoder(files / "b.png")),
    ],
)
def test_a_full_disk_names_the_file_and_leaves_what_was_there(tmp_path, words, fail):
    with output_folder(tmp_path) as files:
        write(files, "old")
    with pytest.raises(OutputError, match=words) as raised, output_folder(tmp_path, NAMES) as files:
        write(files, "new", NAMES[:1])
        fail(files)
        (files._part / "new" / "images/c.png").write_text("new", encoding="utf-8")
    assert PART not in str(raised.value) and "make room or choose another folder" in str(raised.value)
    assert content(tmp_path) == dict.fromkeys(NAMES, "old")


def raise_at(path):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def raise_encoder(path):
    raise OSError("encoder error -2 when writing image file")


def test_a_disk_that_tells_late_that_it_is_full_changes_nothing(tmp_path, monkeypatch):
    with output_folder(tmp_path) as files:
        write(files, "old")
    monkeypatch.setattr(module.os, "fsync", raise_at)
    with pytest.raises(OutputError, match=r"a.csv cannot be written \(No space"), output_folder(tmp_path) as files:
        write(files, "new")
    assert content(tmp_path) == dict.fromkeys(NAMES, "old")


def test_a_mesh_that_finds_no_space_is_named_as_it_would_be_called(tmp_path, random_mesh):
    """Its writer makes an error of its own of it."""
    from msdm_core.mesh_files.mesh_io import write_mesh

    with pytest.raises(OutputError, match=r"a.vtu cannot be written \(No space left") as raised:
        with output_folder(tmp_path) as files:
            write_mesh(full(files / "a.vtu"), random_mesh(1, 1))
    assert PART not in str(raised.value) and not list(tmp_path.iterdir())


@pytest.mark.parametrize("there", [[], ["a.csv", "b.png", "images/c.png", "d"], ["b.png"]])
@pytest.mark.parametrize("failing", [1, 2, 3, 4, 5, 6, 7])
def test_a_set_that_cannot_be_put_in_its_place_leaves_what_was_there(tmp_path, monkeypatch, there, failing):
    with output_folder(tmp_path) as files:
        write(files, "old", there)
    real, calls = os.rename, []

    def rename(source, target):
        calls.append(target)
        # The first only declares the set to be whole.
        if len(calls) == 1 + failing:
            raise PermissionError(13, "in use", str(target))
        real(source, target)

    monkeypatch.setattr(module.os, "rename", rename)
    try:
        with output_folder(tmp_path, [*NAMES, "d"]) as files:
            write(files, "new")
    except OSError:
        monkeypatch.undo()
        assert content(tmp_path) == dict.fromkeys(there, "old")
    else:
        assert len(calls) <= failing and content(tmp_path) == dict.fromkeys(NAMES, "new")


def test_ctrl_c_while_a_set_is_put_in_its_place_waits_until_it_is(tmp_path, monkeypatch):
    real = os.rename

    def rename(source, target):
        signal.raise_signal(signal.SIGINT)
        real(source, target)

    with output_folder(tmp_path) as files:
        write(files, "old")
    monkeypatch.setattr(module.os, "rename", rename)
    # A process that was started in the background ignores Ctrl-C.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), output_folder(tmp_path, NAMES) as files:
            write(files, "new")
    finally:
        signal.signal(signal.SIGINT, before)
    assert content(tmp_path) == dict.fromkeys(NAMES, "new")


def test_of_two_runs_the_last_to_end_is_there(tmp_path):
    out = tmp_path / "out"
    with ExitStack() as later:
        slow = later.enter_context(output_folder(out, [*NAMES, "slow", "quick"]))
        write(slow, "slow", NAMES[:1])
        with output_folder(out, [*NAMES, "slow", "quick"]) as quick:
            write(quick, "quick", [*NAMES, "quick"])
            write(slow, "slow", [*NAMES[1:], "slow"])
        assert content(out)["quick"] == content(out)["a.csv"] == "quick"
    assert content(out) == dict.fromkeys([*NAMES, "slow"], "slow")


def test_a_run_waits_while_another_puts_its_set_in_its_place(tmp_path, monkeypatch):
    names, real, calls = ["a.csv", "b.png"], os.rename, []
    first, second = ExitStack(), ExitStack()
    for run, text in ((first, "first"), (second, "second")):
        write(run.enter_context(output_folder(tmp_path, names)), text, names)
    ending = threading.Thread(target=second.close)

    def rename(source, target):
        calls.append(threading.current_thread())
        # The first declares the set whole, the second puts a.csv in its place; b.png is still to come.
        if len(calls) == 3:
            ending.start()
            # Long enough for the other to go by, were it not kept out.
            ending.join(0.3)
        real(source, target)

    monkeypatch.setattr(module.os, "rename", rename)
    first.close()
    ending.join(60.0)
    assert calls[:3] == 3 * [threading.current_thread()] and calls[3:] == 5 * [ending]
    assert content(tmp_path) == dict.fromkeys(names, "second")


KILLED = """
import importlib.util, os, signal, sys
from pathlib import Path
spec = importlib.util.spec_from_file_location("output_folder", sys.argv[1])
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
real, calls = os.rename, []
def rename(source, target):
    calls.append(target)
    if len(calls) == int(sys.argv[3]):
        os.kill(os.getpid(), signal.SIGKILL)
    real(source, target)
os.rename = rename
with module.output_folder(Path(sys.argv[2])) as files:
    for name in ("a.csv", "b.png"):
        (files / name).write_text("killed")
"""


@pytest.mark.parametrize(("renames", "left"), [(1, "old"), (4, "killed")])
def test_what_a_killed_run_leaves_is_removed_or_completed_by_the_next(tmp_path, renames, left):
    """Killed before its set was whole, or while it was put in its place: then the next run completes it first."""
    names = ["a.csv", "b.png"]
    with output_folder(tmp_path) as files:
        write(files, "old", names)
    place = importlib.util.find_spec("surgsim_env.reports.output_folder").origin
    run = subprocess.run([sys.executable, "-c", KILLED, place, str(tmp_path), str(renames)], timeout=60)
    assert run.returncode == -signal.SIGKILL
    assert len(list(tmp_path.glob(f"{PART}*"))) == 1
    with ExitStack() as running:
        running.enter_context(output_folder(tmp_path))
        assert len(list(tmp_path.glob(f"{PART}*"))) == 1
        assert {(tmp_path / name).read_text(encoding="utf-8") for name in names} == {left}
        # That of a run that goes on is left alone.
        with output_folder(tmp_path) as files:
            write(files, "new", names)
        assert len(list(tmp_path.glob(f"{PART}*"))) == 1
    assert content(tmp_path) == dict.fromkeys(names, "new")


def test_numbered_folders_and_files_are_taken_once(tmp_path):
    stem = tmp_path / "runs" / "palpate"
    with output_folder(stem, numbered=True) as one, output_folder(stem, numbered=True) as other:
        assert [one.path.name, other.path.name] == ["palpate-1", "palpate-2"]
        write(one, "one", ["a.csv"])
        write(other, "other", ["a.csv"])
    with pytest.raises(ValueError, match="wrong"), output_folder(stem, numbered=True):
        raise ValueError("wrong")
    assert sorted(path.name for path in stem.parent.iterdir()) == ["palpate-1", "palpate-2"]
    for number in (1, 2):
        with output_folder(tmp_path) as files:
            write(files, str(number), ["recording.csv"])
            assert files.number("recording.csv") == f"recording-{number}.csv"
    assert (tmp_path / "recording-2.csv").read_text() == "2"


def test_a_place_that_cannot_be_written_is_known_at_once(tmp_path):
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(OutputError, match=r"--out .*file: cannot be written \(File exists\); choose another"):
        output_folder(tmp_path / "file").__enter__()
    with pytest.raises(OutputError, match=r"cannot be written \(Not a directory\)"):
        output_folder(tmp_path / "file" / "below").__enter__()
    (tmp_path / "a.csv").mkdir()
    with pytest.raises(OutputError, match=r"a\.csv is a folder there"):
        output_folder(tmp_path, NAMES).__enter__()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "file"]


# ---- commands ------------------------------------------------------------------------------------------------------


def stop(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def some(*_, **__):
    return SimpleNamespace(name="organ")


def palpate(patch):
    for name in ("load_anatomy", "load_stable_anatomy", "run_palpation"):
        patch(f"surgsim_env.cli.palpate.{name}", lambda *_, **__: SimpleNamespace(demonstration_lesions=list))
    patch("surgsim_env.cli.palpate.write_csv", lambda _, path: path.write_text("new"))
    patch("surgsim_env.cli.palpate.write_summary", lambda _, path, __: path.write_text("new"))
    patch("surgsim_env.cli.palpate.write_stiffness_map", stop)
    return ["palpate", "--scene", "phantom_small"], ["palpation.csv", "summary.json", "stiffness_map.png"]


def retract(patch):
    patch("surgsim_env.cli.retract.gym.make", lambda *_, **__: SimpleNamespace(reset=some, close=some))
    patch("surgsim_env.cli.retract._pictures", lambda *_: None)
    patch("surgsim_env.cli.retract.oracle_script", some)
    patch("surgsim_env.cli.retract.run_script", lambda *_: SimpleNamespace(to_csv=to_csv, plot=stop))
    return ["retract"], ["trace.csv", "forces.png", "summary.json", "retraction.png"]


def to_csv(path):
    path.write_text("new", encoding="utf-8")
    return [path]


def arms(patch):
    def run_study(setups, anatomy, plan, folder, console):
        (folder / "summary.json").write_text("new", encoding="utf-8")
        stop(folder / "points.csv")

    for name in ("make_scene", "load_anatomy", "_setup"):
        patch(f"surgsim_env.cli.arms.{name}", some)
    patch("surgsim_env.cli.arms.run_study", run_study)
    return ["arms", "--left", "psm_grasper", "--right", "psm_grasper"], ["summary.json", "points.csv"]


def validate(patch):
    curve = SimpleNamespace(figure="x")
    validation = SimpleNamespace(quick=True, rows=(), curves=[curve], drawings=(), outdated=(), passed=True)
    patch("surgsim_env.validation.suite.run_cases", lambda **_: validation)
    patch("surgsim_env.validation.report.write_plot", stop)
    return ["validate", "--quick"], ["validation.md", "images/validation_x.png"]


def bench(patch):
    patch("surgsim_env.cli.bench.measured_parts", lambda: [lambda _: SimpleNamespace(lines=list)])
    patch("surgsim_env.bench.report.write_report", lambda _, __, folder, quick: stop(folder / "benchmarks.md"))
    return ["bench", "--quick"], ["benchmarks.md"]


def haptics(patch):
    class Broken:
        def __init__(self, *_):
            self.steps = 0

        def wait(self):
            self.steps += 1
            if self.steps > 5:
                stop()

        def done(self, _):
            pass

    patch("surgsim_env.cli.haptics.Pacer", Broken)
    return ["haptics", "--scene", "phantom_small", "--port", "0"], ["telemetry.csv"]


@pytest.mark.parametrize("command", [palpate, retract, arms, validate, bench, haptics])
@pytest.mark.parametrize("older", [True, False])
def test_a_command_that_finds_no_space_leaves_older_results_alone(command, older, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    arguments, names = command(monkeypatch.setattr)
    if older:
        with output_folder(out) as files:
            write(files, "old", names)
    assert main([*arguments, "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "cannot be written (No space left on device)" in said
    assert any(name in said for name in names) and PART not in said
    assert (content(out) == dict.fromkeys(names, "old")) if older else not out.exists()
