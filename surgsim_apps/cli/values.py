"""Types of command-line options, parsing of their texts, and default folders of reports."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import tyro

from msdm_core.mesh_files import LengthUnit

# Optional values, shown in the help without tyro's "{None}|" and "(default: None)".
MaybeText = Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint="")]
MaybePath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]
MaybeNumber = Annotated[float | None, tyro.conf.arg(metavar="NUMBER", help_behavior_hint="")]
MaybeCount = Annotated[int | None, tyro.conf.arg(metavar="COUNT", help_behavior_hint="")]
# A checkout's root; of an installed package, a folder without pyproject.toml.
ROOT = Path(__file__).resolve().parents[2]


def numbers_of(option: str, text: str, form: str) -> tuple[float, ...]:
    """The numbers of a list such as 0,0,-1; a ValueError quotes the required form, such as x,y,z."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != len(form.split(",")):
        raise ValueError(f"{option} is {text!r}; the form is {form}, numbers with commas and no blanks between them")
    return numbers


def vector_of(option: str, text: str | None) -> tuple[float, float, float] | None:
    """The three numbers of an option such as --approach 0,0,-1; None without it."""
    if text is None:
        return None
    x, y, z = numbers_of(option, text, "x,y,z")
    return x, y, z


def unit_of(text: str | None) -> LengthUnit | None:
    """A length unit by name, or metres per unit."""
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        return text


def command_text(words: Sequence[str], options: Mapping[str, object]) -> str:
    """A shell command: its words, then the options with values, lists by repeating the option."""
    words = list(words)
    for name, value in options.items():
        option = f"--{name.replace('_', '-')}"
        for item in value if isinstance(value, tuple) else (value,):
            if item is None or item is False:
                continue
            # A shell word such as -1,0,0 would be parsed as an option.
            joined = str(item).startswith("-")
            words += [option] if item is True else [f"{option}={item}"] if joined else [option, str(item)]
    return shlex.join(words)


@contextmanager
def missing_packages(command: str, extra: str) -> Iterator[None]:
    """Turn a missing package into a ValueError with the extra of pyproject.toml."""
    try:
        yield
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing in ("msdm_core", "surgsim_env", "surgsim_apps"):
            raise
        raise ValueError(f"surgsim {command} needs {missing}: pip install 'surgsim[{extra}]'") from None


def report_folder(folder: Path | None, name: str, *, quick: bool) -> Path:
    """Folder of a report: the option's, else docs/ of a checkout; elsewhere and for a quick run runs/NAME."""
    checkout = (ROOT / "pyproject.toml").is_file()
    return folder or (ROOT / "docs" if checkout and not quick else Path("runs") / name)
