"""What `hand.js` sends: how fast keys and gamepads move a tip, in 16 bytes, and how the browser draws, in 8."""

import math
import struct
from dataclasses import dataclass

from surgsim_env.live.web_messages import NonsenseError

HAND_PATH = "/hand"
# Little-endian: along the view's right, away from the viewer, out of the organ, each -1 to 1; which arm, 0 or 1; 1 to
# turn its jaw from open to closed or back, else 0.
_PACKET = struct.Struct("<3fHH")
PACKET_SIZE = _PACKET.size
# Frames a second that the browser comes to; 1 where it has counted them; 1 where it has no graphics card; else 0.
_REPORT = struct.Struct("<fHH")
RATE_MOST = 1000.0
AXIS_SLACK = 1e-6


@dataclass(frozen=True)
class HandMotion:
    """Where a hand pushes: right, away and out, each -1 to 1; which arm it moves, and whether its jaw shall change."""

    axes: tuple[float, float, float]
    arm: int
    turns_jaw: bool = False


@dataclass(frozen=True)
class DrawingReport:
    """Frames a second that a browser comes to, None while it does not know; whether it has no graphics card."""

    rate: float | None
    software: bool


def read_hand(message: object, *, arm_count: int) -> HandMotion:
    """The motion that a packet asks for.

    Raises:
        NonsenseError: another size, a number that is not finite or beyond 1, an arm that there is not.
    """
    if not isinstance(message, bytes) or len(message) != PACKET_SIZE:
        raise NonsenseError(f"a hand sends {PACKET_SIZE} bytes at a time")
    *axes, arm, turns_jaw = _PACKET.unpack(message)
    if not all(math.isfinite(axis) and abs(axis) <= 1.0 + AXIS_SLACK for axis in axes):
        raise NonsenseError("a hand's axes are from -1 to 1")
    if arm >= arm_count or turns_jaw > 1:
        raise NonsenseError(f"arm {arm} of {arm_count}, jaw {turns_jaw}")
    right, away, out = axes
    return HandMotion((right, away, out), arm, bool(turns_jaw))


def read_report(message: object) -> DrawingReport | None:
    """How a browser draws; None where the message is another.

    Raises:
        NonsenseError: a rate that is none, a flag that is none.
    """
    if not isinstance(message, bytes) or len(message) != _REPORT.size:
        return None
    rate, counted, software = _REPORT.unpack(message)
    if not 0.0 <= rate <= RATE_MOST or counted > 1 or software > 1:
        raise NonsenseError(f"a browser that draws {rate} frames a second, counted {counted}, software {software}")
    return DrawingReport(rate if counted else None, bool(software))


def write_report(report: DrawingReport) -> bytes:
    """The packet that says how a browser draws."""
    return _REPORT.pack(report.rate or 0.0, report.rate is not None, report.software)


def write_hand(motion: HandMotion) -> bytes:
    """The packet that says a motion."""
    return _PACKET.pack(*motion.axes, motion.arm, motion.turns_jaw)
