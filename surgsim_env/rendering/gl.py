"""OpenGL, loaded with the first picture: one context for all pictures of this process."""

import importlib
import os
import sys
from functools import cache
from typing import Any

# MuJoCo's environment variable, its values for no OpenGL and for the system's own, the module of each kind of context.
VARIABLE = "MUJOCO_GL"
SWITCHED_OFF = ("disable", "disabled", "off", "false", "0")
SWITCHED_ON = ("", "enable", "enabled", "on", "true", "1")
MODULES = {"egl": "mujoco.egl", "osmesa": "mujoco.osmesa", "glfw": "mujoco.glfw", "glx": "mujoco.glfw"}
# Variables for the number of EGL's device, and for the library of PyOpenGL.
DEVICE, PLATFORM = "MUJOCO_EGL_DEVICE_ID", "PYOPENGL_PLATFORM"

# Environment variables that name a display for windows.
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")


class NoGLError(RuntimeError):
    """There is no OpenGL; the message names the missing packages, or the environment variable that is wrong."""


def has_display() -> bool:
    """True if a window can be opened, by the environment variables."""
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in DISPLAYS)


def context() -> Any:
    """Context of this process for drawing off screen, created at the first call.

    Raises:
        NoGLError: it cannot be created (names the packages or the variable), or the process was forked from one with
            a context.
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
    return _make_context(chosen_kind()), os.getpid()


def chosen_kind() -> str:
    """Kind of context named by MUJOCO_GL; EGL on Linux if it is unset, since that needs no display.

    Raises:
        NoGLError: it switches OpenGL off, or has a value that MuJoCo does not know.
    """
    kind = os.environ.get(VARIABLE, "").lower().strip()
    if kind in SWITCHED_OFF:
        raise NoGLError(f"{VARIABLE} is {kind!r}, which switches OpenGL off: unset it, or set {VARIABLE}=egl")
    if kind in MODULES:
        return kind
    if not sys.platform.startswith("linux"):
        return ""
    if kind not in SWITCHED_ON:
        raise NoGLError(
            f"{VARIABLE} is {kind!r}; it must be one of {', '.join(MODULES)}: unset it, or set {VARIABLE}=egl"
        )
    return "egl"


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
    failed = f"no OpenGL through {kind.upper() or 'the system'} ({type(error).__name__}: {error}): "
    platform, device = os.environ.get(PLATFORM, kind), os.environ.get(DEVICE)
    if kind in ("egl", "osmesa") and platform.lower() != kind:
        return f"{failed}{PLATFORM} is {platform!r}: unset it"
    # A library that is missing fails before the device is asked for.
    if kind == "egl" and device is not None and MODULES[kind] in sys.modules:
        return f"{failed}{DEVICE} is {device!r}: unset it, or give the number of a device"
    return (
        f"{failed}pictures without a display need EGL; on Debian "
        "and Ubuntu `apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri` (no graphics card is needed), and leave "
        f"{VARIABLE} unset or set {VARIABLE}=egl"
    )
