"""OpenGL, loaded with the first picture: one context for all pictures of this process."""

import importlib
import os
import sys
from functools import cache
from typing import Any

# MuJoCo's environment variable, its values for no OpenGL, and the module of each kind of context.
VARIABLE = "MUJOCO_GL"
SWITCHED_OFF = ("disable", "disabled", "off", "false", "0")
MODULES = {"egl": "mujoco.egl", "osmesa": "mujoco.osmesa", "glfw": "mujoco.glfw", "glx": "mujoco.glfw"}

# Environment variables that name a display for windows.
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")


class NoGLError(RuntimeError):
    """There is no OpenGL; the message names the missing packages and their installation."""


def has_display() -> bool:
    """True if a window can be opened, by the environment variables."""
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in DISPLAYS)


def context() -> Any:
    """Context of this process for drawing off screen, created at the first call.

    Raises:
        NoGLError: it cannot be created (names the missing packages), or the process was forked from one with a context.
    """
    gl_context, owner = _first_context()
    if owner != os.getpid():
        raise NoGLError(
            "this process was forked from one that had already drawn, and OpenGL does not survive a fork: start "
            'workers with AsyncVectorEnv(..., context="forkserver"), or draw nothing before they start'
        )
    return gl_context


@cache
def _first_context() -> tuple[Any, int]:
    """Context and the id of its process."""
    return _make_context(_kind()), os.getpid()


def _kind() -> str:
    """Kind of context named by MUJOCO_GL; EGL on Linux if it is unset, since that needs no display."""
    kind = os.environ.get(VARIABLE, "").lower().strip()
    if kind in SWITCHED_OFF:
        raise NoGLError(f"{VARIABLE} is {kind!r}, which switches OpenGL off: unset it, or set {VARIABLE}=egl")
    if kind in MODULES:
        return kind
    return "egl" if sys.platform.startswith("linux") else ""


def _make_context(kind: str) -> Any:
    try:
        if kind in ("glfw", "glx") and not has_display():
            raise NoGLError(f"{' and '.join(DISPLAYS)} are not set")
        module = importlib.import_module(MODULES.get(kind, "mujoco.gl_context"))
        # A size for the hidden window of other kinds than EGL.
        return module.GLContext(64, 64)
    except Exception as error:  # each missing library raises its own type
        raise NoGLError(no_gl_message(kind, error)) from error


def no_gl_message(kind: str, error: Exception) -> str:
    """Message for a failed kind of context, with the remedy."""
    cause = f"{type(error).__name__}: {error}"
    return (
        f"no OpenGL through {kind.upper() or 'the system'} ({cause}): pictures without a display need EGL; on Debian "
        "and Ubuntu `apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri` (no graphics card is needed), and leave "
        f"{VARIABLE} unset or set {VARIABLE}=egl"
    )
