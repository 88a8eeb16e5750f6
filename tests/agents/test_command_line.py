"""Without the packages of an extra, what needs them says in one line what to install."""

import importlib
import sys
from collections.abc import Iterator
from typing import Any

import pytest

import surgsim_env

# Names that packages of the extras are imported by.
PACKAGES = {
    *("cma", "minari", "moviepy", "msgspec", "pettingzoo", "ray", "safetensors", "sklearn"),
    *("stable_baselines3", "torch", "tqdm", "viser", "websockets"),
}
# Of ours, what imports them; imported anew here.
NEEDING = (
    *("agents", "surgsim_apps.cli", "surgsim_env.envs", "surgsim_apps.live", "surgsim_apps.scoring"),
    "surgsim_apps.training",
)


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


@pytest.mark.parametrize(
    ("arguments", "missing"),
    [
        (["evaluate", "--policy", "retract_dagger"], "safetensors"),
        (["evaluate", "--agent", "expert_organs"], "torch"),
    ],
)
def test_a_command_names_the_missing_extra(without_extras, arguments: list[str], missing: str, capsys):
    main = importlib.import_module("surgsim_apps.cli.main").main
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"surgsim: error: surgsim {arguments[0]} needs {missing}: pip install 'surgsim[agents]'"


def test_public_names_that_need_an_extra_name_it(without_extras):
    for name, extra in (("VectorEnvForStableBaselines", "agents"), ("BimanualRetractParallelEnv", "pettingzoo")):
        with pytest.raises(ImportError, match=rf"surgsim_env\.{name} needs \w+: pip install 'surgsim\[{extra}\]'"):
            getattr(surgsim_env, name)
