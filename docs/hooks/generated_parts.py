"""Parts of pages that are made from the code.

`<!-- environment ID -->` becomes the docstring of that environment (Gymnasium's headings), whose tables of commands,
channels and rewards come from the task's declaration; its spaces are added, and channels of options folded.
`<!-- commands -->` becomes the help texts
of `surgsim` and each of its commands, `<!-- fields OrganModel -->` the table of that structure's fields,
`<!-- validation rows -->` the lines of validation.csv, folded by group. What stands
from there to `<!-- made from the code -->` is for those who read the file itself, and is replaced.
"""

import contextlib
import csv
import html
import io
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest import mock

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

ENVIRONMENT = re.compile(r"<!-- environment (\S+) -->\n.*?<!-- made from the code -->", re.DOTALL)
COMMANDS = re.compile(r"<!-- commands -->\n.*?<!-- made from the code -->", re.DOTALL)
FIELDS = re.compile(r"<!-- fields (\w+) -->\n.*?<!-- made from the code -->", re.DOTALL)
# Paragraphs on observations of an option.
OPTION = re.compile(r"With `(?!observe_force)|An instrument with")
# Wide enough for each option to be on one line.
COLUMNS = {"COLUMNS": "4000"}


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Fill the marks in."""
    markdown = ENVIRONMENT.sub(lambda mark: environment_text(mark[1]), markdown)
    markdown = FIELDS.sub(lambda mark: field_table(mark[1]), markdown)
    markdown = markdown.replace("<!-- validation rows -->", validation_rows())
    return COMMANDS.sub(lambda mark: command_list(), markdown)


def validation_rows() -> str:
    """The lines of validation.csv, a folded table for each group."""
    from surgsim_apps.validation.page import grouped, tally

    with (Path(__file__).parents[1] / "validation.csv").open(encoding="utf-8", newline="") as file:
        lines = list(csv.DictReader(file))
    parts: list[str] = []
    for name, own in grouped(lines).items():
        parts += ["<details markdown>", f"<summary>{name}: {tally(own)}</summary>\n"]
        parts += [f"| {' | '.join(own[0])} |", "|---|---|---:|---:|---:|---:|---|---|"]
        parts += [f"| {' | '.join(text.replace('|', '&#124;') for text in line.values())} |" for line in own]
        parts.append("\n</details>\n")
    return "\n".join(parts)


def environment_text(id: str) -> str:
    """The documentation of an environment as Markdown.

    Raises:
        PluginError: a docstring without one of the headings, or with others; names them.
    """
    import gymnasium as gym

    from surgsim_env.tasks.declaration import HEADINGS, docstring_sections

    summary, sections = docstring_sections(environment_class(id).__doc__ or "")
    if tuple(sections) != HEADINGS:
        raise PluginError(
            f"{id}: the docstring has the headings {', '.join(sections)}; it must have {', '.join(HEADINGS)}"
        )
    env: Any = gym.make(id)
    sections["Observation Space"] = options_folded(sections["Observation Space"], env.unwrapped.observation_slices)
    make = f'```python\nimport gymnasium as gym\nimport surgsim_env\n\nenv = gym.make("{id}")\n```'
    parts = [make, summary_table(env), *(f"## {title}\n\n{_lists_apart(text)}" for title, text in sections.items())]
    return "\n\n".join([summary, *parts])


def environment_class(id: str) -> type:
    """The class that an id makes."""
    import gymnasium as gym
    from gymnasium.envs.registration import load_env_creator

    import surgsim_env  # noqa: F401  (registers the ids)

    entry = gym.spec(id).entry_point
    assert isinstance(entry, str)
    creator = load_env_creator(entry)
    assert isinstance(creator, type)
    return creator


def options_folded(text: str, channels: Mapping[str, slice]) -> str:
    """The observations of an environment by default; paragraphs and rows of options folded at the end."""
    blocks = text.split("\n\n")
    options = [block for block in blocks[1:] if OPTION.match(block)]
    rows = [row for row in text.split("\n") if (match := re.match(r"\| `(\w+)`", row)) and match[1] not in channels]
    if not rows:
        return text
    head = [row for row in text.split("\n") if row.startswith("| ")][:2]
    kept = "\n\n".join(block for block in blocks if block not in options)
    kept = "\n".join(row for row in kept.split("\n") if row not in rows)
    folded = "\n\n".join([*options, "\n".join([*head, *rows])])
    return f"{kept}\n\n<details markdown>\n<summary>Channels of options</summary>\n\n{folded}\n\n</details>"


def summary_table(env: Any) -> str:
    """A table from Gymnasium's registry and the environment."""
    inner: Any = env.unwrapped
    observed = env.observation_space
    steps = inner.task.episode_steps
    limit = f"{steps} control steps" if steps else f"{inner.task.budget} presses"
    channels = ", ".join(
        f"`{name}` {part.start}" + (f"\N{NON-BREAKING HYPHEN}{part.stop - 1}" if part.stop > part.start + 1 else "")
        for name, part in inner.observation_slices.items()
    )
    rows = {
        "action space": f"`{env.action_space}`",
        "observation space": f"`Box({observed.shape}, {observed.dtype})`, finite",
        "entries of its channels": channels,
        "longest episode": limit,
        "by default": f"scene `{inner.scene.name}`, instrument `{inner.scene.instrument.model}`",
    }
    env.close()
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items())])


