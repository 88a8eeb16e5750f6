"""Results of commands appear at the end, and after an error none does."""

import errno

import pytest

from surgsim_apps.reports.output_folder import output_folder

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


def test_a_full_disk_is_an_error_with_the_folder(tmp_path):
    with pytest.raises(OSError, match=rf"--out {tmp_path}.*another folder"), output_folder(tmp_path, NAMES):
        raise OSError(errno.ENOSPC, "No space left on device")
