"""Replaces `<!-- commands -->` in a page by the help texts of `surgsim` and each of its commands."""

import contextlib
import html
import io
import os
import re
from unittest import mock

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

MARK = "<!-- commands -->"
# Wide enough for each option to be on one line.
COLUMNS = {"COLUMNS": "4000"}


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Replace the mark."""
    return markdown.replace(MARK, command_list()) if MARK in markdown else markdown


def command_list() -> str:
    """A table of all commands, then a section each, as Markdown."""
    (names,) = re.findall(r"^usage: surgsim .*\{([\w,]+)\}", said("--help"), flags=re.MULTILINE)
    told = {name: said(name, "--help") for name in names.split(",")}
    rows = [f"| [`{name}`](#surgsim-{name}) | {_first_sentence(text)} |" for name, text in told.items()]
    return "\n".join(["| command | |", "|---|---|", *rows, "", *(_section(name, text) for name, text in told.items())])


def said(*arguments: str) -> str:
    """The output of the command line, with one line for each option."""
    from surgsim_env.cli.main import main

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
            lines += [f"| {title} | |", "|---|---|", *(f"| {_code(what)} | {_cell(told)} |" for what, told in rows), ""]
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
            what, *told = re.split(r" {2,}", content.strip(), maxsplit=1)
            rows.append((what, " ".join(told)))
        elif rows:
            what, told = rows[-1]
            rows[-1] = (what, f"{told} {content.strip()}".strip())
    # tyro marks optional values as {None}|PATH ... (default: None).
    none = re.compile(r"\{None\}\||\s*\(default: (?:None)?\)")
    return [(none.sub("", what), none.sub("", told)) for what, told in rows if what != "-h, --help"]


def _first_sentence(text: str) -> str:
    return _cell(re.split(r"(?<=[.;:])\s", _parts(text)[1], maxsplit=1)[0].rstrip(".;:"))


def _code(text: str) -> str:
    return f"<code>{html.escape(text)}</code>".replace("|", "&#124;")


def _cell(text: str) -> str:
    """Text for a table cell, with bars and the dashes of options escaped."""
    return re.sub(r"(?<![\w`-])(--[\w-]+)", r"`\1`", text.replace("|", "&#124;"))
