"""Without the packages of an extra, every script that needs them says in one line what to install."""

import importlib
import re
import runpy
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from agents.command_line import one_line_errors

import surgsim_env

ROOT = Path(__file__).resolve().parents[2]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
# Names that packages of the extras are imported by.
PACKAGES = {
    *("cma", "minari", "moviepy", "msgspec", "ray", "safetensors", "sklearn"),
    *("stable_baselines3", "torch", "tqdm", "viser", "websockets"),
}
# Of ours, what imports them; imported anew here.
NEEDING = (
    *("agents", "surgsim_env.cli", "surgsim_env.envs", "surgsim_env.live", "surgsim_env.scoring"),
    "surgsim_env.training",
)
SCRIPTS = {
    path.relative_to(ROOT).as_posix(): match[1]
    for folder in ("agents", "benchmarks", "docs")
    for path in sorted((ROOT / folder).glob("*.py"))
    if '__name__ == "__main__"' in (text := path.read_text(encoding="utf-8"))
    and (match := re.search(r"^with one_line_errors\(__name__, (.*)\):", text, re.MULTILINE))
}


class Absent:
    """A finder of modules that refuses the packages of the extras."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        if name.partition(".")[0] in PACKAGES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


@pytest.fixture
def without_extras(monkeypatch) -> Iterator[None]:
    """As if no extra were installed."""
    before = dict(sys.modules)
    ours = {name: module for name, module in before.items() if name.startswith(NEEDING)}
    for name in [*ours, *(name for name in before if name.partition(".")[0] in PACKAGES)]:
        del sys.modules[name]
    monkeypatch.setattr(sys, "meta_path", [Absent(), *sys.meta_path])
    yield
    # Other packages that were imported meanwhile stay: half of matplotlib twice is no matplotlib.
    for name in set(sys.modules) - set(before):
        if name.startswith(NEEDING):
            del sys.modules[name]
    sys.modules.update(before)
    for name, module in ours.items():
        parent, _, leaf = name.rpartition(".")
        if parent in before:
            setattr(before[parent], leaf, module)


def test_the_scripts_that_need_extras_declare_them():
    names = {Path(name).stem for name in SCRIPTS}
    assert names >= {"behaviour_cloning", "learn_from_scratch", "record_demonstrations"}
    for extras in SCRIPTS.values():
        assert all(extra.strip('"') in EXTRAS for extra in extras.split(", "))


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_missing_extra_is_named_in_one_line(without_extras, name: str, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / name), run_name="__main__")
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    install = f"pip install 'surgsim[{SCRIPTS[name].replace(', ', ',').replace(chr(34), '')}]'"
    assert re.fullmatch(rf"{Path(name).stem}: error: \w+ is not installed: {re.escape(install)}", line)


@pytest.mark.parametrize("name", ["record_faces", "raster"])
def test_the_other_agents_need_no_extra(without_extras, name: str, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / "agents" / f"{name}.py"), run_name="__main__")
    assert not ended.value.code and "usage" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "missing"),
    [
        (["evaluate", "--policy", "retract_dagger"], "safetensors"),
        (["evaluate", "--agent", "expert_organs"], "torch"),
    ],
)
def test_a_command_names_the_missing_extra(without_extras, arguments: list[str], missing: str, capsys):
    main = importlib.import_module("surgsim_env.cli.main").main
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"surgsim: error: surgsim {arguments[0]} needs {missing}: pip install 'surgsim[agents]'"


def test_public_names_that_need_an_extra_name_it(without_extras):
    name = "VectorEnvForStableBaselines"
    with pytest.raises(ImportError, match=rf"surgsim_env\.{name} needs \w+: pip install 'surgsim\[agents\]'"):
        getattr(surgsim_env, name)


def test_wrong_input_ends_a_script_in_one_line_and_is_raised_in_a_module(capsys):
    with pytest.raises(SystemExit) as ended, one_line_errors("__main__", "agents"):
        raise ValueError("two\nlines")
    assert ended.value.code == 2 and capsys.readouterr().err.endswith(": error: two lines\n")
    with pytest.raises(ValueError, match="two"), one_line_errors("agents.learn_sites", "agents"):
        raise ValueError("two\nlines")
    # A module of our own that is missing is our mistake.
    with pytest.raises(ModuleNotFoundError), one_line_errors("__main__", "agents"):
        import agents.nowhere  # type: ignore[import-not-found]  # noqa: F401
