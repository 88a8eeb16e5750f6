"""Scene in a graphics context: upload of moving shapes, drawing of colour, depth and labels."""

import atexit
import contextlib
import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.rendering import gl
from surgsim_env.rendering.abdomen import abdomen
from surgsim_env.rendering.cameras import Camera
from surgsim_env.rendering.drawn_look import DrawnLook
from surgsim_env.rendering.embedding import boundary_surface, organ_surface
from surgsim_env.rendering.endoscopic import EndoscopicShading
from surgsim_env.rendering.looks import Look
from surgsim_env.rendering.options import RenderOptions
from surgsim_env.rendering.scene_model import (
    ABDOMEN,
    DRAPE_GROUP,
    FAR,
    LESION_COLOUR,
    NEAR,
    PREFIX,
    SCENERY_GROUP,
    TRANSLUCENT,
    build_scene,
)
from surgsim_env.rendering.surface import TRIANGLES_MOST, Shape
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.tasks.visibility import Disc

# One thread draws at a time.
LOCK = threading.RLock()
# Labels of pixels.
LABELS = {"background": 0, "organ": 1, "instrument": 2, "lesion": 3, "target": 4}
# Labels of the scene's meshes.
MESH_LABELS = dict.fromkeys(("organ", "held", "section"), LABELS["organ"]) | {"section_lesion": LABELS["lesion"]}
# Largest number of lesions in a picture; they and a target are geoms beyond the model's.
LESIONS_MOST = 100
# Pixels for each triangle of the organ, at least: halves the time of small pictures.
PIXELS_OF_TRIANGLE = 4
# Groups of geoms in plain pictures, and in endoscopic ones before the abdomen.
PLAIN_GROUPS, FRONT_GROUPS = (0, 1, 2, 3, DRAPE_GROUP), (0, 1, 2, 3)
# Largest number of cameras of which a stage keeps pictures of the abdomen; a place that no camera sees.
SCENERIES_MOST, BEYOND = 8, 1e6
# Thickness of a drawn target [m], all of it below the disc itself.
TARGET_THICKNESS = 2e-4

_stages: dict[tuple, "Stage"] = {}


