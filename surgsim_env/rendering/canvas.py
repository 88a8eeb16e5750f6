"""Pictures of a MuJoCo model that is not simulated, as a camera sees it: off screen or in a window."""

import threading
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgsim_env.rendering import gl
from surgsim_env.rendering.cameras import Camera

# One thread draws at a time.
LOCK = threading.RLock()
SHADOW_MAP = 2048


class Canvas:
    """A model in a graphics context, seen by its only camera.

    Fields:
        context: MuJoCo's, with the model's meshes
        drawn: the geoms of the current picture
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, gl_context: Any, *, more_geoms: int = 0, shadows: bool = False
    ) -> None:
        """Load a model; pictures are as large as its off-screen buffer and may have `more_geoms` than it.

        Raises:
            NoGLError: MuJoCo cannot draw with this context.
        """
        self.gl_context = gl_context
        self._model, self._data = model, data
        model.vis.quality.shadowsize = SHADOW_MAP if shadows else 0
        with gl.current(gl_context):
            try:
                self.context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
            except mujoco.FatalError as error:
                raise gl.NoGLError(f"OpenGL is there, but MuJoCo cannot draw with it: {error}") from error
        self.context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self.drawn = mujoco.MjvScene(model, model.ngeom + more_geoms)
        self.drawn.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        self.drawn.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._camera = mujoco.MjvCamera()
        self._camera.type, self._camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
        self._visible = mujoco.MjvOption()
        self._visible.geomgroup[:] = 1
        size = model.vis.global_
        self._rect = mujoco.MjrRect(0, 0, size.offwidth, size.offheight)

    def select(self) -> None:
        """Draw off screen from now on; to be called before meshes are uploaded."""
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.context)

    def look(self, camera: Camera, *, sky: bool = True) -> None:
        """Take the geoms as they are now, seen by a camera; without the sky a picture is quicker to draw."""
        data = self._data
        data.cam_xpos[0], data.cam_xmat[0] = camera.position, camera.rotation.ravel()
        self._model.cam_fovy[0] = camera.fov
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._visible, None, self._camera, everything, self.drawn)
        self.drawn.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = sky

    def colour(self) -> NDArray[np.uint8]:
        """The picture, shape (height, width, 3), its first row on top."""
        frame = np.empty((self._rect.height, self._rect.width, 3), dtype=np.uint8)
        mujoco.mjr_render(self._rect, self.drawn, self.context)
        mujoco.mjr_readPixels(frame, None, self._rect, self.context)
        return np.ascontiguousarray(frame[::-1])

    def numbers(self) -> NDArray[np.int32]:
        """The number of the geom (its `segid`) that each pixel shows, plus 1, 0 for none, shape (height, width)."""
        with _Numbered(self.drawn):
            frame = self.colour()
        return frame.astype(np.int32) @ np.array([1, 256, 65536], dtype=np.int32)

    def depth(self) -> NDArray[np.float32]:
        """Reversed depth of each pixel: 1 at the near plane, 0 at the far one and beyond, shape (height, width)."""
        depth = np.empty((self._rect.height, self._rect.width), dtype=np.float32)
        with _Numbered(self.drawn):
            mujoco.mjr_render(self._rect, self.drawn, self.context)
        mujoco.mjr_readPixels(None, depth, self._rect, self.context)
        return depth[::-1]

    def present(self, frame: NDArray[np.uint8]) -> None:
        """Copy a picture to the window that the context belongs to."""
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_WINDOW.value, self.context)
        mujoco.mjr_drawPixels(np.ascontiguousarray(frame[::-1]).ravel(), None, self._rect, self.context)

    def close(self) -> None:
        """Free what the graphics context holds."""
        with gl.current(self.gl_context):
            self.context.free()


class _Numbered:
    """Draw geoms in the colour of their number within this block."""

    def __init__(self, drawn: mujoco.MjvScene) -> None:
        self._drawn = drawn

    def __enter__(self) -> None:
        self._set(True)

    def __exit__(self, *_: object) -> None:
        self._set(False)

    def _set(self, numbered: bool) -> None:
        self._drawn.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = numbered
        self._drawn.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = numbered
