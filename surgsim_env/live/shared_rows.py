"""Memory that two processes share: a counter, and rows of one kind behind it."""

import threading
from multiprocessing.sharedctypes import RawArray
from typing import Any

import numpy as np

_COUNTER_SIZE = 8


class SharedRows:
    """Zeros that a child sees too, when it gets them as an argument of its `Process`.

    The memory has no name that others could open, and goes with its last process.

    Fields:
        counter: for whoever reads and writes to agree on                        (1,)
        rows: of the dtype that it was made with                                 (count,)
    """

    def __init__(self, dtype: np.dtype, count: int = 1) -> None:
        """Room for so many rows; pages of memory are taken as they are filled."""
        self._dtype, self._memory = dtype, RawArray("B", _COUNTER_SIZE + count * dtype.itemsize)
        self._view()

    def fence(self) -> None:
        """What was written before is seen before what is written after, by readers that do the same."""
        # x86 keeps the order of stores; elsewhere taking a lock, even one of our own, is what keeps it.
        with self._barrier:
            pass

    def __getstate__(self) -> dict[str, Any]:
        return {"_dtype": self._dtype, "_memory": self._memory}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._view()

    def _view(self) -> None:
        whole = np.frombuffer(self._memory, dtype=np.uint8)
        self.counter = whole[:_COUNTER_SIZE].view(np.int64)
        self.rows = whole[_COUNTER_SIZE:].view(self._dtype)
        self._barrier = threading.Lock()
