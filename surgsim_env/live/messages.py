"""Packets that `hand.js` sends: keys or a gamepad, and how a browser draws."""

import math
import struct
from dataclasses import dataclass

# Little-endian: along the view's right, away from the viewer, out of the organ, each -1 to 1; the arm, 0 or 1; 1 to
# toggle its jaw, else 0.
_HAND = struct.Struct("<3fHH")
# Frames a second that the browser draws; 1 if it has counted them; 1 if it has no graphics card; else 0.
_DRAWING = struct.Struct("<fHH")
FRAME_RATE_MOST = 1000.0
AXIS_SLACK = 1e-6


class InvalidMessageError(ValueError):
    """A packet that our own page never sends; states what is wrong with it. Its sender is disconnected."""


@dataclass(frozen=True)
class HandMotion:
    """Direction of keys or a gamepad: right, away and out, each -1 to 1; the arm it moves; whether its jaw toggles."""

    axes: tuple[float, float, float]
    arm: int
    turns_jaw: bool = False


@dataclass(frozen=True)
class DrawingReport:
    """Frames a second that a browser draws, None until it has counted them; whether it has no graphics card."""

    rate: float | None
    software: bool


def read_hand(message: object, *, arm_count: int) -> HandMotion:
    """The motion in a packet.

    Raises:
        InvalidMessageError: another size, a number that is not finite or beyond 1, an arm that does not exist.
    """
    if not isinstance(message, bytes) or len(message) != _HAND.size:
        raise InvalidMessageError(f"a packet of hand.js has {_HAND.size} bytes")
    *axes, arm, turns_jaw = _HAND.unpack(message)
    if not all(math.isfinite(axis) and abs(axis) <= 1.0 + AXIS_SLACK for axis in axes):
        raise InvalidMessageError("the axes of a hand are from -1 to 1")
    if arm >= arm_count or turns_jaw > 1:
        raise InvalidMessageError(f"arm {arm} of {arm_count}, jaw {turns_jaw}")
    right, away, out = axes
    return HandMotion((right, away, out), arm, bool(turns_jaw))


def read_report(message: object) -> DrawingReport | None:
    """How a browser draws; None for a packet of another size.

    Raises:
        InvalidMessageError: a rate out of range, a flag that is neither 0 nor 1.
    """
    if not isinstance(message, bytes) or len(message) != _DRAWING.size:
        return None
    rate, counted, software = _DRAWING.unpack(message)
    if not 0.0 <= rate <= FRAME_RATE_MOST or counted > 1 or software > 1:
        raise InvalidMessageError(f"{rate} frames a second, counted {counted}, software {software}")
    return DrawingReport(rate if counted else None, bool(software))