def _lists_apart(text: str) -> str:
    """Markdown wants an empty line before a list or a table that follows a paragraph; 6-8 stays on one line."""
    apart = re.sub(r"^(?![*|\s])(.+)\n(?=[*|])", r"\1\n\n", text, flags=re.MULTILINE)
    return re.sub(r"^\| (\(?\d+)-(\d+\)?) \|", "| \\1\N{NON-BREAKING HYPHEN}\\2 |", apart, flags=re.MULTILINE)


def field_table(structure: str) -> str:
    """The fields of `OrganModel` or `OrganState`, and the layouts that they have in organs side by side."""
    from msdm_core.kernels import structure_kernels as structures

    table = {"OrganModel": structures.MODEL_FIELDS, "OrganState": structures.STATE_FIELDS}[structure]
    rows = ["| field | unit | shape | type | side by side | |", "|---|---|---|---|---|---|"]
    for field in table:
        shape = ", ".join(map(str, field.shape)) or "scalar"
        meaning = f"scratch: {field.meaning}" if field in structures.SCRATCH_FIELDS else field.meaning
        cells = (f"`{field.name}`", field.unit, shape, field.dtype, field.lanes, meaning)
        rows.append(f"| {' | '.join(cells)} |")
    used = {field.lanes for field in table}
    layouts = [f"* `{name}`: {meaning}" for name, meaning in structures.LAYOUTS.items() if name in used]
    return "\n".join([*rows, "", *layouts])


def command_list() -> str:
    """A table of all commands, then a section each, as Markdown."""
    from surgsim_apps.cli.main import EXAMPLES

    texts = {name: said(name, "--help") for name in EXAMPLES}
    rows = [f"| [`{name}`](#surgsim-{name}) | {_first_sentence(text)} |" for name, text in texts.items()]
    return "\n".join(["| command | |", "|---|---|", *rows, "", *(_section(name, text) for name, text in texts.items())])


def said(*arguments: str) -> str:
    """The output of the command line, with one line for each option."""
    from surgsim_apps.cli.main import main

    printed = io.StringIO()
    with mock.patch.dict(os.environ, COLUMNS), contextlib.redirect_stdout(printed):
        status = main(arguments)
    assert status == 0, (arguments, status)
    return printed.getvalue()


def _section(name: str, text: str) -> str:
    usage, description, tables = _parts(text)
    lines = [f"## surgsim {name}\n", f"```text\n{usage}\n```\n", description, ""]
    for title, rows in tables:
        if rows:
            lines += [
                f"| {title} | |",
                "|---|---|",
                *(f"| {_code(what)} | {_cell(help_text)} |" for what, help_text in rows),
                "",
            ]
    return "\n".join(lines)


def _parts(text: str) -> tuple[str, str, list[tuple[str, list[tuple[str, str]]]]]:
    """Usage, description, and for each box its title and rows of two."""
    head, *boxes = re.split(r"^[╭ ]─?\s?([a-z][a-z ]*?)\s*─*╮?\s*$", text, flags=re.MULTILINE)
    usage, _, description = head.strip().partition("\n\n")
    tables = [(title, _rows(body)) for title, body in zip(boxes[::2], boxes[1::2])]
    return usage.removeprefix("usage: "), description.strip(), tables


def _rows(body: str) -> list[tuple[str, str]]:
    """The rows of a box: options, and their help on the same line or on the indented lines below."""
    rows: list[tuple[str, str]] = []
    for line in body.splitlines():
        content = line.strip("│╰╯").rstrip()
        if not set(content) - set("-─ "):
            continue
        if re.match(r" {1,3}\S", content):
            what, *rest = re.split(r" {2,}", content.strip(), maxsplit=1)
            rows.append((what, " ".join(rest)))
        elif rows:
            what, help_text = rows[-1]
            rows[-1] = (what, f"{help_text} {content.strip()}".strip())
    return [row for row in rows if row[0] != "-h, --help"]


def _first_sentence(text: str) -> str:
    return _cell(re.split(r"(?<=[.;:])\s", _parts(text)[1], maxsplit=1)[0].rstrip(".;:"))


def _code(text: str) -> str:
    return f"<code>{html.escape(text)}</code>".replace("|", "&#124;")


def _cell(text: str) -> str:
    """Text for a table cell, with bars and the dashes of options escaped."""
    return re.sub(r"(?<![\w`-])(--[\w-]+)", r"`\1`", text.replace("|", "&#124;"))
