"""A record in memory that two processes share: one writes and never waits, others read whole copies."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.sharedctypes import RawArray
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgsim_env.live.errors import LiveError

# How long a reader tries before it says that the writer never holds still [s]: a writer may be put aside by other
# processes in the middle of it. Between tries it lets others run for so long.
PATIENCE, PAUSE = 1.0, 50e-6


class SharedRecord:
    """One numpy record under a sequence lock (Lameter 2005): odd while it is written, even when it is whole.

    The memory has no name that others could open, and goes with its last process. It is handed to a child as an
    argument of its `Process`. One thread writes at a time; a reader never makes it wait.
    """

    def __init__(self, dtype: np.dtype) -> None:
        """Zeros."""
        self.dtype = dtype
        self._memory = RawArray("B", 8 + dtype.itemsize)
        self._view()

    @contextmanager
    def writing(self) -> Iterator[NDArray[Any]]:
        """The record to change; readers that come meanwhile try again."""
        self._sequence[0] += 1
        self._fence()
        try:
            yield self._record
        finally:
            self._fence()
            self._sequence[0] += 1

    def read(self) -> NDArray[Any]:
        """A copy of the record as one `writing` left it, shape ().

        Raises:
            LiveError: its writer died, or never stops, in the middle of it.
        """
        begin = time.monotonic()
        while time.monotonic() - begin < PATIENCE:
            copy = self.glance()
            if copy is not None:
                return copy
            time.sleep(PAUSE)
        raise LiveError("a shared record is never whole: the process that writes it died in the middle")

    def glance(self) -> NDArray[Any] | None:
        """A copy of the record, or None where it is being written just now: it never waits, and never raises."""
        before = int(self._sequence[0])
        self._fence()
        copy = self._record.copy()
        self._fence()
        return copy if before % 2 == 0 and before == int(self._sequence[0]) else None

    @property
    def peek(self) -> NDArray[Any]:
        """The record itself, for its writer, and for readers of single numbers."""
        return self._record

    def __getstate__(self) -> dict[str, Any]:
        return {"dtype": self.dtype, "_memory": self._memory}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._view()

    def _view(self) -> None:
        whole = np.frombuffer(self._memory, dtype=np.uint8)
        self._sequence = whole[:8].view(np.int64)
        self._record = whole[8:].view(self.dtype).reshape(())
        self._barrier = threading.Lock()

    def _fence(self) -> None:
        # x86 keeps the order of stores; elsewhere taking a lock, even one of our own, is what keeps it.
        with self._barrier:
            pass
