"""Files and modules that the pages name exist, and what is generated is complete."""

import importlib
import importlib.util
import re
from pathlib import Path

import gymnasium as gym
import pytest

import msdm_core
import surgsim_env.scripting
from surgsim_apps.cli.main import EXAMPLES
from surgsim_env.envs.ids import TASKS
from surgsim_env.tasks.declaration import docstring_sections, reward_weights

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
HOOKS = ROOT / "docs" / "hooks"


def hook(name: str):
    """A hook as mkdocs loads it."""
    specification = importlib.util.spec_from_file_location(name, HOOKS / f"{name}.py")
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT / "docs").as_posix())
def test_files_and_modules_that_are_named_exist(page):
    text = page.read_text(encoding="utf-8")
    folders = "scenes|msdm_core|surgsim_env|surgsim_apps|agents|docs|tests|benchmarks"
    for place in re.findall(rf"`((?:{folders})/[\w/.]*)`", text):
        assert (ROOT / place).exists(), place
    packages = "msdm_core|surgsim_env|surgsim_apps"
    for name in re.findall(rf"`((?:{packages})(?:\.\w+)+)(?:\([^`]*)?`|^::: (\S+)", text, flags=re.MULTILINE):
        assert resolved(name[0] or name[1]) is not None, name


def resolved(name: str) -> object:
    """A module, or what a module has by a dotted name; None if there is none."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            value: object = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError as error:
            if error.name is not None and not name.startswith(error.name.partition(".")[0]):
                # It is there, and asks for an extra that is not.
                return error.name
            continue
        for attribute in parts[count:]:
            try:
                there = hasattr(value, attribute)
            except ImportError as error:
                # A name that is imported when it is used, from an extra that is not installed.
                return error.name
            # A dataclass's field without a default is no attribute of the class.
            if not there and attribute not in getattr(value, "__annotations__", {}):
                return None
            value = getattr(value, attribute, name)
        return value
    return None


@pytest.mark.parametrize(
    ("page", "names"),
    [
        ("msdm_core", msdm_core.__all__),
        ("surgsim_env", surgsim_env.__all__),
        ("scripting", surgsim_env.scripting.__all__),
    ],
)
def test_the_reference_has_every_public_name(page, names):
    text = (ROOT / "docs" / "reference" / f"{page}.md").read_text(encoding="utf-8")
    documented = set(re.findall(r"^::: [\w.]+\.(\w+)$", text, flags=re.MULTILINE))
    # The text names the others: constants, modules, and types that stand with what takes them.
    elsewhere = {"scripting", "register", "MeshError", "OrganError", "OrganDivergedError"}
    for name in set(names) - documented - {"Script", "Step", "StepFailed"} - elsewhere:
        assert re.search(rf"`(surgsim_env\.)?{name}`", text), name


@pytest.mark.agents
def test_every_public_name_can_be_imported():
    pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")
    for package in (msdm_core, surgsim_env, surgsim_env.scripting):
        assert sorted(package.__all__, key=str.lower) == sorted(set(package.__all__), key=str.lower)
        assert all(getattr(package, name) is not None for name in package.__all__)
    for package in (msdm_core, surgsim_env):
        assert (Path(package.__path__[0]) / "py.typed").is_file()
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        getattr(surgsim_env, "nothing")  # noqa: B009


IDS = sorted(id for id in gym.registry if id.startswith("SurgSim/"))


@pytest.mark.parametrize("id", IDS)
def test_tables_have_every_command_channel_and_reward(id):
    task, text = TASKS[id], hook("generated_parts").environment_text(id)
    _, sections = docstring_sections(text)
    for heading, parts in (
        ("Action Space", task.commands), ("Observation Space", task.channels), ("Rewards", task.rewards)
    ):  # fmt: skip
        rows = re.findall(r"^\| `(\w+)` \| (\S[^|]*) \|", sections[heading], flags=re.MULTILINE)
        # Channels of options are in a table of their own.
        assert sorted(name for name, _ in rows) == sorted(part.name for part in parts)
    assert {name: float(weight) for name, weight in rows} == reward_weights(task)


def test_channels_of_options_are_folded():
    id = "SurgSim/Palpate-v0"
    _, sections = docstring_sections(hook("generated_parts").environment_text(id))
    shown, _, folded = sections["Observation Space"].partition("<details")
    env = gym.make(id)
    assert re.findall(r"^\| `(\w+)`", shown, flags=re.MULTILINE) == list(env.unwrapped.observation_slices)
    assert "`felt_share`" in folded and 'memory="summary"' not in shown
    env.close()


def test_every_command_and_every_option_is_on_the_page():
    module = hook("generated_parts")
    text = module.command_list()
    assert {"palpate", "organ", "arms", "validate"} <= set(EXAMPLES)
    for name in EXAMPLES:
        _, _, section = text.partition(f"## surgsim {name}\n")
        section = section.partition("\n## ")[0]
        options = set(re.findall(r"^\W*(--[a-z][\w-]*)", module.said(name, "--help"), flags=re.MULTILINE)) - {"--help"}
        rows = dict(re.findall(r"^\| <code>(?:-\w, )?(--[\w-]+)[^|]*\| (.*) \|$", section, flags=re.MULTILINE))
        assert options == set(rows), name
        assert [option for option, meaning in rows.items() if len(meaning) < 5 or meaning.endswith(",")] == [], name
