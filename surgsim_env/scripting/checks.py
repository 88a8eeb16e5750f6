"""Refusals of wrong values in the steps of a script: the step, the field, the value, the rule, the way out."""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike


def above_zero(step: Any, *fields: str) -> None:
    """Each field is a finite number above 0.

    Raises:
        ValueError: names the step, the field and the value.
    """
    for field in fields:
        value = getattr(step, field)
        if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not 0.0 < value < math.inf:
            raise ValueError(
                f"{type(step).__name__}: {field} is {value!r}; it must be a finite number above 0, in SI units "
                "(metres, newtons, seconds)"
            )


def point_of(step: Any, field: str, value: ArrayLike) -> tuple[float, float, float]:
    """Three finite coordinates.

    Raises:
        ValueError: names the step, the field and the value.
    """
    try:
        point = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        point = np.zeros(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ValueError(f"{type(step).__name__}: {field} is {value!r}; it must be three finite numbers, x, y and z")
    x, y, z = point.tolist()
    return x, y, z


def unit_vector(step: Any, field: str, value: ArrayLike) -> tuple[float, float, float]:
    """A direction at length 1.

    Raises:
        ValueError: not three finite numbers, or all of them 0.
    """
    vector = np.array(point_of(step, field, value))
    length = float(np.linalg.norm(vector))
    if not 0.0 < length < math.inf:
        raise ValueError(f"{type(step).__name__}: {field} is {value!r}; it must point somewhere: (0, 0, -1) is down")
    x, y, z = (vector / length).tolist()
    return x, y, z


def callable_for(step: Any, field: str, what: str) -> None:
    """The field can be called.

    Raises:
        TypeError: names the step, the field and the value.
    """
    value = getattr(step, field)
    if not callable(value):
        raise TypeError(f"{type(step).__name__}: {field} is {value!r}; it must be callable: {what}")
