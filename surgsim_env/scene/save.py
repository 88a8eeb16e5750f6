"""Scenes, arms and ports written as TOML from the dataclasses' fields, so none can be left out."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any

import tomlkit
from tomlkit.items import AbstractTable, Item, Table

from surgsim_env.scene.model import Ball, Box, Side

# Fields from the file's own path, not written.
PATH_FIELDS = ("name", "folder")
# Tables written on one line.
INLINE_TABLES = (Box, Ball, Side)
# Column of comments [characters]; longer entries push them back.
COMMENT_COLUMN = 23


def as_toml(values: Any, *, head: Sequence[str] = (), comments: Mapping[str, str] | None = None) -> str:
    """TOML of a frozen dataclass, as of a scene, an arm's description or ports, from which `fill` makes an equal one.

    Args:
        values: to be written.
        head: comment lines at the top.
        comments: texts by the path of their entry or table, such as "contact.stiffness" or "regions[0].material";
            "regions.material" is for all regions.
    """
    document = tomlkit.document()
    for line in head:
        document.add(tomlkit.comment(_printable(line)))
    _fill(document, values, "", comments or {})
    return tomlkit.dumps(document)


def _fill(table: tomlkit.TOMLDocument | AbstractTable, values: Any, path: str, comments: Mapping[str, str]) -> None:
    """Add the fields of a dataclass to the table at a path of the document."""
    entries = [
        (entry, getattr(values, entry.name)) for entry in fields(values) if path or entry.name not in PATH_FIELDS
    ]
    # TOML wants a table's entries before its sub-tables.
    for entry, value in sorted(entries, key=lambda pair: _is_table(pair[1])):
        if value in (None, (), {}) and value == _default(entry):
            continue
        table.add(entry.name, _item(entry.name, value, f"{path}{entry.name}", comments))


def _item(name: str, value: Any, path: str, comments: Mapping[str, str]) -> Item:
    """TOML item of a field, with its comment."""
    if _is_tables(value):
        array = tomlkit.aot()
        for number, row in enumerate(value):
            array.append(_item(name, row, f"{path}[{number}]", comments))
        return array
    if is_dataclass(value):
        item = tomlkit.inline_table() if isinstance(value, INLINE_TABLES) else tomlkit.table()
        _fill(item, value, f"{path}.", comments)
    elif isinstance(value, dict):
        item = tomlkit.table()
        for key, part in value.items():
            item.add(key, _plain(part))
    else:
        item = tomlkit.item(_plain(value))
    plain = re.sub(r"\[\d+\]", "", path)
    comment = comments.get(path) or comments.get(plain)
    if comment:
        head = f"[[{plain}]]" if path.endswith("]") else f"[{plain}]"
        before = head if isinstance(item, Table) else f"{name} = {item.as_string()}"
        item.comment(_printable(comment))
        item.trivia.comment_ws = " " * max(COMMENT_COLUMN - len(before), 1)
    return item


def _is_tables(value: Any) -> bool:
    return isinstance(value, tuple) and bool(value) and is_dataclass(value[0])


def _is_table(value: Any) -> bool:
    return (
        _is_tables(value) or isinstance(value, dict) or (is_dataclass(value) and not isinstance(value, INLINE_TABLES))
    )


def _default(entry: Field) -> Any:
    return entry.default if entry.default_factory is MISSING else entry.default_factory()


def _plain(value: Any) -> Any:
    """Value with tuples as lists, for TOML."""
    return [_plain(part) for part in value] if isinstance(value, tuple) else value


def _printable(text: str) -> str:
    """Text without control characters, for a TOML comment."""
    return "".join(letter if letter.isprintable() else " " for letter in text)
