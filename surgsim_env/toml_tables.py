"""TOML files read into frozen dataclasses: every entry checked, a misspelt one answered with the nearest known."""

import tomllib
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

import dacite

from msdm_core.errors import OrganError

Table = TypeVar("Table")


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """The table of a file; ValueError says what file cannot be read, or what in it is no TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        if isinstance(error, tomllib.TOMLDecodeError | UnicodeDecodeError):
            raise ValueError(f"{what} file {path} is not valid TOML: {error}") from None
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ValueError(f"{what} file {path} cannot be read: {reason}") from None


def fill(kind: type[Table], table: dict[str, Any], where: str, parts: tuple[type, ...]) -> Table:
    """A dataclass from a table; `parts` are the dataclasses in it, for their entries' names.

    Raises:
        ValueError: an unknown entry (suggests the nearest), a missing or wrong one; begins with `where`.
    """
    try:
        return dacite.from_dict(
            kind, table, dacite.Config(strict=True, cast=[tuple], type_hooks={float: _real, int: _whole})
        )
    except dacite.UnexpectedDataError as error:
        entry = sorted(map(str, error.keys))[0]
        known = sorted({name for part in (kind, *parts) for name in part.__dataclass_fields__})  # type: ignore[attr-defined]
        raise ValueError(f"{where}: entry {entry!r} is unknown there{nearest(entry, known)}") from None
    except (dacite.DaciteError, OrganError, ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{where}: {error}") from None


def nearest(name: str, known: list[str]) -> str:
    """A hint at the nearest known name, or an empty string."""
    found = get_close_matches(name, known, n=1)
    return f"; did you mean {found[0]!r}?" if found else ""


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{value!r} is not a whole number")
    return value


def _real(value: Any) -> float:
    """TOML tells 5000 from 5000.0; a scene does not."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{value!r} is not a number")
    return float(value)
