"""The tutorials run: their files are written, their Python and their commands run in order, what they print is so.

A block ```LANGUAGE title="NAME" is a file; ```python without a title runs in one namespace for the page; ```sh are
commands; ```text title="prints" is what the last Python printed, its numbers within some per cent; with "prints, when
trained" the words alone, for here it is trained less; with "prints, among others" each line is a part of what the last
block of Python or of commands printed, in this order, whatever the width of tables.
"""

import importlib
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from surgsim_apps.cli.main import main
from surgsim_env.rendering import gl

TUTORIALS = Path(__file__).resolve().parents[2] / "docs" / "tutorials"
NAMES = sorted(path.stem for path in TUTORIALS.glob("*.md") if path.stem != "index")
# The same in less time: what is written, and what runs here.
QUICK = {
    "own_organ": [("--out runs/kidney", "--out runs/kidney --around 0.02,0.01,0.021,0.012")],
    "train_an_agent": [
        ("model.learn(50_000)", "model.learn(1_024)"),
        ("make_envs(16, shaping", "make_envs(8, shaping"),
        ("scored = make_envs(16)", "scored = make_envs(8)"),
        ("n_eval_episodes=96", "n_eval_episodes=8"),
    ],
    # The evaluation looks for ports before all else; the slow test runs it.
    "own_robot": [("surgsim arms --left psm_grasper", "pip # --left psm_grasper")],
}
# An organ of one's own from a mesh to an agent, a scan from its labels to maps, and six episodes of a controller.
SLOW = {"own_organ", "own_patient", "test_a_controller"}
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
# Frames of tables.
FRAME = re.compile("[\u2500-\u257f|]")
# Numbers repeat to the bit on one machine; libraries of other versions may mesh or round otherwise.
RELATIVE, ABSOLUTE = 0.05, 0.015


class Block(NamedTuple):
    language: str
    title: str
    text: str


def blocks(page: str) -> list[Block]:
    matches = re.findall(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```$', page, flags=re.MULTILINE | re.DOTALL)
    return [Block(*match) for match in matches]


def page(name: str, *, quick: bool = True) -> str:
    text = (TUTORIALS / f"{name}.md").read_text(encoding="utf-8")
    for written, shorter in QUICK.get(name, []) if quick else ():
        assert text.count(written) == 1, written
        text = text.replace(written, shorter)
    return text


def agrees(printed: str, expected: str, *, words_alone: bool = False) -> bool:
    """True if all words are the same and all numbers nearly so."""
    printed, expected = (" ".join(text.split()) for text in (printed, expected))
    if words_alone or NUMBER.sub("#", printed) != NUMBER.sub("#", expected):
        return NUMBER.sub("#", printed) == NUMBER.sub("#", expected) and words_alone
    pairs = zip(map(float, NUMBER.findall(printed)), map(float, NUMBER.findall(expected)))
    return all(abs(a - b) <= max(ABSOLUTE, RELATIVE * abs(b)) for a, b in pairs)


def holds(printed: str, expected: str) -> bool:
    """True if each expected line is part of what is printed, in order, all words the same and all numbers nearly so.

    A table wraps its cells where the console ends, so that neither its frame nor the breaks of lines count.
    """
    rest = " ".join(FRAME.sub(" ", printed).split())
    for line in FRAME.sub(" ", expected).splitlines():
        words = [re.escape(part) for part in NUMBER.split(" ".join(line.split()))]
        parts = re.finditer(NUMBER.pattern.join(words), rest)
        match = next((part for part in parts if agrees(part[0], line)), None)
        if match is None:
            return False
        rest = rest[match.end() :]
    return True


def run_command(line: str) -> None:
    """One line of a shell: our own commands in this process, Python's in another one, pip's not at all."""
    program, *arguments = shlex.split(line, comments=True)
    if program == "surgsim":
        assert main(arguments) == 0, line
    elif program == "python":
        done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stdout + done.stderr
    else:
        assert program == "pip", line


def run_tutorial(text: str, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, object] = {}
    for block in blocks(text):
        if block.title.startswith("prints"):
            printed, words_alone = capsys.readouterr().out, "trained" in block.title
            message = f"{name} prints\n{printed}\nand says\n{block.text}"
            if "among others" in block.title:
                assert holds(printed, block.text), message
            else:
                assert agrees(printed, block.text, words_alone=words_alone), message
        elif block.title:
            Path(block.title).write_text(block.text, encoding="utf-8")
        elif block.language == "sh":
            capsys.readouterr()
            for line in block.text.splitlines():
                run_command(line)
        elif block.language == "python" and not ("picture = " in block.text and not draws()):
            capsys.readouterr()
            exec(compile(block.text, f"docs/tutorials/{name}.md", "exec"), names)


def draws() -> bool:
    try:
        gl.context()
    except gl.NoGLError:
        return False
    return True


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder to run in, from which modules are imported; what it brought is forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.invalidate_caches()
    before = set(sys.modules)
    yield tmp_path
    for module in set(sys.modules) - before:
        if str(getattr(sys.modules[module], "__file__", "") or "").startswith(str(tmp_path)):
            del sys.modules[module]


NEEDS_AGENTS = {"train_an_agent"}
# In these the blocks that train are left out where stable-baselines3 is missing; the rest runs.
TRAINS_LAST = {"own_task"}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.agents] * (name in NEEDS_AGENTS) + [pytest.mark.slow] * (name in SLOW))
        for name in NAMES
    ],
)
def test_it_runs(name, folder, capsys):
    if name in NEEDS_AGENTS:
        pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")
    text = page(name)
    if name in TRAINS_LAST:
        text, training = text.split("\n## Training\n")
        assert "stable_baselines3" in training and "stable_baselines3" not in text
    run_tutorial(text, name, capsys)


@pytest.mark.agents
@pytest.mark.parametrize("name", sorted(TRAINS_LAST))
def test_it_trains(name, folder, capsys):
    pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")
    run_tutorial(page(name), name, capsys)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.agents) if name in NEEDS_AGENTS else name for name in QUICK]
)
def test_it_runs_as_written(name, folder, capsys):
    """Nothing shortened; a training ends where the page says, roughly."""
    if name in NEEDS_AGENTS:
        pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")
    run_tutorial(page(name, quick=False), name, capsys)


def test_getting_started_runs(folder, capsys):
    text = (TUTORIALS.parent / "getting_started.md").read_text(encoding="utf-8")
    run_tutorial(re.sub(r"^```sh\n.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL), "getting_started", capsys)
    printed = capsys.readouterr().out
    assert re.search(r"True largest force 0\.19 N", printed), printed
