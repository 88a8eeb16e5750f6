"""Messages of a browser tab: viser's, filtered before viser decodes them, and the packets of `hand.js`."""

import math
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

# A dragged mouse sends about 60 messages a second, a slider as many.
RATE_MOST, BURST_MOST = 300.0, 600.0
# Pings and pongs: no page can send a ping, and a browser answers one of ours every 10 s.
CONTROL_RATE_MOST, CONTROL_BURST_MOST = 5.0, 50.0


class InvalidMessageError(ValueError):
    """A message that our own page never sends; states what is wrong with it. Its sender is disconnected."""


# ---- viser's messages ---------------------------------------------------------------------------------------------

# No scene is larger than 10 m; a camera may be farther away.
Coordinate = Annotated[float, Meta(ge=-10.0, le=10.0)]
Distant = Annotated[float, Meta(ge=-1e4, le=1e4)]
Unit = Annotated[float, Meta(ge=-1.001, le=1.001)]
Screen = Annotated[float, Meta(ge=-100.0, le=100.0)]
Pixels = Annotated[float, Meta(ge=0.0, le=1e5)]
Name = Annotated[str, Meta(max_length=200)]


# Fields as in viser._messages 1.1; the name of each class is the message's type.
class _Message(Struct, tag_field="type", forbid_unknown_fields=True, kw_only=True):
    excluded_self_client: None = None


class ViewerCameraMessage(_Message, kw_only=True):
    """Where the tab's camera is."""

    wxyz: tuple[Unit, Unit, Unit, Unit]
    position: tuple[Distant, Distant, Distant]
    look_at: tuple[Distant, Distant, Distant]
    up_direction: tuple[Distant, Distant, Distant]
    fov: Annotated[float, Meta(ge=0.0, le=3.2)]
    near: Annotated[float, Meta(ge=0.0, le=1e4)]
    far: Annotated[float, Meta(ge=0.0, le=1e6)]
    image_height: Pixels
    image_width: Pixels


class GuiUpdateMessage(_Message, kw_only=True):
    """An element of the panel is set."""

    uuid: Name
    updates: Annotated[dict[Name, Any], Meta(min_length=1, max_length=4)]


class _NodeMessage(_Message, kw_only=True):
    name: Name
    owner: Literal[""] = ""


class TransformControlsUpdateMessage(_NodeMessage, kw_only=True):
    """A handle is moved."""

    wxyz: tuple[Unit, Unit, Unit, Unit]
    position: tuple[Coordinate, Coordinate, Coordinate]


class TransformControlsDragStartMessage(_NodeMessage, kw_only=True):
    """A handle is grabbed."""


class TransformControlsDragEndMessage(_NodeMessage, kw_only=True):
    """A handle is released."""


class SceneNodeDragMessage(_NodeMessage, kw_only=True):
    """A part of the scene, such as the instrument, is dragged."""

    phase: Literal["start", "update", "end"]
    instance_index: None
    start_position: tuple[Distant, Distant, Distant]
    end_position: tuple[Distant, Distant, Distant]
    start_screen_pos: tuple[Screen, Screen]
    end_screen_pos: tuple[Screen, Screen]
    button: Literal["left", "middle", "right"]
    modifier: Name | None


_DECODER = msgspec.msgpack.Decoder(
    ViewerCameraMessage
    | GuiUpdateMessage
    | TransformControlsUpdateMessage
    | TransformControlsDragStartMessage
    | TransformControlsDragEndMessage
    | SceneNodeDragMessage
)


class RateLimit:
    """Limits what one client sends: a token bucket that fills at a rate up to a burst, by default of messages."""

    def __init__(
        self,
        rate: float = RATE_MOST,
        burst: float = BURST_MOST,
        what: str = "messages",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin with a full bucket.

        Args:
            rate: at which it fills [1/s].
            burst: that it holds.
            what: it counts, for the error.
            clock: tells the time [s].
        """
        self._rate, self._burst, self._what, self._clock = rate, burst, what, clock
        self._left, self._then = burst, clock()

    def count(self) -> None:
        """Count one.

        Raises:
            InvalidMessageError: the bucket is empty.
        """
        now = self._clock()
        self._left = min(self._burst, self._left + self._rate * (now - self._then)) - 1.0
        self._then = now
        if self._left < 0.0:
            raise InvalidMessageError(f"more than {self._rate:g} {self._what} a second")


@dataclass
class MessageFilter:
    """Decides which messages viser receives.

    Fields:
        values: type of the values that each element of the panel may take, by its uuid; `msgspec.convert` checks it
        nodes: nodes of the scene that may be dragged
        dropped: clients that were disconnected for an invalid message
        ignored: valid messages that set a value out of its range or an element that no longer exists
    """

    values: dict[str, Any] = field(default_factory=dict)
    nodes: set[str] = field(default_factory=set)
    dropped: int = 0
    ignored: int = 0

    def accepts(self, packed: Any) -> bool:
        """Whether viser receives a message; False where it is ignored.

        Raises:
            InvalidMessageError: not a message of our page.
        """
        if not isinstance(packed, bytes):
            raise InvalidMessageError("text where viser's page sends binary messages")
        try:
            message = _DECODER.decode(packed)
        except (ValueError, RecursionError) as error:
            raise InvalidMessageError(f"no message of this page: {error}") from None
        if self._is_allowed(message):
            return True
        self.ignored += 1
        return False

    def _is_allowed(self, message: _Message) -> bool:
        if isinstance(message, _NodeMessage):
            return message.name in self.nodes
        if not isinstance(message, GuiUpdateMessage):
            return True
        if message.uuid not in self.values or set(message.updates) != {"value"}:
            return False
        try:
            msgspec.convert(message.updates["value"], self.values[message.uuid])
        except msgspec.ValidationError:
            return False
        return True


# ---- packets of hand.js -------------------------------------------------------------------------------------------

HAND_PATH = "/hand"
# Little-endian: along the view's right, away from the viewer, out of the organ, each -1 to 1; the arm, 0 or 1; 1 to
# toggle its jaw, else 0.
_HAND = struct.Struct("<3fHH")
# Frames a second that the browser draws; 1 if it has counted them; 1 if it has no graphics card; else 0.
_DRAWING = struct.Struct("<fHH")
FRAME_RATE_MOST = 1000.0
AXIS_SLACK = 1e-6


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
