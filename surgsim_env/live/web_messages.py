"""Which messages of a web page viser gets to see: of few kinds, whole, finite, within the range of what they set."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import msgspec.msgpack

# A mouse that is dragged sends some 60 a second, a slider as many.
RATE_MOST, BURST_MOST = 300.0, 600.0
# No scene is as large as this [m]; a camera may be farther away.
PLACE_MOST, CAMERA_MOST = 10.0, 1e4
NAME_MOST = 200

Value = Callable[[Any], bool]


class NonsenseError(ValueError):
    """A message that no page of ours sends; says what is wrong with it."""


class Pace:
    """How fast one client may send: a bucket that fills at RATE_MOST a second, up to BURST_MOST."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin with a full bucket."""
        self._clock, self._left, self._then = clock, BURST_MOST, clock()

    def count(self) -> None:
        """Take one message out; NonsenseError where there is none left."""
        now = self._clock()
        self._left = min(BURST_MOST, self._left + RATE_MOST * (now - self._then)) - 1.0
        self._then = now
        if self._left < 0.0:
            raise NonsenseError(f"more than {RATE_MOST:g} messages a second")


@dataclass
class Judge:
    """What the page may set, and the messages that may set it.

    Fields:
        values: what each element of the panel may be set to, by its uuid
        nodes: the scene's nodes that may be dragged
        dropped: clients that were sent away for nonsense
        ignored: messages of our own page's kind that set something out of its range, or that is gone
    """

    values: dict[str, Value] = field(default_factory=dict)
    nodes: set[str] = field(default_factory=set)
    dropped: int = 0
    ignored: int = 0

    def new_pace(self) -> Pace:
        """Of one client."""
        return Pace()

    def lets_through(self, message: Any) -> bool:
        """Whether viser gets a message; False where it is ignored.

        Raises:
            NonsenseError: no message of ours; its sender is to be sent away.
        """
        if not isinstance(message, bytes):
            raise NonsenseError("text where viser's page sends binary messages")
        try:
            fields = msgspec.msgpack.decode(message)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, ValueError) as error:
            raise NonsenseError(f"no MessagePack: {error}") from None
        if not isinstance(fields, dict) or not isinstance(kind := fields.pop("type", None), str):
            raise NonsenseError("a message without a type")
        rule = _RULES.get(kind)
        if rule is None:
            raise NonsenseError(f"a message of type {kind[:40]!r}")
        if not all(isinstance(name, str) for name in fields) or not rule.required <= set(fields) <= rule.known:
            raise NonsenseError(f"{kind} with other fields than {', '.join(sorted(rule.known))}")
        for name, value in fields.items():
            if not rule.fields[name](value):
                raise NonsenseError(f"{kind} with {name} that is not one")
        if rule.allowed(self, fields):
            return True
        self.ignored += 1
        return False

    def sets_value(self, fields: dict[str, Any]) -> bool:
        """Whether an update is of an element that we know, to a value that it may have."""
        allowed = self.values.get(fields["uuid"])
        return allowed is not None and set(fields["updates"]) == {"value"} and allowed(fields["updates"]["value"])

    def drags(self, fields: dict[str, Any]) -> bool:
        """Whether a node of ours is dragged."""
        return fields["name"] in self.nodes


def is_number(low: float, high: float) -> Value:
    """Whether something is a finite number in a range; no bool."""

    def check(value: Any) -> bool:
        return type(value) in (int, float) and math.isfinite(value) and low <= value <= high

    return check


def is_flag(value: Any) -> bool:
    """Whether something is True or False."""
    return type(value) is bool


def is_one_of(*choices: str) -> Value:
    """Whether something is one of some texts."""
    return lambda value: isinstance(value, str) and value in choices


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= NAME_MOST


def _is_vector(length: int, most: float) -> Value:
    number = is_number(-most, most)
    return lambda value: isinstance(value, list) and len(value) == length and all(map(number, value))


def _is_update(value: Any) -> bool:
    return isinstance(value, dict) and 0 < len(value) <= 4 and all(_is_text(name) for name in value)


def _is_nothing_or(check: Value) -> Value:
    return lambda value: value is None or check(value)


@dataclass(frozen=True)
class _Rule:
    fields: dict[str, Value]
    allowed: Callable[[Judge, dict[str, Any]], bool] = lambda judge, fields: True
    optional: frozenset[str] = frozenset()

    @property
    def known(self) -> set[str]:
        return set(self.fields)

    @property
    def required(self) -> set[str]:
        return set(self.fields) - self.optional


_OWNED = frozenset({"owner", "excluded_self_client"})
_owner: dict[str, Value] = {"owner": is_one_of(""), "excluded_self_client": lambda value: value is None}
_place, _screen, _turn = _is_vector(3, PLACE_MOST), _is_vector(2, 100.0), _is_vector(4, 1.0 + 1e-3)
_far, _pixels = _is_vector(3, CAMERA_MOST), is_number(0, 100_000)

# Fields as in viser._messages 1.1.
_RULES = {
    "ViewerCameraMessage": _Rule(
        {
            **{"wxyz": _turn, "position": _far, "look_at": _far, "up_direction": _far},
            **{"fov": is_number(0.0, 3.2), "near": is_number(0.0, CAMERA_MOST), "far": is_number(0.0, 1e6)},
            **{"image_height": _pixels, "image_width": _pixels, "excluded_self_client": lambda value: value is None},
        },
        optional=frozenset({"excluded_self_client"}),
    ),
    "GuiUpdateMessage": _Rule(
        {"uuid": _is_text, "updates": _is_update, "excluded_self_client": lambda value: value is None},
        Judge.sets_value,
        frozenset({"excluded_self_client"}),
    ),
    "TransformControlsUpdateMessage": _Rule(
        {"name": _is_text, "wxyz": _turn, "position": _place, **_owner}, Judge.drags, _OWNED
    ),
    "TransformControlsDragStartMessage": _Rule({"name": _is_text, **_owner}, Judge.drags, _OWNED),
    "TransformControlsDragEndMessage": _Rule({"name": _is_text, **_owner}, Judge.drags, _OWNED),
    "SceneNodeDragMessage": _Rule(
        {
            **{"phase": is_one_of("start", "update", "end"), "name": _is_text, **_owner},
            **{"instance_index": lambda value: value is None, "start_position": _far, "end_position": _far},
            **{"start_screen_pos": _screen, "end_screen_pos": _screen, "button": is_one_of("left", "middle", "right")},
            "modifier": _is_nothing_or(_is_text),
        },
        Judge.drags,
        _OWNED,
    ),
}
