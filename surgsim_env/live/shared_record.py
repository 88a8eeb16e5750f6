"""A record in memory that two processes share: one writes and never waits, others read whole copies."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgsim_env.live.errors import LiveError
from surgsim_env.live.shared_rows import SharedRows

# How long a reader tries before it says that the writer never holds still [s]: a writer may be put aside by other
# processes in the middle of it. Between tries it lets others run for so long.
PATIENCE, PAUSE = 1.0, 50e-6


class SharedRecord:
    """One numpy record under a sequence lock (Lameter 2005): odd while it is written, even when it is whole.

    One thread writes at a time; a reader never makes it wait.
    """

    def __init__(self, dtype: np.dtype) -> None:
        """Zeros."""
        self._shared = SharedRows(dtype)

    @contextmanager
    def writing(self) -> Iterator[NDArray[Any]]:
        """The record to change; readers that come meanwhile try again."""
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
        shared = self._shared
        before = int(shared.counter[0])
        shared.fence()
        copy = self.peek.copy()
        shared.fence()
        return copy if before % 2 == 0 and before == int(shared.counter[0]) else None

    @property
    def peek(self) -> NDArray[Any]:
        """The record itself, for its writer, and for readers of single numbers."""
        return self._shared.rows.reshape(())
