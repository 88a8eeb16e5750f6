"""OpenGL, loaded when the first picture is asked for: one context for all pictures of this process."""

import atexit
import contextlib
import importlib
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any

# What MuJoCo understands: the variable, its values that mean "no OpenGL", and the module of each kind of context.
VARIABLE = "MUJOCO_GL"
SWITCHED_OFF = ("disable", "disabled", "off", "false", "0")
MODULES = {"egl": "mujoco.egl", "osmesa": "mujoco.osmesa", "glfw": "mujoco.glfw", "glx": "mujoco.glfw"}

# What says where windows go.
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")

_context: Any = None
_owner = 0


class NoGLError(RuntimeError):
    """There is no OpenGL to draw with; the message says what is missing and how to get it."""


def import_mujoco() -> None:
    """Import MuJoCo, which loads OpenGL at once where MUJOCO_GL says so, and fails where that is missing.

    Raises:
        ImportError: names the packages that are missing.
    """
    try:
        importlib.import_module("mujoco")
    except Exception as error:  # what a missing library raises differs from library to library
        kind = os.environ.get(VARIABLE, "").lower().strip()
        if kind not in MODULES:
            raise
        raise ImportError(f"{VARIABLE} is {kind!r}, but there is {no_gl_message(kind, error)}") from error


def has_display() -> bool:
    """Whether a window can be opened, as far as the environment says."""
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in DISPLAYS)


def context() -> Any:
    """This process's context for drawing off screen, made at the first call.

    Raises:
        NoGLError: it cannot be had; names the packages that are missing.
    """
    global _context, _owner
    if _context is None:
        _context = _make_context(_kind())
        _owner = os.getpid()
    elif _owner != os.getpid():
        raise NoGLError(
            "this process was forked from one that had already drawn, and OpenGL does not survive a fork: start "
            'workers with AsyncVectorEnv(..., context="forkserver"), or draw nothing before they start'
        )
    return _context


@contextlib.contextmanager
def current(gl_context: Any) -> Iterator[None]:
    """Draw with a context, and leave the one that was there before as it was."""
    if hasattr(gl_context, "as_current"):
        with gl_context.as_current():
            yield
    else:
        gl_context.make_current()
        yield


def at_exit(close: Callable[[], None]) -> None:
    """Call `close` when the interpreter ends, while OpenGL is still there."""
    atexit.register(close)


def _kind() -> str:
    """What MUJOCO_GL asks for; where it is not set, EGL on Linux, which needs no display."""
    asked = os.environ.get(VARIABLE, "").lower().strip()
    if asked in SWITCHED_OFF:
        raise NoGLError(f"{VARIABLE} is {asked!r}, which switches OpenGL off: unset it, or set {VARIABLE}=egl")
    if asked in MODULES:
        return asked
    return "egl" if sys.platform.startswith("linux") else ""


def _make_context(kind: str) -> Any:
    try:
        if kind in ("glfw", "glx") and not has_display():
            raise NoGLError(f"{' and '.join(DISPLAYS)} are not set")
        module = importlib.import_module(MODULES.get(kind, "mujoco.gl_context"))
        # EGL asks for no size, the others make a window that is never shown.
        return module.GLContext(64, 64)
    except Exception as error:  # what a missing library raises differs from library to library
        raise NoGLError(no_gl_message(kind, error)) from error


def no_gl_message(kind: str, error: Exception) -> str:
    """What to do where a kind of context could not be made."""
    cause = f"{type(error).__name__}: {error}"
    if kind in ("glfw", "glx"):
        return f"no OpenGL through GLFW ({cause}): it needs a display; without one unset {VARIABLE} or set it to egl"
    if kind == "osmesa":
        return f"no OpenGL through OSMesa ({cause}): install libosmesa6, or set {VARIABLE}=egl"
    return (
        f"no OpenGL through {kind.upper() or 'the system'} ({cause}): pictures without a display need EGL; on Debian "
        "and Ubuntu `apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri` (no graphics card is needed), and leave "
        f"{VARIABLE} unset or set {VARIABLE}=egl"
    )
