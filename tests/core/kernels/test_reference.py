"""Structures passed by reference between compiled functions."""

from typing import NamedTuple

import numpy as np
import pytest
from numba import njit, typeof
from numba.core.errors import LoweringError, TypingError
from numpy.typing import NDArray

from msdm_core.kernels.reference_kernels import StructureReference, by_reference


class Rod(NamedTuple):
    """Arrays of two types and a number."""

    place: NDArray
    nodes: NDArray
    length: float


ROD = Rod(np.arange(6.0).reshape(2, 3), np.array([3, 4], dtype=np.int32), 2.5)


@njit
def stretch(rod, by):
    for axis in range(3):
        rod.place[1, axis] += by
    return rod.length + rod.nodes[1]


@njit(_nrt=False)
def stretched(rod, by):
    held = by_reference(by_reference(rod))
    return stretch(held, by) + held.place[1, 0]


def test_fields_are_those_of_the_structure_and_arrays_are_written_in_place():
    rod = Rod(ROD.place.copy(), ROD.nodes, ROD.length)
    assert stretched(rod, 1.0) == 2.5 + 4 + 4.0
    assert np.array_equal(rod.place, [[0.0, 1.0, 2.0], [4.0, 5.0, 6.0]])
    (compiled,) = stretch.signatures
    assert isinstance(compiled[0], StructureReference)


def test_references_to_other_types_of_fields_are_types_of_their_own():
    """Their names are short: a number in them tells them apart."""
    first, second = (
        StructureReference(typeof(ROD._replace(place=place))) for place in (ROD.place, ROD.place.astype(np.float32))
    )
    assert first != second
    assert first.mangling_args != second.mangling_args
    assert first == StructureReference(typeof(ROD))


def test_what_cannot_be_read_or_referred_to_is_named():
    with pytest.raises(TypingError, match="Unknown attribute 'width' of type StructureReference"):
        njit(lambda rod: by_reference(rod).width, _nrt=False)(ROD)
    with pytest.raises(TypingError, match="by_reference"):
        njit(lambda rod: by_reference(rod.place)[0, 0])(ROD)
    with pytest.raises(LoweringError, match="by_reference is for functions without numba's runtime"):
        njit(lambda rod: by_reference(rod).length)(ROD)
