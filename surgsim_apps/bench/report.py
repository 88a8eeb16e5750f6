"""The report of a benchmark run: figures in sections, their machine."""

import os
import platform
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import numpy as np

from msdm_core.kernels import GROUP, lane_counts, register_bits
from surgsim_env.coupling import core_count
from surgsim_env.scene import PHYSICS_VERSION

PACKAGES = ("surgsim", "numpy", "scipy", "numba", "mujoco", "gymnasium", "newton", "warp-lang", "scikit-fem")


class AbsentError(Exception):
    """An impossible measurement, such as a peer without an installation; the message gives the reason."""


def processor() -> str:
    """The processor's name, from the system if it is known there."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def registers() -> str:
    """Vector registers of compiled code on this machine, and their contents."""
    doubles, singles = (" or ".join(map(str, lane_counts(dtype))) for dtype in (np.float64, np.float32))
    return (
        f"vector registers of {register_bits()} bits; {GROUP} springs or tets of an organ alone at a time, or one of "
        f"{doubles} organs in float64, {singles} in float32"
    )


def version(package: str) -> str:
    """A package's version, or "absent"."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "absent"


def load() -> str:
    """Load average over the last minute: above 0 at the start, other processes were running."""
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"


def describe(load_before: str) -> str:
    """Machine, versions and date, as a list in Markdown."""
    lines = [
        f"machine: {core_count()} cores of {processor()}, {platform.system()} {platform.machine()}",
        registers(),
        f"load average (1 min): {load_before} at the start, {load()} at the end; this run makes about 1 itself",
        f"physics {PHYSICS_VERSION}",
        f"Python {platform.python_version()}; " + ", ".join(f"{name} {version(name)}" for name in PACKAGES),
        f"date: {datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
    ]
    return "\n".join(f"* {line}" for line in lines)


@dataclass(frozen=True)
class Figure:
    """One number with its case, quantity and unit; None for an impossible measurement, with the reason in `note`."""

    case: str
    quantity: str
    value: float | None
    unit: str
    note: str = ""

    @property
    def text(self) -> str:
        """The value with four digits, or "absent"."""
        return "absent" if self.value is None else f"{self.value:.4g}"


@dataclass(frozen=True)
class Section:
    """A part of the report: a short key, a heading, the method, the figures, and a closing text."""

    key: str
    heading: str
    method: str
    figures: list[Figure] = field(default_factory=list)
    closing: str = ""

    def markdown(self) -> str:
        """Method, and a table: cases down, quantities across, notes last."""
        cases = list(dict.fromkeys(figure.case for figure in self.figures))
        columns = list(dict.fromkeys((figure.quantity, figure.unit) for figure in self.figures))
        noted = any(figure.note for figure in self.figures)
        headings = ["", *(f"{quantity} [{unit}]" for quantity, unit in columns), *(["note"] if noted else [])]
        lines = [self.method + "\n"]
        if self.figures:
            lines += ["| " + " | ".join(headings) + " |", "|---|" + "---:|" * len(columns) + "---|" * noted]
        for case in cases:
            own = [figure for figure in self.figures if figure.case == case]
            by_column = {(figure.quantity, figure.unit): figure.text for figure in own}
            texts = [case, *(by_column.get(column, "") for column in columns)]
            if noted:
                parts = [part for figure in own if figure.note for part in figure.note.split("; ")]
                texts.append("; ".join(dict.fromkeys(parts)))
            lines.append("| " + " | ".join(text.replace("|", "\\|") for text in texts) + " |")
        return "\n".join(lines) + (f"\n\n{self.closing}" if self.closing else "") + "\n"


def absent(case: str, quantity: str, unit: str, reason: object) -> Figure:
    """A figure without a measurement, with the reason in one line."""
    return Figure(case, quantity, None, unit, " ".join(str(reason).split()))
