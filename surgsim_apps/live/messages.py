"""Packets of the page's scripts: keys or a gamepad, the buttons over the picture, a browser's drawing in software."""

import struct
from dataclasses import dataclass

# Little-endian: along the view's right, away from the viewer, out of the organ, each -1 to 1; the arm, 0 or 1; 1 to
# toggle its jaw, else 0.
_HAND = struct.Struct("<3fHH")
# The packets of a browser without a graphics card, and of the buttons of `overlay.js`.
SOFTWARE, SEARCH, MARK, WATCH = b"software", b"search", b"mark", b"watch"


@dataclass(frozen=True)
class HandMotion:
    """Direction of keys or a gamepad: right, away and out, each -1 to 1; its arm; True to toggle the jaw."""

    axes: tuple[float, float, float]
    arm: int
    turns_jaw: bool = False


def read_hand(message: bytes) -> HandMotion:
    """The motion in a packet."""
    right, away, out, arm, turns_jaw = _HAND.unpack(message)
    return HandMotion((right, away, out), arm, bool(turns_jaw))
