"""The packets that `hand.js` sends."""

import struct

from surgsim_apps.live.messages import HandMotion


def write_hand(motion: HandMotion) -> bytes:
    return struct.pack("<3fHH", *motion.axes, motion.arm, motion.turns_jaw)
