"""The packets that `hand.js` sends."""

import struct

from surgsim_env.live.messages import DrawingReport, HandMotion


def write_report(report: DrawingReport) -> bytes:
    return struct.pack("<fHH", report.rate or 0.0, report.rate is not None, report.software)


def write_hand(motion: HandMotion) -> bytes:
    return struct.pack("<3fHH", *motion.axes, motion.arm, motion.turns_jaw)
