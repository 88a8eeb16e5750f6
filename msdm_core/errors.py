"""Errors of the organ model; each message has the element, its value, the rule and the way out."""

import math
from collections.abc import Sequence

__all__ = [
    "MeshError",
    "OrganDivergedError",
    "OrganError",
    "require_distinct",
    "require_not_negative",
    "require_positive",
]


class MeshError(ValueError):
    """A surface or tetrahedral mesh unfit for an organ."""


class OrganError(ValueError):
    """An organ specification (materials, lesions, anchors, step) against a physical rule."""


class OrganDivergedError(RuntimeError):
    """An unphysical state of an organ: an inverted tet or a number that is not finite."""


def require_positive(quantity: str, value: float, unit: str) -> None:
    """Raise OrganError unless a quantity is finite and above 0."""
    if not 0.0 < value < math.inf:
        raise OrganError(f"{quantity} is {value} {unit}; it must be finite and above 0")


def require_not_negative(quantity: str, value: float, unit: str = "") -> None:
    """Raise OrganError unless a quantity is finite and at least 0."""
    if not 0.0 <= value < math.inf:
        raise OrganError(f"{quantity} is {value} {unit}".rstrip() + "; it must be finite and at least 0")


def require_distinct(nouns: str, names: Sequence[str]) -> None:
    """Raise OrganError if two names are equal."""
    for name in names:
        if names.count(name) > 1:
            raise OrganError(f"two {nouns} are named {name!r}; names must differ: rename one")
