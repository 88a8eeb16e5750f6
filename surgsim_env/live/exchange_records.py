"""What the physics' process and the page's share: where hands are, what became of it, traces, recorded steps."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgsim_env.live.shared_record import SharedRecord
from surgsim_env.live.shared_rows import SharedRows
from surgsim_env.pacing import TIMING

# One row of the trace covers this many haptic steps, and so many rows are kept: 20 s at 1 kHz.
TRACE_STEPS, TRACE_LENGTH = 10, 2048
# Longest recording, in haptic steps: 5 minutes at 1 kHz.
RECORDING_MOST = 300_000
TEXT_MOST = 240


class Phase(IntEnum):
    """What the physics is doing."""

    STARTING = 0
    RUNNING = 1
    PAUSED = 2
    FAULT = 3
    ENDED = 4


def hand_type(arm_count: int) -> np.dtype:
    """Page to physics: where each arm shall be [m], its buttons, a beat while the page lives, requests sent."""
    return np.dtype(
        [("target", "f8", (arm_count, 3)), ("buttons", "i8", (arm_count,)), ("beat", "i8"), ("requests", "i8")]
    )


def frame_type(arm_count: int, node_count: int, geom_count: int) -> np.dtype:
    """Physics to page, some 60 times a second.

    phase, organ (which one, counted from 1), recording and replaying, time [s] since the reset, fault or refusal in
    words, added_mass [kg]; for each arm tip and coupled place [m], the tissue's force on it and the device's [N], the
    share of force that the watchdog leaves, whether a limit acts; nodes [m], places [m] and rotations of shown geoms.
    """
    arms = (arm_count, 3)
    return np.dtype(
        [
            ("phase", "i4"), ("organ", "i8"), ("recording", "?"), ("replaying", "?"), ("time", "f8"),
            ("said", f"S{TEXT_MOST}"), ("added_mass", "f8"), ("tip", "f8", arms), ("place", "f8", arms),
            ("force", "f8", arms), ("pushed", "f8", arms), ("share", "f8", (arm_count,)),
            ("limited", "?", (arm_count,)), ("node", "f4", (node_count, 3)), ("geom", "f4", (geom_count, 3)),
            ("turn", "f4", (geom_count, 9)),
        ]
    )  # fmt: skip


def trace_type(arm_count: int) -> np.dtype:
    """Physics to page: a ring of rows of time [s], tip and depth [m], force [N] and its peak since the last row."""
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
    return np.dtype([("organ", "i8"), ("count", "i8"), ("row", row, (TRACE_LENGTH,))])


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
    """Room for a recording that both processes see; its count is written last, by one of them at a time."""

    def __init__(self, arm_count: int, most: int = RECORDING_MOST) -> None:
        """Nothing recorded."""
        self._shared = SharedRows(recording_type(arm_count), most)

    @property
    def count(self) -> int:
        """How many steps there are."""
        return int(self._shared.counter[0])

    @property
    def full(self) -> bool:
        """Whether there is no room for another."""
        return self.count >= len(self._shared.rows)

    @property
    def steps(self) -> NDArray[Any]:
        """The recorded steps themselves, (count,)."""
        return self._shared.rows[: self.count]

    def clear(self) -> None:
        """Forget them."""
        self._shared.counter[0] = 0

    def append(self, time: float, hand: NDArray, buttons: list[int], tip: NDArray, force: NDArray) -> None:
        """Add a step; there must be room."""
        step = self._shared.rows[self.count]
        step["time"], step["hand"], step["buttons"], step["tip"], step["force"] = time, hand, buttons, tip, force
        self._shared.counter[0] += 1

    def fill(self, steps: NDArray[Any]) -> None:
        """Take steps from elsewhere.

        Raises:
            ValueError: more of them than there is room for.
        """
        most = len(self._shared.rows)
        if len(steps) > most:
            raise ValueError(f"a recording of {len(steps)} steps is longer than {most}: cut it")
        self.clear()
        self._shared.rows[: len(steps)] = steps
        self._shared.counter[0] = len(steps)


@dataclass(frozen=True)
class Exchange:
    """All that is shared: `hand` and `recorded` (while it replays) are the page's to write, the rest the physics'."""

    arm_count: int
    node_count: int
    hand: SharedRecord
    frame: SharedRecord
    trace: SharedRecord
    timing: SharedRecord
    recorded: RecordedSteps


def new_exchange(arm_count: int, node_count: int, geom_count: int) -> Exchange:
    """Memory for one session."""
    return Exchange(
        arm_count=arm_count,
        node_count=node_count,
        hand=SharedRecord(hand_type(arm_count)),
        frame=SharedRecord(frame_type(arm_count, node_count, geom_count)),
        trace=SharedRecord(trace_type(arm_count)),
        timing=SharedRecord(TIMING),
        recorded=RecordedSteps(arm_count),
    )


def said(text: str) -> bytes:
    """A text as a frame holds it, cut to its length."""
    return text.encode("utf-8")[:TEXT_MOST].decode("utf-8", "ignore").encode("utf-8")
