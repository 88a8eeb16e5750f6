"""Packets of `hand.js`: what arrives of a motion, and what is refused."""

import math

import pytest

from surgsim_env.live.messages import HandMotion, InvalidMessageError, read_hand
from tests.live.packets import write_hand


def test_a_motion_arrives_as_it_was_sent():
    motion = HandMotion((0.5, -1.0, 0.25), 1, True)
    assert read_hand(write_hand(motion), arm_count=2) == motion


@pytest.mark.parametrize(
    "packet",
    [
        *("text", b"", b"0" * 17, write_hand(HandMotion((0.0, 0.0, 0.0), 1)), write_hand(HandMotion((0.0,) * 3, 0, 2))),
        *(write_hand(HandMotion((axis, 0.0, 0.0), 0)) for axis in (math.nan, math.inf, 1.5, -2.0)),
    ],
)
def test_an_invalid_packet_is_refused(packet):
    with pytest.raises(InvalidMessageError):
        read_hand(packet, arm_count=1)
