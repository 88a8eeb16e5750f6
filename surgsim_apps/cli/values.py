"""Types of command-line options, parsing of their texts, and default folders of reports."""

import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from decimal import Decimal
from pathlib import Path
from typing import Annotated

import tyro

from msdm_core.mesh_files import LengthUnit

# Powers of ten of the units of lengths [m], longer names first.
UNITS = {"mm": -3, "cm": -2, "m": 0}
# Of numbers in lists.
NUMBER_LARGEST = 1e6


def length_of(text: str) -> float:
    """A length [m] from 5mm, 0.5cm, 0.005m or 0.005.

    Raises:
        ValueError: a text in another form.
    """
    unit = next((unit for unit in UNITS if text.endswith(unit)), "m")
    try:
        return float(Decimal(text.removesuffix(unit).strip()).scaleb(UNITS[unit]))
    except ArithmeticError:
        raise ValueError(f"{text!r} is no length; give one such as 5mm, 0.5cm or 0.005 (metres)") from None


def path_of(text: str) -> Path:
    """A path; an empty one, as of an unset variable of a shell, is refused: it would be the working folder.

    Raises:
        ValueError: no text.
    """
    if not text.strip():
        raise ValueError("the path is empty; give one, . for the working folder")
    return Path(text)


def _parsed(metavar: str, parse: Callable[[str], object]) -> object:
    """Mark of a type whose values a function reads from one text."""
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda texts: parse(texts[0]),
        is_instance=lambda value: True,
        str_from_instance=lambda value: [str(value)],
    )


def shown_as(metavar: str) -> object:
    """Mark of an option that is shown without a default."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")


Text = Annotated[str, tyro.conf.arg(metavar="TEXT")]
SceneName = Annotated[str, tyro.conf.arg(metavar="SCENE")]
Length = Annotated[float, _parsed("LENGTH", length_of)]
AnyPath = Annotated[Path, _parsed("PATH", path_of)]
Paths = Annotated[tuple[AnyPath, ...], shown_as("FILE ...")]
MaybeText = Annotated[str | None, shown_as("TEXT")]
MaybeScene = Annotated[str | None, shown_as("SCENE")]
MaybeNumber = Annotated[float | None, _parsed("NUMBER", float), shown_as("NUMBER")]
MaybeCount = Annotated[int | None, _parsed("COUNT", int), shown_as("COUNT")]
MaybePath = Annotated[Path | None, _parsed("PATH", path_of), shown_as("PATH")]
MaybeLength = Annotated[float | None, _parsed("LENGTH", length_of), shown_as("LENGTH")]
# A checkout's root; of an installed package, a folder without pyproject.toml.
ROOT = Path(__file__).resolve().parents[2]


def numbers_of(option: str, text: str, form: str, *, are_lengths: bool = True) -> tuple[float, ...]:
    """The numbers of a list such as 0,0,-1: lengths, but for a `site` or `ratio`; none is huge.

    Raises:
        ValueError: quotes the required form, such as x,y,z.
    """
    names, parts = form.lower().split(","), text.split(",")
    try:
        numbers = tuple(
            length_of(part) if are_lengths and name not in ("site", "ratio") else float(part)
            for name, part in zip(names, parts, strict=True)
        )
    except ValueError:
        numbers = ()
    if not (numbers and all(abs(number) < NUMBER_LARGEST for number in numbers)):
        units = ": lengths such as 5mm or 0.005 (metres), sites and ratios without a unit" if are_lengths else ""
        raise ValueError(
            f"{option} is {text!r}; the form is {form}, numbers below {NUMBER_LARGEST:g} with commas and no "
            f"blanks{units}"
        )
    return numbers


def vector_of(option: str, text: str | None, *, are_lengths: bool = False) -> tuple[float, float, float] | None:
    """The three numbers of an option such as --approach 0,0,-1; None without it."""
    if text is None:
        return None
    x, y, z = numbers_of(option, text, "x,y,z", are_lengths=are_lengths)
    return x, y, z


def unit_of(text: str | None) -> LengthUnit | None:
    """A length unit by name, or metres per unit."""
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        return text


def shown_path(source: str | Path) -> str:
    """A path independent of the machine: relative to the working folder, or its name alone."""
    path = Path(source)
    if not path.is_absolute():
        return path.as_posix()
    return path.relative_to(Path.cwd()).as_posix() if path.is_relative_to(Path.cwd()) else path.name


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
