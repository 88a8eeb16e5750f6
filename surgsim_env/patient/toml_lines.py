"""Lines of TOML files that are written: any string, any comment."""

import json
import re
from typing import Any


def entry(name: str, value: Any, why: str = "") -> str:
    """A line of a table, with a comment that says why it is so."""
    text = quoted(value) if isinstance(value, str) else repr(value) if isinstance(value, float) else json.dumps(value)
    line = f"{name} = {text}"
    return f"{line:<22} # {comment(why)}" if why else line


def quoted(text: str) -> str:
    """A TOML string: JSON's, but for DEL, which TOML wants escaped, and halves of surrogate pairs, which it refuses.

    Such halves are how Python writes the bytes of file names that are not UTF-8; they become the replacement character.
    """
    whole = re.sub("[\ud800-\udfff]", "\ufffd", text)
    return json.dumps(whole, ensure_ascii=False).replace("\x7f", "\\u007f")


def comment(text: str) -> str:
    """What TOML lets stand in a comment: one line without control characters."""
    return "".join(one if one.isprintable() else " " for one in text)
