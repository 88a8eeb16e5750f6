"""Counts what compiled functions allocate."""

from typing import Any

from numba.core.runtime import _nrt_python, rtsys


def allocations(call: Any, *given: Any) -> int:
    """Number of times numba's runtime takes memory, or an array's header, in a call."""
    _nrt_python.memsys_enable_stats()
    before = rtsys.get_allocation_stats()
    call(*given)
    after = rtsys.get_allocation_stats()
    return after.alloc - before.alloc + after.mi_alloc - before.mi_alloc
