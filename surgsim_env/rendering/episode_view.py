"""Rendering of an environment by its render_mode: pictures or a live window."""

import ctypes.util
import sys
import time
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.material.regions import Lesion
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.rendering import gl
from surgsim_env.rendering.cameras import placed_endoscope
from surgsim_env.rendering.looks import Look
from surgsim_env.rendering.options import CAMERAS, render_options
from surgsim_env.scene.load import require_known
from surgsim_env.scene.model import Endoscope
from surgsim_env.tasks.visibility import Disc

if TYPE_CHECKING:
    from surgsim_env.rendering.renderer import OrganRenderer

RENDER_MODES = ("human", "rgb_array")


class WindowContext:
    """A GLFW window as a graphics context."""

    def __init__(self, title: str, width: int, height: int) -> None:
        """Open the window.

        Raises:
            NoGLError: there is no display, or no OpenGL on it.
        """
        import glfw

        self._glfw = glfw
        if not glfw.init():
            raise gl.NoGLError(
                'GLFW finds no display to open a window on: use render_mode="rgb_array", which needs none'
            )
        glfw.window_hint(glfw.RESIZABLE, False)
        self.handle = glfw.create_window(width, height, title, None, None)
        if not self.handle:
            raise gl.NoGLError('GLFW could not open a window with OpenGL: use render_mode="rgb_array" instead')
        self.make_current()
        glfw.swap_interval(0)

    def make_current(self) -> None:
        """Make the window's context current."""
        self._glfw.make_context_current(self.handle)

    def free(self) -> None:
        """Close the window."""
        self._glfw.destroy_window(self.handle)


class Window:
    """Window with a renderer's pictures at the rate of control steps; once closed, it stays closed."""

    def __init__(self, renderer: "OrganRenderer", context: WindowContext, period: float) -> None:
        """Attach to an open window; `period` is the shortest time between two pictures [s]."""
        self._renderer, self._context, self._period = renderer, context, period
        self._camera_name = renderer.options.camera
        self._next = time.monotonic()
        self.closed = False
        glfw, handle = context._glfw, context.handle
        glfw.set_key_callback(handle, lambda _, key, __, action, ___: self._key(key, action))

    def show(self) -> None:
        """Draw the current state and wait until the next picture is due."""
        glfw, handle = self._context._glfw, self._context.handle
        if self.closed:
            return
        glfw.poll_events()
        if glfw.window_should_close(handle):
            self.close()
            return
        frame = self._renderer.rgb(self._camera_name)
        self._renderer.present(frame)
        self._context.make_current()
        glfw.swap_buffers(handle)
        time.sleep(max(0.0, self._next - time.monotonic()))
        self._next = max(self._next, time.monotonic() - self._period) + self._period

    def close(self) -> None:
        """Close the window; may be called more than once."""
        if not self.closed:
            self.closed = True
            self._renderer.close()
            self._context.free()

    def _key(self, key: Any, action: Any) -> None:
        glfw = self._context._glfw
        if action == glfw.PRESS and key == glfw.KEY_C:
            self._camera_name = CAMERAS[(CAMERAS.index(self._camera_name) + 1) % len(CAMERAS)]
        if action == glfw.PRESS and key == glfw.KEY_ESCAPE:
            glfw.set_window_should_close(self._context.handle, True)


@dataclass(frozen=True, eq=False)
class Shown:
    """Parts of an episode's picture beyond the simulation.

    Fields:
        lesions: hidden in the organ; shown if the options ask for them
        target: a disc, None for none
        endoscope: pose of the endoscope; None: that of the scene
        look: of the pictures; None: the scene's own
        moment: number of the episode's step
    """

    lesions: tuple[Lesion, ...] = ()
    target: Disc | None = None
    endoscope: Endoscope | None = None
    look: Look | None = None
    moment: int = 0


class EpisodeView:
    """Pictures of one environment; OpenGL is loaded with the first.

    Fields:
        mode, options: render mode and picture options
        window: the live window, None until it is open
    """

    def __init__(self, simulation: Simulation, render_mode: str | None, options: dict[str, Any]) -> None:
        """Check mode and options; nothing is drawn yet.

        Raises:
            ValueError: an unknown mode or option, or an option's value that breaks its rule.
            NoGLError: a window is asked for and there is no display.
        """
        if render_mode is not None:
            require_known("render_mode", render_mode, RENDER_MODES)
        if render_mode == "human" and not gl.has_display():
            raise gl.NoGLError(
                f'render_mode "human" opens a window, and there is no display ({" and ".join(gl.DISPLAYS)} are not '
                'set): use render_mode="rgb_array", which needs none'
            )
        self.mode = render_mode
        self.options = render_options(options)
        self._simulation = simulation
        self._renderer: OrganRenderer | None = None
        self.window: Window | None = None

    def metadata(self) -> dict[str, Any]:
        """Gymnasium's metadata: the machine's render modes (and the current one), and one picture a step."""
        modes = [mode for mode in RENDER_MODES if mode == self.mode or mode in offered_modes()]
        return {"render_modes": modes, "render_fps": round(1.0 / self._simulation.anatomy.scene.timing.control_step)}

    def renderer(self, shown: Shown) -> "OrganRenderer":
        """Renderer with the lesions, target, look and endoscope of an episode."""
        if self._renderer is None:
            self._renderer = self._new_renderer()
        self._renderer.follow_anatomy()
        self._renderer.lesions = shown.lesions
        self._renderer.target = shown.target
        self._renderer.look, self._renderer.moment = shown.look, shown.moment
        if shown.endoscope is not None:
            self._renderer.cameras["endoscope"] = placed_endoscope(self._simulation.anatomy, shown.endoscope)
        return self._renderer

    def frame(self, shown: Shown) -> NDArray[np.uint8]:
        """Picture of the current state, shape (height, width, 3)."""
        return self.renderer(shown).rgb()

    def show(self, shown: Shown) -> None:
        """Show the current state in the window; the first call opens it."""
        if self.window is None:
            context = WindowContext("surgsim", self.options.width, self.options.height)
            self._renderer = self._new_renderer(context)
            period = self._simulation.anatomy.scene.timing.control_step
            self.window = Window(self._renderer, context, period)
        self.renderer(shown)
        self.window.show()

    def _new_renderer(self, context: WindowContext | None = None) -> "OrganRenderer":
        """Renderer into a window's context or off screen; imported here, since most episodes draw nothing."""
        from surgsim_env.rendering.renderer import OrganRenderer

        return OrganRenderer(self._simulation, self.options, gl_context=context)

    def close(self) -> None:
        """Close window and renderer; may be called more than once."""
        if self.window is not None:
            self.window.close()
        if self._renderer is not None:
            self._renderer.close()


def offered_modes() -> list[str]:
    """Render modes of this machine, as far as is known without loading OpenGL."""
    try:
        gl.chosen_kind()
    except gl.NoGLError:
        return []
    available = {"human": gl.has_display(), "rgb_array": _has_library()}
    return [mode for mode in RENDER_MODES if available[mode]]


@cache
def _has_library() -> bool:
    """True if the library for drawing without a display is installed."""
    return not sys.platform.startswith("linux") or ctypes.util.find_library("EGL") is not None
