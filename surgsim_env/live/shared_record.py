"""Records in memory shared by two processes: one writes without waiting, others read consistent copies."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.sharedctypes import RawArray
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgsim_env.live.errors import LiveError

# How long a reader tries before it raises [s], as the scheduler may stop a writer in the middle of a record; the pause
# between tries [s].
PATIENCE, PAUSE = 1.0, 50e-6


class SharedRecord:
    """One numpy record under a sequence lock (Lameter 2005): odd while it is written, even when it is whole.

    Only one thread may write; readers never block it.
    """

    def __init__(self, dtype: np.dtype) -> None:
        """Zeros."""
        self._shared = SharedRows(dtype)

    @contextmanager
    def writing(self) -> Iterator[NDArray[Any]]:
        """The record, to be changed; readers try again meanwhile."""
        shared = self._shared
        shared.counter[0] += 1
        shared.fence()
        try:
            yield self.peek
        finally:
            shared.fence()
            shared.counter[0] += 1

    def read(self) -> NDArray[Any]:
        """A copy of the record as one `writing` left it, shape ().

        Raises:
            LiveError: no consistent copy within PATIENCE: the writer ended in the middle of the record.
        """
        begin = time.monotonic()
        while time.monotonic() - begin < PATIENCE:
            copy = self.glance()
            if copy is not None:
                return copy
            time.sleep(PAUSE)
        raise LiveError("a shared record stays incomplete: the process that writes it ended in the middle")

    def glance(self) -> NDArray[Any] | None:
        """A copy of the record, or None while it is being written; never waits, never raises."""
        shared = self._shared
        before = int(shared.counter[0])
        shared.fence()
        copy = self.peek.copy()
        shared.fence()
        return copy if before % 2 == 0 and before == int(shared.counter[0]) else None

    @property
    def peek(self) -> NDArray[Any]:
        """View of the record, for its writer and for readers of single numbers."""
        return self._shared.rows.reshape(())


_COUNTER_SIZE = 8


class SharedRows:
    """An array of zeros shared with a child process that receives it as an argument of its `Process`.

    The memory has no name that other processes could open, and is freed with the last process that uses it.

    Fields:
        counter: for synchronisation                                              (1,)
        rows: of the dtype that it was made with                                 (count,)
    """

    def __init__(self, dtype: np.dtype, count: int = 1) -> None:
        """Allocate `count` rows; the system provides pages of memory when they are first written."""
        self._dtype, self._memory = dtype, RawArray("B", _COUNTER_SIZE + count * dtype.itemsize)
        self._view()

    def fence(self) -> None:
        """Memory barrier: readers that use it too see writes before it earlier than writes after it."""
        # x86 keeps the order of stores; on other processors, acquiring any lock does.
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
