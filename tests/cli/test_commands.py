"""The commands as a whole: their list, their help texts, unknown names, and any kind of standard output."""

import os
import re
import shlex
import subprocess
import sys

import pytest
import tyro

from surgsim_apps.cli.main import EXAMPLES, TYRO, main

SURGSIM = (sys.executable, "-m", "surgsim_apps.cli.main")
# In no help text: tyro's optional types, an empty or missing default, a negated negation, a module's docstring.
FAULTS = r"\{None\}|\bNone\b|\bSTR\b|\(default: *\)|--no-no-|Commands of `surgsim`|\s_[a-z]+"


@pytest.mark.parametrize("width", ["80", "120"])
@pytest.mark.parametrize("name", EXAMPLES)
def test_no_help_text_shows_how_it_is_made(name, width, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", width)
    assert main([name, "--help"]) == 0
    text = capsys.readouterr().out
    assert re.findall(FAULTS, text) == []
    assert f"usage: surgsim {name} " in text and EXAMPLES[name][1] in text


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_example_of_a_command_is_valid(name):
    kind, example = EXAMPLES[name]
    program, command, *options = shlex.split(example)
    assert (program, command) == ("surgsim", name)
    assert isinstance(tyro.cli(kind, args=options, config=TYRO), kind)


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"], ["help"]])
def test_without_a_command_all_are_listed(arguments, capsys):
    assert main(arguments) == 0
    text = capsys.readouterr().out
    for name, (_, example) in EXAMPLES.items():
        assert f"\n{name} " in text and example in text


def test_help_before_a_command_is_the_help_of_that_command(capsys):
    assert main(["help", "maps"]) == main(["--help", "maps"]) == main(["maps", "--help"]) == 0
    first, second, third = (
        "usage: surgsim maps" + part for part in capsys.readouterr().out.split("usage: surgsim maps")[1:]
    )
    assert first == second == third


def test_an_option_before_the_command_is_refused_as_such(capsys):
    assert main(["--scene", "liver", "palpate"]) == 2
    text = capsys.readouterr().err
    assert "--scene" in text and "first" in text and "did you mean" not in text


def test_version(capsys):
    assert main(["--version"]) == 0
    assert re.fullmatch(r"surgsim \d+\.\d+\.\S+\n", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("arguments", "nearest"),
    [
        *((["palpte"], "'palpate'"), (["orgn", "a.stl"], "'organ'"), (["PALPATE"], "'palpate'")),
        (["palpate", "--pres-depth", "3mm"], "--press-depth"),
        *((["palpate", "--scene", "LIVER.TOML"], "'liver'"), (["haptics", "--motion", "CALM"], "'calm'")),
    ],
)
def test_an_unknown_name_has_the_nearest_known(arguments, nearest, capsys):
    assert main(arguments) == 2
    text = capsys.readouterr().err
    assert nearest in text and "organ --help" not in text


def run(command, **settings):
    """Exit status, output and errors of a shell's command line; {} stands for surgsim."""
    environment = {**os.environ, "PYTHONIOENCODING": settings.get("encoding", "utf-8")}
    line = command.replace("{}", shlex.join(SURGSIM))
    return subprocess.run(["bash", "-c", line], env=environment, capture_output=True, text=True)


@pytest.mark.parametrize(
    "command",
    [
        *("{} materials", "{} scenes", "{}", "{} palpate --help", "{} materials >&-", "{} palpate --help >&-"),
        "set -o pipefail; {} materials | head -1",
        "set -o pipefail; {} evaluate --help | true",
    ],
)
def test_a_command_prints_on_any_output(command):
    ended = run(command, encoding="ascii")
    assert (ended.returncode, ended.stderr) == (0, "")


def test_a_full_output_is_an_error_in_one_line():
    ended = run("{} materials > /dev/full")
    assert ended.returncode == 2 and ended.stderr.count("\n") == 1


def test_a_command_without_a_reader_goes_on_and_writes_its_files(tmp_path):
    line = "{} palpate --scene phantom_small --around 0.02,0.02,0.02,6mm --out " + str(tmp_path / "out")
    ended = run(f"set -o pipefail; {line} | true")
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["haptics", "--seconds", "5s"], ["--seconds", "'5s'"]),
        (["evaluate", "--agent", "random", "--budget", "1.5"], ["--budget", "'1.5'"]),
        (["evaluate", "--agent", "os:getcwd", "--env-arguments", "{"], ["--env-arguments", "'{'"]),
        (["evaluate", "--compare", "nope.json", "nope.json"], ["nope.json: No such file"]),
        (["palpate", "--lesion", "1mm,2mm,3mm,4mm,5mm"], ["--lesion", "ratios without a unit"]),
    ],
)
def test_a_wrong_value_is_named_without_names_of_types(arguments, named, capsys):
    assert main(arguments) == 2
    text = capsys.readouterr().err
    assert all(part in text for part in named)
    assert not re.findall(r"FLOAT|\bINT\b|instantiated|played|Error:", text)


def test_a_file_that_is_too_large_is_no_number_of_the_options(monkeypatch, capsys):
    def full():
        raise MemoryError("Unable to allocate 12.0 GiB")

    monkeypatch.setattr("surgsim_apps.cli.scenes.list_scenes", full)
    assert main(["scenes"]) == 2
    assert "a file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("ending", "status", "said"),
    [
        ("raise ValueError('bad')", 2, "bad"),
        ("import gymnasium; gymnasium.make('SurgSim/Nope-v0')", 2, "Nope"),
        ("signal.raise_signal(15)", 130, "stopped"),
    ],
)
def test_a_script_of_agents_ends_as_a_command(ending, status, said, tmp_path):
    script = f"""
import signal, sys
from pathlib import Path
from surgsim_apps.cli.main import exit_status
from surgsim_apps.reports.output_folder import lone_run
def main():
    with lone_run(Path("result")):
        {ending}
sys.exit(exit_status(main))
"""
    ended = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == status and said in ended.stderr and ended.stderr.count("\n") == 1
