"""Sections `Fields:` and `Class attributes:` of docstrings become tables like `Args:`; mkdocstrings loads this file.

The parser of Google's style knows the section `Attributes:` only, and one name per entry.
"""

import re
from typing import Any

import griffe

TITLES = re.compile(r"^(Fields|Class attributes):$", re.MULTILINE)
# Names of one entry, and its text with the lines that are indented more.
SEVERAL = re.compile(r"^( +)(\w+(?:, \w+)+): (.*(?:\n\1 +.*)*)$", re.MULTILINE)


class DocstringSections(griffe.Extension):
    """Rewrites the docstring of each class before it is parsed."""

    def on_class(self, *, cls: griffe.Class, **settings: Any) -> None:
        """Rename the section, and give each name of an entry such as `lower, upper: ...` an entry of its own."""
        if cls.docstring is None:
            return
        text = TITLES.sub("Attributes:", cls.docstring.value)
        head, title, body = text.partition("Attributes:\n")
        cls.docstring.value = head + title + SEVERAL.sub(_one_each, body)


def _one_each(entry: re.Match[str]) -> str:
    return "\n".join(f"{entry[1]}{name}: {entry[3]}" for name in entry[2].split(", "))
