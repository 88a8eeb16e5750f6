"""Rendering of an environment: pictures or a window, by its render_mode."""

import ctypes.util
import os
import sys
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.material.regions import Lesion
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.rendering import gl
from surgsim_env.rendering.cameras import placed_endoscope
from surgsim_env.rendering.options import render_options
from surgsim_env.rendering.renderer import OrganRenderer
from surgsim_env.rendering.window import Window, WindowContext, require_display
from surgsim_env.scene.model import Endoscope
from surgsim_env.tasks.visibility import Disc

RENDER_MODES = ("human", "rgb_array")


@dataclass(frozen=True, eq=False)
class Shown:
    """Parts of an episode's picture that the simulation does not contain.

    Fields:
        lesions: hidden in the organ; shown where the options ask for them
        target: a disc to be drawn, None for none
        endoscope: pose of the endoscope; None: that of the scene
    """

    lesions: tuple[Lesion, ...] = ()
    target: Disc | None = None
    endoscope: Endoscope | None = None


class EpisodeView:
    """The pictures of one environment; OpenGL is loaded with the first of them."""

    def __init__(self, simulation: Simulation, render_mode: str | None, given: dict[str, Any]) -> None:
        """Check the mode and the options that were given; nothing is drawn yet.

        Raises:
            ValueError: an unknown mode or option, or an option's value that breaks its rule.
            NoGLError: a window is asked for and there is no display.
        """
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(f"render_mode {render_mode!r} is unknown; the modes are None, {', '.join(RENDER_MODES)}")
        if render_mode == "human":
            require_display()
        self.mode = render_mode
        self.options = render_options(given)
        self._simulation = simulation
        self._renderer: OrganRenderer | None = None
        self._window: Window | None = None

    def metadata(self) -> dict[str, Any]:
        """Gymnasium's metadata: the modes that this machine offers (and the current one), and one picture a step."""
        modes = [mode for mode in RENDER_MODES if mode == self.mode or mode in offered_modes()]
        return {"render_modes": modes, "render_fps": round(1.0 / self._simulation.anatomy.scene.timing.control_step)}

    def renderer(self, shown: Shown) -> OrganRenderer:
        """The renderer, with the lesions, target and endoscope of an episode."""
        if self._renderer is None:
            self._renderer = OrganRenderer(self._simulation, self.options)
        self._renderer.lesions = shown.lesions
        self._renderer.target = shown.target
        if shown.endoscope is not None:
            self._renderer.cameras["endoscope"] = placed_endoscope(self._simulation.anatomy, shown.endoscope)
        return self._renderer

    def frame(self, shown: Shown) -> NDArray[np.uint8]:
        """The picture of the current state, shape (height, width, 3)."""
        return self.renderer(shown).rgb()

    def show(self, shown: Shown) -> None:
        """Show the current state in the window, which opens at the first call."""
        if self._window is None:
            context = WindowContext("surgsim", self.options.width, self.options.height)
            self._renderer = OrganRenderer(self._simulation, self.options, gl_context=context)
            period = self._simulation.anatomy.scene.timing.control_step
            self._window = Window(self._renderer, context, period)
        self.renderer(shown)
        self._window.show()

    @property
    def window(self) -> Window | None:
        """The live window, None until it is open."""
        return self._window

    def close(self) -> None:
        """Close window and renderer; may be called more than once."""
        if self._window is not None:
            self._window.close()
        if self._renderer is not None:
            self._renderer.close()


def offered_modes() -> list[str]:
    """The render modes that this machine offers, as far as is known without loading OpenGL."""
    switched_on = os.environ.get(gl.VARIABLE, "").lower().strip() not in gl.SWITCHED_OFF
    offered = {"human": switched_on and gl.has_display(), "rgb_array": switched_on and _has_library()}
    return [mode for mode in RENDER_MODES if offered[mode]]


@cache
def _has_library() -> bool:
    """Whether the library is installed that draws without a display."""
    return not sys.platform.startswith("linux") or ctypes.util.find_library("EGL") is not None
