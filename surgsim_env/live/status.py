"""How a session goes, in words and figures."""

import html
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgsim_env.live.exchange_records import Phase
from surgsim_env.pacing import Timeliness

TITLES = {
    Phase.STARTING: "starting",
    Phase.RUNNING: "running",
    Phase.PAUSED: "paused",
    Phase.FAULT: "stopped by a fault: press Reset",
    Phase.ENDED: "ended",
}


def headline(frame: NDArray[Any]) -> str:
    """What a frame's physics is doing."""
    if frame["replaying"]:
        return "replaying"
    return "recording" if frame["recording"] else TITLES[Phase(int(frame["phase"]))]


def status_rows(
    frame: NDArray[Any], kept: Timeliness, *, skipped: int, fps: float, drawn: float | None, said: str
) -> list[tuple[str, str]]:
    """Names with values, as HTML.

    Args:
        frame: the newest.
        kept: how steps kept time since the last rows.
        skipped: steps since the session began.
        fps: pictures made [1/s].
        drawn: pictures that the slowest browser draws [1/s], where one says so.
        said: the page's own words, shown where the physics has none.
    """
    force = " / ".join(f"{float(np.linalg.norm(one)):.2f}" for one in frame["force"])
    rows = [
        ("force, left / right arm" if len(frame["force"]) > 1 else "force", f"{force} N"),
        ("simulated time", f"{float(frame['time']):.1f} s"),
        ("physics", f"{kept.rate:.0f} steps/s"),
        ("real-time factor", f"{kept.real_time:.3f}"),
        ("late, median / 99 %", f"{kept.late_p50 * 1e3:.2f} / {kept.late_p99 * 1e3:.2f} ms"),
        ("a step takes", f"{kept.spent_p50 * 1e3:.2f} ms"),
        ("steps skipped so far", f"{skipped}"),
        ("pictures", f"{fps:.0f} /s" + ("" if drawn is None else f" (browser {drawn:.0f})")),
    ]
    if float(frame["added_mass"]) > 0.0:
        rows.append(("mass added for the step", f"{float(frame['added_mass']) * 1e3:.1f} g"))
    words = bytes(frame["said"]).decode("utf-8", "replace") or said
    if words:
        rows.append(("", html.escape(words)))
    return rows
