"""The live window of render_mode "human": the picture of an `OrganRenderer`, turned and zoomed with the mouse."""

import contextlib
import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.rendering.cameras import Camera
from surgsim_env.rendering.gl import DISPLAYS, NoGLError, has_display
from surgsim_env.rendering.options import CAMERAS
from surgsim_env.rendering.renderer import OrganRenderer

# Rotation of the view for each pixel of a drag [rad], and factor of the distance for each notch of the wheel.
TURN, ZOOM = 0.008, 0.9
# Smallest angle between the view and the vertical [rad].
POLE = 0.05
# Keys that a task may read; GLFW's code of a key is that of its letter.
PLAYING_KEYS = "ADEFQRSW "
KEYS = "drag: turn, wheel: zoom, C: next camera, Esc: close"


def require_display() -> None:
    """Raise a NoGLError if there is no display for a window."""
    if not has_display():
        raise NoGLError(
            f'render_mode "human" opens a window, and there is no display ({" and ".join(DISPLAYS)} are not set): use '
            'render_mode="rgb_array", which needs none'
        )


class WindowContext:
    """A GLFW window as a graphics context."""

    def __init__(self, title: str, width: int, height: int) -> None:
        """Open it.

        Raises:
            NoGLError: there is no display, or no OpenGL on it.
        """
        require_display()
        import glfw

        self._glfw = glfw
        if not glfw.init():
            raise NoGLError('GLFW finds no display to open a window on: use render_mode="rgb_array", which needs none')
        glfw.window_hint(glfw.RESIZABLE, False)
        self.handle = glfw.create_window(width, height, title, None, None)
        if not self.handle:
            raise NoGLError('GLFW could not open a window with OpenGL: use render_mode="rgb_array" instead')
        with self.as_current():
            glfw.swap_interval(0)

    @contextlib.contextmanager
    def as_current(self) -> Iterator[None]:
        """Make the window's context current within this block."""
        self._glfw.make_context_current(self.handle)
        yield

    def free(self) -> None:
        """Close the window."""
        self._glfw.destroy_window(self.handle)


class Window:
    """A window with a renderer's pictures at the rate of control steps; once closed, it stays closed."""

    def __init__(self, renderer: OrganRenderer, context: WindowContext, period: float) -> None:
        """Attach to an open window; a period [s] at least lies between two pictures."""
        self._renderer, self._context, self._period = renderer, context, period
        self._camera_name = renderer.options.camera
        self._turn, self._zoom = np.zeros(2), 1.0
        self._cursor: FloatArray | None = None
        self._next = time.monotonic()
        self.closed = False
        glfw, handle = context._glfw, context.handle
        glfw.set_scroll_callback(handle, lambda _, __, notches: self._wheel(notches))
        glfw.set_key_callback(handle, lambda _, key, __, action, ___: self._key(key, action))

    def show(self) -> None:
        """Draw the current state, and wait until the next picture is due."""
        glfw, handle = self._context._glfw, self._context.handle
        if self.closed:
            return
        glfw.poll_events()
        if glfw.window_should_close(handle):
            self.close()
            return
        self._drag()
        frame = self._renderer.rgb(self._camera())
        self._renderer.present(frame)
        with self._context.as_current():
            glfw.swap_buffers(handle)
        time.sleep(max(0.0, self._next - time.monotonic()))
        self._next = max(self._next, time.monotonic() - self._period) + self._period

    def held_keys(self) -> str:
        """Capital letters and space of the keys that were held down at the last picture; none in a closed window."""
        glfw, handle = self._context._glfw, self._context.handle
        if self.closed:
            return ""
        return "".join(key for key in PLAYING_KEYS if glfw.get_key(handle, ord(key)) == glfw.PRESS)

    def close(self) -> None:
        """Close the window; may be called more than once."""
        if not self.closed:
            self.closed = True
            self._renderer.close()
            self._context.free()

    def _camera(self) -> Camera:
        around, over = self._turn.tolist()
        return orbited(self._renderer.cameras[self._camera_name], around, over, self._zoom)

    def _drag(self) -> None:
        glfw, handle = self._context._glfw, self._context.handle
        cursor = np.array(glfw.get_cursor_pos(handle))
        if self._cursor is not None and glfw.get_mouse_button(handle, glfw.MOUSE_BUTTON_LEFT) == glfw.PRESS:
            self._turn += TURN * (cursor - self._cursor)
        self._cursor = cursor

    def _wheel(self, notches: float) -> None:
        self._zoom = float(np.clip(self._zoom * ZOOM**notches, 0.2, 5.0))

    def _key(self, key: Any, action: Any) -> None:
        glfw = self._context._glfw
        if action == glfw.PRESS and key == glfw.KEY_C:
            self._camera_name = CAMERAS[(CAMERAS.index(self._camera_name) + 1) % len(CAMERAS)]
            self._turn, self._zoom = np.zeros(2), 1.0
        if action == glfw.PRESS and key == glfw.KEY_ESCAPE:
            glfw.set_window_should_close(self._context.handle, True)


def orbited(camera: Camera, around: float, over: float, zoom: float) -> Camera:
    """A camera turned about its target: around the upright axis and over it [rad], its distance times `zoom`."""
    offset, up = camera.position - camera.target, camera.up
    height = math.asin(float(np.clip(offset @ up / np.linalg.norm(offset), -1.0, 1.0)))
    level = np.cross(up, camera.rotation[:, 0]) * -1.0
    side = np.cross(up, level)
    tilt = float(np.clip(height + over, POLE - 0.5 * math.pi, 0.5 * math.pi - POLE))
    direction = level * math.cos(around) - side * math.sin(around)
    raised = direction * math.cos(tilt) + up * math.sin(tilt)
    distance = zoom * float(np.linalg.norm(offset))
    return Camera.looking(camera.target + distance * raised, camera.target, up, camera.fov)
