"""Which labels of an image are which tissue: the option `--labels liver=1,lesion=2`."""

import re
from dataclasses import dataclass

from msdm_core.errors import MeshError

# What a region may be called: it is written into mesh files, TOML and HTML.
NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_ .-]{0,39}")
LABEL_LARGEST = 2**31 - 1
LABELS_MOST = 32
FORM = "--labels NAME=LABEL,... with the organ first, such as liver=1,lesion=2"


@dataclass(frozen=True)
class LabelName:
    """A tissue and its whole number in the image."""

    name: str
    value: int


def parse_labels(text: str) -> tuple[LabelName, ...]:
    """The tissues of an option's text, the organ first.

    Raises:
        MeshError: names the part that breaks the form, the name or the number given twice.
    """
    names = []
    for part in text.split(","):
        name, found, value = part.partition("=")
        name = name.strip()
        if not found or not re.fullmatch(r"\s*\d{1,10}\s*", value):
            raise MeshError(f"--labels: {part!r} is no NAME=LABEL; give {FORM}")
        if not 1 <= int(value) <= LABEL_LARGEST:
            raise MeshError(f"--labels: {part!r}: labels are from 1 to {LABEL_LARGEST}, 0 is outside; give {FORM}")
        names.append(LabelName(check_name(name, "--labels"), int(value)))
    for what in ("name", "value"):
        given = [getattr(one, what) for one in names]
        twice = next((one for one in given if given.count(one) > 1), None)
        if twice is not None:
            raise MeshError(f"--labels: {twice!r} is given twice; each tissue has one label of its own")
    if len(names) > LABELS_MOST:
        raise MeshError(f"--labels: {len(names)} labels are given; at most {LABELS_MOST} are taken")
    return tuple(names)


def check_name(name: str, option: str) -> str:
    """The name, if a region may have it; MeshError says which option and the rule."""
    if not NAME.fullmatch(name) or name != name.strip():
        raise MeshError(
            f"{option}: {name!r} cannot be a region's name; use letters, digits, blanks and _ . - (at most 40)"
        )
    return name
