"""The packets that `hand.js` sends."""

from surgsim_env.live import messages


def write_report(report: messages.DrawingReport) -> bytes:
    return messages._DRAWING.pack(report.rate or 0.0, report.rate is not None, report.software)


def write_hand(motion: messages.HandMotion) -> bytes:
    return messages._HAND.pack(*motion.axes, motion.arm, motion.turns_jaw)
