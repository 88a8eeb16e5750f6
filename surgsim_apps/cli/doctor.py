"""`surgsim doctor`: platform of this installation, a self-test, and missing packages by feature."""

import os
import platform
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

import numpy as np
from packaging.requirements import Requirement
from rich.console import Console
from rich.table import Table
from rich.text import Text

from msdm_core.kernels import advance_substeps
from msdm_core.numba_cache import FOLDER_PREFIX
from surgsim_apps.bench.report import processor, registers
from surgsim_env.coupling import Simulation, core_count, mujoco_library
from surgsim_env.palpation import SitePress, press_alone, press_phases
from surgsim_env.rendering import gl
from surgsim_env.scene import load_anatomy, make_scene

# Feature of each extra of the package; `dev` is for its own tests.
FEATURES = {
    "agents": "training and scoring of agents (agents/, surgsim evaluate)",
    "bench": "other simulators in `surgsim bench`",
    "demonstrations": "recorded demonstrations (agents/record_demonstrations.py)",
    "docs": "the documentation site (make docs)",
    "live": "the live page (surgsim view)",
    "patient": "label images of scans (surgsim organ)",
    "pettingzoo": "two agents for the bimanual retraction",
    "tetwild": "surgsim organ --mesher tetwild",
    "video": "films of episodes",
}
# The self-test presses the middle of the top of this scene's healthy organ: the force on the tip [N], and the largest
# relative difference by rounding in libraries of other versions.
SCENE = "phantom_small"
PRESS_FORCE = 0.2264375432524341
FORCE_TOLERANCE = 1e-6

State = Literal["ok", "missing", "broken"]
COLOURS: dict[State, str] = {"ok": "green", "missing": "yellow", "broken": "bold red"}


@dataclass(frozen=True)
class Finding:
    """A row of the report: subject, its state and a text."""

    subject: str
    state: State
    text: str


@dataclass(frozen=True)
class Doctor:
    """Check this installation, a row for each part: ok, missing (a feature is not available) or broken."""

    def run(self, console: Console) -> int:
        """Print the findings; returns 1 if a part is broken."""
        rows = list(findings())
        table = Table("part", "status", "finding", show_lines=True)
        for finding in rows:
            table.add_row(finding.subject, Text(finding.state, COLOURS[finding.state]), Text(finding.text))
        console.print(table)
        return int(any(finding.state == "broken" for finding in rows))


def findings() -> Iterator[Finding]:
    """All findings, in the order of the report."""
    for check in (interpreter, cores, opengl, cache, loop, press):
        yield attempted(check)
    yield from packages()


def attempted(check: Callable[[], Finding]) -> Finding:
    """The finding of a check; broken if it raises an error."""
    try:
        return check()
    except Exception as error:  # any failure on this machine is a finding
        return Finding(check.__name__, "broken", f"{type(error).__name__}: {' '.join(str(error).split())}")


def interpreter() -> Finding:
    """Python, its place and the system."""
    text = f"{platform.python_version()} ({sys.executable}), {platform.system()} {platform.machine()}"
    return Finding("Python", "ok", text)


def cores() -> Finding:
    """Cores and vector registers."""
    return Finding("processor", "ok", f"{core_count()} cores of {processor()}; {registers()}")


def opengl() -> Finding:
    """Rendering of pictures, and its renderer."""
    try:
        context = gl.context()
    except gl.NoGLError as error:
        return Finding("OpenGL", "missing", f"pictures of environments: {error}")
    context.make_current()
    from OpenGL import GL

    renderer = GL.glGetString(GL.GL_RENDERER)
    return Finding("OpenGL", "ok", renderer.decode() if renderer else "a renderer without a name")


def cache() -> Finding:
    """The folder of compiled code."""
    path = advance_substeps.stats.cache_path
    assert path is not None, "advance_substeps is declared with cache=True"
    place = Path(path).parents[1]
    files = [file for folder in place.glob(f"{FOLDER_PREFIX}*") for file in folder.rglob("*.nb[ic]")]
    text = f"{place}, {sum(file.stat().st_size for file in files) / 1e6:.0f} MB"
    try:
        tempfile.TemporaryFile(dir=place).close()
    except OSError as error:
        way_out = "what is compiled is lost at the end; make it writable or set NUMBA_CACHE_DIR"
        return Finding("compiled code", "missing", f"{text}, cannot be written ({error.strerror}): {way_out}")
    return Finding("compiled code", "ok", f"{text}, writable")


def loop() -> Finding:
    """Haptic steps, compiled or in Python."""
    if reason := mujoco_library.missing():
        return Finding("haptic steps", "missing", f"the compiled loop; they run in Python, more slowly: {reason}")
    if mujoco_library.runs_compiled():
        return Finding("haptic steps", "ok", "compiled, MuJoCo's included")
    chosen = os.environ[mujoco_library.LOOP_VARIABLE]
    return Finding("haptic steps", "ok", f"in Python, because {mujoco_library.LOOP_VARIABLE}={chosen}")


def press() -> Finding:
    """A press, compared with the stored force."""
    scene = make_scene(SCENE)
    simulation = Simulation(load_anatomy(scene))
    low, high = simulation.rest_position.min(axis=0), simulation.rest_position.max(axis=0)
    middle = np.array([*(low + high)[:2] / 2.0, high[2]])
    result = press_alone(SitePress(simulation, middle, np.array([0.0, 0.0, 1.0])), press_phases(scene))
    force = float(result.force[2])
    text = result.fault or f"{force:.6f} N at {result.depth * 1e3:.3f} mm"
    if result.fault or abs(force - PRESS_FORCE) > FORCE_TOLERANCE * PRESS_FORCE:
        return Finding("self-test", "broken", f"a press gives {text}; it must be {PRESS_FORCE:.6f} N")
    return Finding("self-test", "ok", f"a press gives {text}, as stored")


def packages() -> Iterator[Finding]:
    """Required packages, and missing ones of each extra."""
    try:
        required = [Requirement(text) for text in metadata.requires("surgsim") or []]
    except metadata.PackageNotFoundError:
        yield Finding("packages", "missing", "surgsim is not installed, and runs from a checkout: pip install -e .")
        return
    always = [item for item in required if applies(item, "")]
    wrong = [text for item in always if (text := lack(item))]
    versions = ", ".join(f"{item.name} {metadata.version(item.name)}" for item in always if not lack(item))
    way_out = f"; {', '.join(wrong)}: pip install surgsim again" if wrong else ""
    yield Finding(
        "packages", "broken" if wrong else "ok", f"surgsim {metadata.version('surgsim')}, {versions}{way_out}"
    )
    for extra, feature in FEATURES.items():
        lacking = [text for item in required if applies(item, extra) and item not in always and (text := lack(item))]
        if lacking:
            yield Finding(extra, "missing", f"{feature}: {', '.join(lacking)}: pip install 'surgsim[{extra}]'")
        else:
            yield Finding(extra, "ok", feature)


def applies(requirement: Requirement, extra: str) -> bool:
    """True if a requirement holds on this machine with an extra, or without one ("")."""
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def lack(requirement: Requirement) -> str:
    """Fault of a required package, or ""."""
    try:
        version = metadata.version(requirement.name)
    except metadata.PackageNotFoundError:
        return f"{requirement.name} is not installed"
    if requirement.specifier.contains(version, prereleases=True):
        return ""
    return f"{requirement.name} is {version}, the rule is {requirement.specifier}"
