"""Which messages viser receives: those of our page pass, all others are refused before viser decodes them."""

import math
from typing import Annotated, Literal

import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from surgsim_env.live.messages import (
    BURST_MOST,
    RATE_MOST,
    HandMotion,
    InvalidMessageError,
    MessageFilter,
    RateLimit,
    read_hand,
)
from surgsim_env.live.protocol_client import CAMERA, hand_message
from tests.live.packets import write_hand

SLIDER, BOX, LIST = "slider-1", "box-1", "list-1"
DRAG = {
    **{"type": "SceneNodeDragMessage", "phase": "start", "name": "/instrument/0", "instance_index": None},
    **{"start_position": [0.0, 0.0, 0.0], "start_screen_pos": [0.1, 0.2], "end_position": [0.0, 1.0, 0.0]},
    **{"end_screen_pos": [0.3, 0.4], "button": "left", "modifier": None, "owner": ""},
}
UPDATE = {
    "type": "TransformControlsUpdateMessage",
    "name": "/hand/0",
    "wxyz": [1, 0, 0, 0],
    "position": [0, 0, 1],
    "owner": "",
}


def made_filter() -> MessageFilter:
    values = {SLIDER: Annotated[float, msgspec.Meta(ge=0.5, le=2.0)], BOX: bool, LIST: Literal["none", "hidden"]}
    return MessageFilter(values, {"/hand/0", "/instrument/0"})


def packed(fields) -> bytes:
    return msgspec.msgpack.encode(fields)


def setting(uuid, value) -> dict:
    return {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}


@pytest.mark.parametrize(
    "fields",
    [
        *(CAMERA, DRAG, UPDATE, {"type": "TransformControlsDragStartMessage", "name": "/hand/0", "owner": ""}),
        *(setting(SLIDER, 1.5), setting(SLIDER, 1), setting(BOX, True), setting(LIST, "none")),
    ],
)
def test_our_own_messages_pass(fields):
    assert made_filter().accepts(packed(fields))


def test_what_a_client_of_ours_sends_passes():
    assert made_filter().accepts(hand_message(np.array([0.01, 0.0, 0.2])))


@pytest.mark.parametrize(
    "fields",
    [
        *(setting(SLIDER, 2.5), setting(SLIDER, True), setting(SLIDER, "1"), setting(SLIDER, math.nan)),
        *(setting(BOX, 1), setting(LIST, "both"), setting(LIST, 0), setting("gone", 1.0)),
        *({**setting(SLIDER, 1.0), "updates": {"label": "evil"}}, {**UPDATE, "name": "/organ"}, {**DRAG, "name": "/x"}),
    ],
)
def test_values_out_of_range_are_ignored(fields):
    message_filter = made_filter()
    assert not message_filter.accepts(packed(fields))
    assert message_filter.ignored == 1


@pytest.mark.parametrize(
    "fields",
    [
        *({"type": "ShareUrlRequest"}, {"type": "ShareUrlDisconnect"}, {"type": "RunJavascriptMessage", "source": "1"}),
        *({"type": "GuiFormDirtyMessage", "uuid": "x"}, {"type": "ScenePointerMessage"}, {"type": "Message"}),
        *({"type": "FileTransferStartUpload"}, {"type": 3}, {"type": None}, {}, [], None, 3, "text", [[[]]]),
        *(
            {**UPDATE, "position": [0, math.nan, 0]},
            {**UPDATE, "position": [0, math.inf, 0]},
            {**UPDATE, "position": [0, 0]},
        ),
        *({**UPDATE, "position": "far"}, {**UPDATE, "position": [1e30, 0, 0]}, {**UPDATE, "wxyz": [9, 0, 0, 0]}),
        *({**UPDATE, "position": [True, 0, 0]}, {**UPDATE, "more": 1}, {**UPDATE, "name": 3}, {**UPDATE, "owner": "x"}),
        *({**UPDATE, "name": "x" * 300}, {**CAMERA, "fov": math.nan}, {**CAMERA, "position": ["a", "b", "c"]}),
        *({key: value for key, value in CAMERA.items() if key != "fov"}, {**DRAG, "phase": "again"}),
        *({**DRAG, "instance_index": -1}, {**DRAG, "button": "other"}, {**CAMERA, "excluded_self_client": 1}),
        *({"type": "GuiUpdateMessage", "uuid": SLIDER, "updates": {}}, {"type": "GuiUpdateMessage", "uuid": SLIDER}),
    ],
)
def test_an_invalid_message_disconnects_its_sender(fields):
    with pytest.raises(InvalidMessageError):
        made_filter().accepts(packed(fields))


@pytest.mark.parametrize(
    "raw", [b"", b"\xc1", b"\x81", b"\xff" * 100, b"\x91" * 5000, "text", b"\x81\xa4type\xa3\xff\xfe\xfd"]
)
def test_bytes_that_are_not_messagepack_disconnect_their_sender(raw):
    with pytest.raises(InvalidMessageError):
        made_filter().accepts(raw)


JUNK = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=5)
    | st.binary(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


@settings(max_examples=150, deadline=None)
@given(st.binary(max_size=200) | JUNK.map(packed))
@example(b"\xdd\xff\xff\xff\xff")
def test_any_other_bytes_raise_the_one_error(raw):
    with pytest.raises(InvalidMessageError):
        made_filter().accepts(raw)


@settings(max_examples=150, deadline=None)
@given(st.sampled_from([CAMERA, DRAG, UPDATE, setting(SLIDER, 1.0)]), st.data())
def test_what_passes_is_finite_and_whole(fields, data):
    """Our messages with some field replaced: whatever is let through has only known names and finite numbers."""
    fields = dict(fields)
    fields[data.draw(st.sampled_from(sorted(set(fields) - {"type"})))] = data.draw(JUNK)
    message_filter = made_filter()
    try:
        passed = message_filter.accepts(packed(fields))
    except InvalidMessageError:
        return
    if passed and "position" in fields:
        assert all(math.isfinite(value) for value in fields["position"])
    if passed and "updates" in fields:
        assert 0.5 <= fields["updates"]["value"] <= 2.0 or fields["uuid"] == BOX


def test_a_flood_is_stopped_and_a_hand_is_not():
    now = [0.0]
    pace = RateLimit(clock=lambda: now[0])
    for _ in range(int(BURST_MOST)):
        pace.count()
    with pytest.raises(InvalidMessageError, match="messages a second"):
        pace.count()
    pace = RateLimit(clock=lambda: now[0])
    for _ in range(5000):
        now[0] += 1.0 / 120.0
        pace.count()
    assert RATE_MOST > 120


def test_hands_say_what_they_mean():
    motion = HandMotion((0.5, -1.0, 0.25), 1, True)
    assert read_hand(write_hand(motion), arm_count=2) == motion
    with pytest.raises(InvalidMessageError, match="arm 1 of 1"):
        read_hand(write_hand(motion), arm_count=1)


@given(st.binary(max_size=40))
def test_no_hand_moves_faster_than_its_full_speed(raw):
    try:
        motion = read_hand(raw, arm_count=2)
    except InvalidMessageError:
        return
    assert len(raw) == 16 and motion.arm < 2
    assert all(math.isfinite(axis) and abs(axis) <= 1.001 for axis in motion.axes)


@pytest.mark.parametrize("axes", [(math.nan, 0.0, 0.0), (math.inf, 0.0, 0.0), (0.0, 1.5, 0.0), (0.0, 0.0, -2.0)])
def test_hands_beyond_reason_are_nonsense(axes):
    with pytest.raises(InvalidMessageError):
        read_hand(write_hand(HandMotion(axes, 0)), arm_count=1)
