"""Packets of `hand.js`: what arrives of a motion."""

from surgsim_apps.live.messages import HandMotion, read_hand
from tests.live.packets import write_hand


def test_a_motion_arrives_as_it_was_sent():
    motion = HandMotion((0.5, -1.0, 0.25), 1, True)
    assert read_hand(write_hand(motion)) == motion