class Canvas:
    """Model in a graphics context, seen by its only camera.

    Fields:
        context: MuJoCo's, with the model's meshes
        drawn: the geoms of the current picture
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, gl_context: Any, *, more_geoms: int = 0) -> None:
        """Load a model; pictures have the size of its off-screen buffer and up to `more_geoms` further geoms.

        Raises:
            NoGLError: MuJoCo cannot draw with this context.
        """
        self.gl_context = gl_context
        self._model, self._data = model, data
        model.vis.quality.shadowsize = 0
        gl_context.make_current()
        try:
            self.context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except mujoco.FatalError as error:
            raise gl.NoGLError(f"OpenGL is there, but MuJoCo cannot draw with it: {error}") from error
        self.context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self.drawn = mujoco.MjvScene(model, model.ngeom + more_geoms)
        self.drawn.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self.drawn.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._camera = mujoco.MjvCamera()
        self._camera.type, self._camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
        self._visible = mujoco.MjvOption()
        size = model.vis.global_
        self._rect = mujoco.MjrRect(0, 0, size.offwidth, size.offheight)

    def select(self) -> None:
        """Draw off screen from now on; call before uploading meshes."""
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.context)

    def look(self, camera: Camera, *, sky: bool = True, groups: Sequence[int] = PLAIN_GROUPS) -> None:
        """Take the current geoms of some groups, seen by a camera; without the sky drawing is faster."""
        self._visible.geomgroup[:] = 0
        self._visible.geomgroup[list(groups)] = 1
        data = self._data
        data.cam_xpos[0], data.cam_xmat[0] = camera.position, camera.rotation.ravel()
        self._model.cam_fovy[0] = camera.fov
        categories = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._visible, None, self._camera, categories, self.drawn)
        self.drawn.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = sky

    def colour(self) -> NDArray[np.uint8]:
        """Picture, shape (height, width, 3), its first row on top."""
        frame = np.empty((self._rect.height, self._rect.width, 3), dtype=np.uint8)
        mujoco.mjr_render(self._rect, self.drawn, self.context)
        mujoco.mjr_readPixels(frame, None, self._rect, self.context)
        return np.ascontiguousarray(frame[::-1])

    def layer(self) -> NDArray[np.uint8]:
        """Picture before nothing, with the covered share of each pixel (height, width, 4), its first row on top."""
        from OpenGL import GL

        context, size = self.context, (self._rect.width, self._rect.height)
        mujoco.mjr_render(self._rect, self.drawn, context)
        if context.offSamples:
            GL.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, context.offFBO_r)
            GL.glBlitFramebuffer(0, 0, *size, 0, 0, *size, GL.GL_COLOR_BUFFER_BIT, GL.GL_NEAREST)
            GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, context.offFBO_r)
        frame = np.empty((*size[::-1], 4), dtype=np.uint8)
        GL.glReadPixels(0, 0, *size, GL.GL_RGBA, GL.GL_UNSIGNED_BYTE, frame)
        self.select()
        return frame[::-1]

    def numbers(self) -> NDArray[np.int32]:
        """Number of the geom at each pixel (its `segid` plus 1, 0 for none), shape (height, width)."""
        with self._numbered():
            frame = self.colour()
        return frame.astype(np.int32) @ np.array([1, 256, 65536], dtype=np.int32)

    def depth(self) -> NDArray[np.float32]:
        """Reversed depth of each pixel: 1 at the near plane, 0 at the far one and beyond, shape (height, width)."""
        depth = np.empty((self._rect.height, self._rect.width), dtype=np.float32)
        with self._numbered():
            mujoco.mjr_render(self._rect, self.drawn, self.context)
        mujoco.mjr_readPixels(None, depth, self._rect, self.context)
        return depth[::-1]

    def present(self, frame: NDArray[np.uint8]) -> None:
        """Copy a picture to the context's window."""
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_WINDOW.value, self.context)
        mujoco.mjr_drawPixels(np.ascontiguousarray(frame[::-1]).ravel(), None, self._rect, self.context)

    def close(self) -> None:
        """Free the graphics context's memory."""
        self.gl_context.make_current()
        self.context.free()

    @contextlib.contextmanager
    def _numbered(self) -> Iterator[None]:
        """Draw each geom in the colour of its number within the block."""
        segment, number = mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR
        self.drawn.flags[segment] = self.drawn.flags[number] = True
        try:
            yield
        finally:
            self.drawn.flags[segment] = self.drawn.flags[number] = False


