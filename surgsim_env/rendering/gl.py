"""OpenGL, loaded with the first picture: one context for all pictures of this process."""

import importlib
import os
import sys
from functools import cache
from typing import Any

# MuJoCo's variable, its values that switch OpenGL off, and the module of each kind of context.
VARIABLE = "MUJOCO_GL"
SWITCHED_OFF = ("disable", "disabled", "off", "false", "0")
MODULES = {"egl": "mujoco.egl", "osmesa": "mujoco.osmesa", "glfw": "mujoco.glfw", "glx": "mujoco.glfw"}

# Variables of the environment that name a display for windows.
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")


class NoGLError(RuntimeError):
    """There is no OpenGL; the message says what is missing and how to install it."""


def has_display() -> bool:
    """Whether a window can be opened, by the environment's variables."""
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in DISPLAYS)


def context() -> Any:
    """This process's context for drawing off screen, made at the first call.

    Raises:
        NoGLError: it cannot be made; names the packages that are missing.
    """
    made, owner = _first_context()
    if owner != os.getpid():
        raise NoGLError(
            "this process was forked from one that had already drawn, and OpenGL does not survive a fork: start "
            'workers with AsyncVectorEnv(..., context="forkserver"), or draw nothing before they start'
        )
    return made


@cache
def _first_context() -> tuple[Any, int]:
    """The context, and the id of the process that made it."""
    return _make_context(_kind()), os.getpid()


def _kind() -> str:
    """The kind of context that MUJOCO_GL names; if it is unset, EGL on Linux, which needs no display."""
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
    except Exception as error:  # each library raises another error where it is missing
        raise NoGLError(no_gl_message(kind, error)) from error


def no_gl_message(kind: str, error: Exception) -> str:
    """Message for a kind of context that could not be made, with the way out."""
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
