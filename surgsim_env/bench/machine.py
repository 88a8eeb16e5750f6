"""The machine that a benchmark ran on, and the versions of what it ran."""

import os
import platform
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

PACKAGES = ("surgsim", "numpy", "scipy", "numba", "mujoco", "gymnasium", "newton", "warp-lang", "scikit-fem")


def core_count() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def processor() -> str:
    """The processor's name, as far as the system tells."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def version(package: str) -> str:
    """A package's version, or "absent"."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "absent"


def load() -> str:
    """How many processes wanted a core in the last minute: above 0 at the start, others were at work."""
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"


def describe(load_before: str) -> str:
    """Machine, versions and date, as a list in Markdown."""
    lines = [
        f"machine: {core_count()} cores of {processor()}, {platform.system()} {platform.machine()}",
        f"load average (1 min): {load_before} at the start, {load()} at the end; this run makes about 1 itself",
        f"Python {platform.python_version()}; " + ", ".join(f"{name} {version(name)}" for name in PACKAGES),
        f"date: {datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
    ]
    return "\n".join(f"* {line}" for line in lines)
