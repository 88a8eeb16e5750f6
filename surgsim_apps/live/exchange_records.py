"""Exchange of the processes of physics and page: hands, frames, traces, recordings in shared memory; requests."""

import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum
from multiprocessing.sharedctypes import RawArray
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgsim_apps.haptics.pacing import TIMING
from surgsim_apps.live.organ_choice import OrganChoice

# Haptic steps per row of the trace, and its number of rows: 20 s at 1 kHz.
TRACE_STEPS, TRACE_LENGTH = 10, 2048
# Longest recording, in haptic steps: 5 minutes at 1 kHz.
RECORDING_MOST = 300_000
TEXT_MOST = 240
# Time of a reader's tries before it raises [s], as the scheduler may stop a writer in the middle of a record; pause
# between tries [s].
PATIENCE, PAUSE = 1.0, 50e-6
_COUNTER_SIZE = 8


class LiveError(OSError):
    """End of a session: its physics ended, its memory is inconsistent, or its server is unprotected.

    An `OSError`: the command line prints it as one line.
    """


# ---- shared memory: one process writes without waiting, others read consistent copies ------------------------------


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


class SharedRows:
    """An array of zeros, shared with a child process as an argument of its `Process`.

    The memory has no name for other processes, and is freed with the last of its users.

    Fields:
        counter: for synchronisation                                              (1,)
        rows: of the constructor's dtype                                         (count,)
    """

    def __init__(self, dtype: np.dtype, count: int = 1) -> None:
        """Allocate `count` rows; the system provides pages of memory at their first write."""
        self._dtype, self._memory = dtype, RawArray("B", _COUNTER_SIZE + count * dtype.itemsize)
        self._view()

    def fence(self) -> None:
        """Memory barrier: readers with the same barrier see writes before it earlier than writes after it."""
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


# ---- contents ------------------------------------------------------------------------------------------------------


class Phase(IntEnum):
    """State of the physics."""

    STARTING = 0
    RUNNING = 1
    PAUSED = 2
    FAULT = 3
    ENDED = 4


def hand_type(arm_count: int) -> np.dtype:
    """Page to physics: target of each arm [m], its buttons, a beat that counts up."""
    return np.dtype([("target", "f8", (arm_count, 3)), ("buttons", "i8", (arm_count,)), ("beat", "i8")])


def frame_type(arm_count: int, node_count: int, geom_count: int, taxels: tuple[int, ...]) -> np.dtype:
    """Physics to page, some 60 times a second.

    phase, organ (1, and 1 more for each Change up to its own), recording, the number of recordings begun, True for a
    held breath, time [s] since the reset, a message (a fault or a refusal), added_mass [kg]; for each arm its tip [m]
    and the force of tissue on it [N]; nodes [m]; positions [m] and rotations of geoms; normal force on each taxel [N],
    (n_patch, rows, columns).
    """
    arms = (arm_count, 3)
    return np.dtype(
        [
            ("phase", "i4"), ("organ", "i8"), ("recording", "?"), ("recordings", "i8"),
            ("breath_held", "?"), ("time", "f8"), ("message", f"S{TEXT_MOST}"), ("added_mass", "f8"),
            ("tip", "f8", arms), ("force", "f8", arms), ("node", "f4", (node_count, 3)),
            ("geom", "f4", (geom_count, 3)), ("turn", "f4", (geom_count, 9)), ("taxel", "f4", taxels),
        ]
    )  # fmt: skip


def tissue_type(state: Mapping[str, NDArray[Any]]) -> np.dtype:
    """Physics to page, with each frame while a field is painted: the organ's number, `Simulation.get_state()`."""
    return np.dtype([("organ", "i8"), *((name, array.dtype, array.shape) for name, array in state.items())])


def trace_type(arm_count: int) -> np.dtype:
    """Physics to page: a ring of rows of time [s], tip and depth [m], force [N] and its peak since the last row.

    The tip is relative to the moving ground of the organ.
    """
    arms = (arm_count, 3)
    row = np.dtype(
        [
            ("time", "f8"),
            ("tip", "f8", arms),
            ("depth", "f8", (arm_count,)),
            ("force", "f8", arms),
            ("peak", "f8", (arm_count,)),
        ]
    )
    return np.dtype([("count", "i8"), ("row", row, (TRACE_LENGTH,))])


def recording_type(arm_count: int) -> np.dtype:
    """One haptic step of a recording: time [s], the hand's place [m] and buttons, tip [m], the tissue's force [N]."""
    arms = (arm_count, 3)
    return np.dtype(
        [
            ("time", "f8"),
            ("hand", "f8", arms),
            ("buttons", "i8", (arm_count,)),
            ("tip", "f8", arms),
            ("force", "f8", arms),
        ]
    )


class RecordedSteps:
    """A recording in shared memory; its count is written last."""

    def __init__(self, arm_count: int, most: int = RECORDING_MOST) -> None:
        """Begin empty."""
        self._shared = SharedRows(recording_type(arm_count), most)

    @property
    def count(self) -> int:
        """Number of steps."""
        return int(self._shared.counter[0])

    @property
    def full(self) -> bool:
        """True if the memory is full."""
        return self.count >= len(self._shared.rows)

    @property
    def steps(self) -> NDArray[Any]:
        """View of the recorded steps, (count,)."""
        return self._shared.rows[: self.count]

    def clear(self) -> None:
        """Delete all steps."""
        self._shared.counter[0] = 0

    def append(self, time: float, hand: NDArray, buttons: list[int], tip: NDArray, force: NDArray) -> None:
        """Add a step; `full` must be False."""
        step = self._shared.rows[self.count]
        step["time"], step["hand"], step["buttons"], step["tip"], step["force"] = time, hand, buttons, tip, force
        self._shared.counter[0] += 1


@dataclass(frozen=True)
class Exchange:
    """Shared memory of a session. The page writes `hand`, the physics all others."""

    hand: SharedRecord
    frame: SharedRecord
    tissue: SharedRecord
    trace: SharedRecord
    timing: SharedRecord
    recorded: RecordedSteps


def new_exchange(
    arm_count: int,
    node_count: int,
    geom_count: int,
    state: Mapping[str, NDArray[Any]],
    taxels: tuple[int, ...] = (0, 0, 0),
) -> Exchange:
    """Allocate the memory of one session; `state` is one of its simulation, `taxels` patches, rows and columns."""
    return Exchange(
        hand=SharedRecord(hand_type(arm_count)),
        frame=SharedRecord(frame_type(arm_count, node_count, geom_count, taxels)),
        tissue=SharedRecord(tissue_type(state)),
        trace=SharedRecord(trace_type(arm_count)),
        timing=SharedRecord(TIMING),
        recorded=RecordedSteps(arm_count),
    )


# ---- requests of the page, through a pipe --------------------------------------------------------------------------


@dataclass(frozen=True)
class Pause:
    """Pause the physics, or continue."""

    on: bool


@dataclass(frozen=True)
class Reset:
    """Restart with the same organ at rest, tips parked."""


@dataclass(frozen=True)
class Change:
    """Restart with another organ at rest, tips parked."""

    choice: OrganChoice


@dataclass(frozen=True)
class Record:
    """Begin or end a recording."""

    on: bool


@dataclass(frozen=True)
class Paint:
    """Begin or end the copies of the tissue's state, from which the page computes a field."""

    on: bool


@dataclass(frozen=True)
class End:
    """End the physics' process."""


Request = Pause | Reset | Change | Record | Paint | End
