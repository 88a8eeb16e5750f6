"""A picture of a trace: contact force and depth over time, with the steps of the script marked."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from surgsim_env.scripting.trace import Trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FORCE, DEPTH, INK, BAND = "#b5322a", "#2b5f8a", "#20242c", "#eef1f5"
# A step's name is written upright where it has less than this share of the run's time.
NARROW = 0.12


def write_picture(trace: Trace, path: Path) -> None:
    """Write the picture of a trace to a file; its ending says which kind."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 5.6), dpi=110, facecolor="white", layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.25, 1.0))
    draw(trace, upper, lower)
    figure.savefig(path)


def draw(trace: Trace, force: Axes, depth: Axes) -> None:
    """Draw the force [N] into one pair of axes and the depth [mm] into another, the steps as bands with names."""
    if "visible" in trace.info:
        _draw_retraction(trace, force, depth)
        return
    force.plot(trace.haptic_time, trace.force_size, color=FORCE, linewidth=1.3)
    force.set_ylabel("contact force [N]")
    force.set_ylim(0.0, max(1.15 * trace.peak_force, 0.01))
    depth.plot(trace.haptic_time, trace.depth * 1e3, color=DEPTH, linewidth=1.3)
    depth.axhline(0.0, color=INK, linewidth=0.6, linestyle=":")
    depth.set_ylabel("depth past contact [mm]")
    depth.set_xlabel("time since the reset [s]")
    if len(trace.haptic_time):
        depth.set_xlim(trace.start, float(trace.haptic_time[-1]))
    _mark_steps(trace, force, depth)
    if trace.failure:
        force.set_xlabel(trace.failure, color=FORCE, fontsize=8, wrap=True)


def _draw_retraction(trace: Trace, force: Axes, seen: Axes) -> None:
    """What the jaw holds and pulls with [N], and the share of the target that is seen [%]."""
    grip, pull, share = (
        np.array([info[name] for info in trace.infos]) for name in ("grip_force", "pull_force", "visible")
    )
    force.plot(trace.control_time, grip, color=DEPTH, linewidth=1.3, label="grip, the weaker pad")
    force.plot(trace.control_time, pull, color=FORCE, linewidth=1.3, label="pull")
    force.set_ylabel("force [N]")
    force.set_ylim(0.0, 1.15 * max(float(grip.max()), float(pull.max()), 0.01))
    force.legend(loc="upper left", frameon=False)
    seen.plot(trace.control_time, 100.0 * share, color=INK, linewidth=1.3)
    seen.set_ylabel("target seen [%]")
    seen.set_ylim(-3.0, 103.0)
    seen.set_xlabel("time since the reset [s]")
    seen.set_xlim(trace.start, float(trace.control_time[-1]))
    _mark_steps(trace, force, seen)
    if trace.failure:
        force.set_xlabel(trace.failure, color=FORCE, fontsize=8, wrap=True)


def _mark_steps(trace: Trace, force: Axes, depth: Axes) -> None:
    for index, step in enumerate(trace.steps):
        for axes in (force, depth):
            axes.axvspan(step.start, step.end, facecolor=BAND if index % 2 else "white", edgecolor="none", zorder=0)
        narrow = step.end - step.start < NARROW * trace.duration
        force.annotate(
            step.name,
            ((step.start + step.end) / 2.0, 1.0),
            xycoords=force.get_xaxis_transform(),
            xytext=(0.0, 4.0),
            textcoords="offset points",
            rotation=60.0 if narrow else 0.0,
            rotation_mode="anchor",
            horizontalalignment="left" if narrow else "center",
            verticalalignment="bottom",
            color=INK,
            fontsize=9,
            annotation_clip=False,
        )
