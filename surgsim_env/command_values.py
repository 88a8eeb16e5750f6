"""Values of command-line options that are text: lists of numbers, length units."""

import shlex
from collections.abc import Mapping, Sequence

from msdm_core.length_unit import LengthUnit


def numbers_of(option: str, text: str, form: str) -> tuple[float, ...]:
    """The numbers of a list such as 0,0,-1; ValueError with the form it should have, such as x,y,z."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != len(form.split(",")):
        raise ValueError(f"{option} is {text!r}; the form is {form}, numbers with commas and no blanks between them")
    return numbers


def vector_of(option: str, text: str | None) -> tuple[float, float, float] | None:
    """The three numbers of an option such as --approach 0,0,-1; None where it is not given."""
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


def command_line(words: Sequence[str], options: Mapping[str, object]) -> str:
    """A command that a shell reads: its words, then the options that are given, lists by repeating the option."""
    words = list(words)
    for name, value in options.items():
        option = f"--{name.replace('_', '-')}"
        for one in value if isinstance(value, tuple) else (value,):
            if one is None or one is False:
                continue
            # A value such as -1,0,0 would be taken for an option of its own.
            joined = str(one).startswith("-")
            words += [option] if one is True else [f"{option}={one}"] if joined else [option, str(one)]
    return shlex.join(words)