class Stage:
    """Drawn scene of an anatomy in a graphics context."""

    def __init__(self, anatomy: Anatomy, instrument: mujoco.MjModel, options: RenderOptions, gl_context: Any) -> None:
        """Compile the scene and load it into a context."""
        self.users = 0
        # A section cuts tets, so a cut-open view draws their boundary: the two meet.
        most = min(TRIANGLES_MOST, options.width * options.height // PIXELS_OF_TRIANGLE)
        self.surface = boundary_surface(anatomy, most) if options.cut_away else organ_surface(anatomy, most)
        self.scene = build_scene(anatomy, self.surface, instrument, options)
        self.canvas = Canvas(self.scene.model, self.scene.data, gl_context, more_geoms=LESIONS_MOST + 1)
        self._look = DrawnLook(self.scene, self.canvas.context, options)
        self.style = options.style
        self._shading: EndoscopicShading | None = None
        self._is_seen_through = options.show_lesion
        self._sceneries: dict[tuple, tuple[NDArray[np.uint8], float]] = {}
        if self.style == "endoscopic":
            self._shading = EndoscopicShading(options.width, options.height)
            self.canvas.select()
            self.scene.meshes[ABDOMEN].upload(abdomen(anatomy, self.scene.ground), self.canvas.context)
        # Labels of geoms beyond the model's, by their numbers in the picture.
        self._added: dict[int, int] = {}

    def show(
        self,
        camera: Camera,
        shapes: dict[str, Shape],
        instrument: mujoco.MjData,
        lesions: Sequence[tuple[FloatArray, FloatArray]],
        target: Disc | None,
        look: Look | None = None,
        *,
        in_colour: bool = True,
    ) -> None:
        """Upload the shapes and poses of a picture and aim its camera.

        Args:
            camera: of the picture.
            shapes: surface and cut faces by their names in the scene.
            instrument: the instrument's data, read only.
            lesions: centre [m] (3,) and half axes [m] (3,) of each solid lesion.
            target: a disc, None for none.
            look: of the picture; None: the scene's own.
            in_colour: in the style of the stage; False: depth and labels are of the plain scene in every style.
        """
        if self._shading is not None and in_colour:
            self._background, self._aim = self._scenery(camera, self._shading)
        self._look.put_on(look)
        self.scene.instrument.pose(instrument, self.scene.data)
        self.canvas.select()
        for name, shape in shapes.items():
            self.scene.meshes[name].upload(shape, self.canvas.context)
        is_plain = self._shading is None
        self.canvas.look(
            camera,
            sky=is_plain and (look is not None or camera.sees_above_level()),
            groups=PLAIN_GROUPS if is_plain or not in_colour else FRONT_GROUPS,
        )
        self._added.clear()
        for centre, half_axes in lesions[:LESIONS_MOST]:
            self._add(mujoco.mjtGeom.mjGEOM_ELLIPSOID, half_axes, centre, np.eye(3), LESION_COLOUR, "lesion")
        if target is not None:
            size = np.array([target.radius, 0.5 * TARGET_THICKNESS, 0.0])
            centre = target.centre - 0.5 * TARGET_THICKNESS * target.normal
            self._add(mujoco.mjtGeom.mjGEOM_CYLINDER, size, centre, target.rotation, self._look.target_colour, "target")

    def colour(self) -> NDArray[np.uint8]:
        """Picture in the style of the stage, shape (height, width, 3)."""
        if self._shading is None:
            return self.canvas.colour()
        with self._shading.used("tissue", self._aim):
            front = self.canvas.layer()
            frame = over(front, self._background)
            if not self._is_seen_through:
                return frame
            drawn = self.canvas.drawn
            hidden = {self.scene.meshes[name].geom for name in ("organ", "held")}
            for geom in drawn.geoms[: drawn.ngeom]:
                if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.objid in hidden:
                    geom.pos[:] = BEYOND
            inside = over(self.canvas.layer(), frame)
        # Lesions shine through the organ, and nothing beyond it does.
        return np.rint(TRANSLUCENT * frame + (1.0 - TRANSLUCENT) * inside).astype(np.uint8)

    def _scenery(self, camera: Camera, shading: EndoscopicShading) -> tuple[NDArray[np.uint8], float]:
        """Picture of the abdomen alone, kept for each camera; distance of the aim [m]."""
        key = camera.position.tobytes(), camera.rotation.tobytes(), camera.fov
        if key not in self._sceneries:
            if len(self._sceneries) == SCENERIES_MOST:
                self._sceneries.pop(next(iter(self._sceneries)))
            aim = float(np.linalg.norm(camera.target - camera.position))
            self.canvas.select()
            self.canvas.look(camera, sky=False, groups=[SCENERY_GROUP])
            with shading.used("scenery", aim):
                self._sceneries[key] = self.canvas.colour(), aim
        return self._sceneries[key]

    def depth(self) -> NDArray[np.float32]:
        """Distance from the camera's plane [m], infinite for background, shape (height, width)."""
        # 1 / z is linear in the reversed depth.
        raw = self.canvas.depth().astype(np.float64)
        inverse = 1.0 / FAR + raw * (1.0 / NEAR - 1.0 / FAR)
        return np.where(raw > 0.0, 1.0 / inverse, np.inf).astype(np.float32)

    def labels(self) -> NDArray[np.uint8]:
        """Label of each pixel by LABELS, solid lesions also through the organ, shape (height, width)."""
        shown = self._labels()
        if LABELS["lesion"] in self._added.values():
            organ = [self.scene.meshes[name] for name in ("organ", "held")]
            for mesh in organ:
                mesh.show(False, self.canvas.context)
            inside = self._labels()
            for mesh in organ:
                mesh.show(True, self.canvas.context)
            shown[(shown == LABELS["organ"]) & (inside == LABELS["lesion"])] = LABELS["lesion"]
        return shown

    def close(self) -> None:
        """Free the graphics context's memory."""
        self.canvas.close()
        if self._shading is not None:
            self._shading.free()

    def _labels(self) -> NDArray[np.uint8]:
        numbers, drawn = self.canvas.numbers(), self.canvas.drawn
        table = np.zeros(drawn.ngeom + 1, dtype=np.uint8)
        for geom in drawn.geoms[: drawn.ngeom]:
            if geom.segid >= 0:
                table[geom.segid + 1] = self._label(geom)
        return table[numbers]

    def _label(self, geom: Any) -> int:
        if geom.objtype != mujoco.mjtObj.mjOBJ_GEOM:
            return self._added[geom.segid]
        name = self.scene.model.geom(geom.objid).name
        return LABELS["instrument"] if name.startswith(PREFIX) else MESH_LABELS.get(name, LABELS["background"])

    def _add(
        self, kind: mujoco.mjtGeom, size: FloatArray, centre: FloatArray, rotation: FloatArray,
        colour: tuple[float, float, float], label: str,
    ) -> None:  # fmt: skip
        """Add a geom beyond the model's to the picture."""
        drawn = self.canvas.drawn
        geom = drawn.geoms[drawn.ngeom]
        mujoco.mjv_initGeom(geom, kind, size, centre, rotation.ravel(), np.array([*colour, 1.0], dtype=np.float32))
        geom.specular, geom.shininess = 0.35, 0.5
        # mjv_initGeom does not set these, and the memory is not initialised.
        geom.objtype, geom.objid, geom.category = mujoco.mjtObj.mjOBJ_UNKNOWN, -1, mujoco.mjtCatBit.mjCAT_DECOR
        geom.segid = drawn.ngeom
        self._added[drawn.ngeom] = LABELS[label]
        drawn.ngeom += 1


def over(front: NDArray[np.uint8], background: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Picture of a `Canvas.layer` (height, width, 4) before a background (height, width, 3)."""
    frame = background.copy()
    rows, columns = (np.flatnonzero(front[..., 3].any(axis=axis)) for axis in (1, 0))
    if len(rows):
        box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        near = front[box]
        # From 0 to 256, for a shift in place of a division.
        free = 255 - near[..., 3:].astype(np.uint16)
        free += free >> 7
        frame[box] = near[..., :3] + ((frame[box] * free) >> 8).astype(np.uint8)
    return frame


def borrow_stage(anatomy: Anatomy, instrument: mujoco.MjModel, options: RenderOptions, gl_context: Any) -> Stage:
    """Stage shared by the simulations of one anatomy, for pictures of one size and kind; return it when done."""
    drawn = replace(options, camera="overview", show_force=True)
    key = anatomy, int(instrument.signature), drawn, id(gl_context)
    with LOCK:
        _close_all_at_exit()
        if key not in _stages:
            _stages[key] = Stage(anatomy, instrument, options, gl_context)
        _stages[key].users += 1
        return _stages[key]


def give_back_stage(stage: Stage) -> None:
    """Return a borrowed stage; the last user's return closes it."""
    with LOCK:
        stage.users -= 1
        if stage.users == 0:
            for key in [key for key, kept in _stages.items() if kept is stage]:
                del _stages[key]
                stage.close()


@cache
def _close_all_at_exit() -> None:
    """Register `_close_all` with the first stage, so that it runs while OpenGL is still loaded."""
    atexit.register(_close_all)


def _close_all() -> None:
    while _stages:
        _stages.popitem()[1].close()
