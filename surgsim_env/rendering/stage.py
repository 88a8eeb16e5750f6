"""A scene on the graphics side: uploads what moves, draws colour, depth, labels; shared by all that show the same."""

import contextlib
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray
from surgsim_env.anatomy import Anatomy
from surgsim_env.rendering import gl
from surgsim_env.rendering.cameras import Camera
from surgsim_env.rendering.drawn_mesh import Shape
from surgsim_env.rendering.instrument_geoms import PREFIX
from surgsim_env.rendering.options import RenderOptions
from surgsim_env.rendering.scene_model import FAR, LESION_COLOUR, NEAR, TARGET_COLOUR, build_scene
from surgsim_env.rendering.surface import DrawnSurface, drawn_surface
from surgsim_env.visibility import Disc

# What a pixel may show, and the number that stands for it.
LABELS = {"background": 0, "organ": 1, "instrument": 2, "lesion": 3, "target": 4}
# Which of them the scene's meshes are.
MESH_LABELS = dict.fromkeys(("organ", "held", "section"), LABELS["organ"]) | {"section_lesion": LABELS["lesion"]}
# Geoms that a picture may have beyond those of the model: lesions, and a target.
LESIONS_MOST = 100
SHADOW_MAP = 2048
# A target is drawn this thick [m], all of it below the disc itself.
TARGET_THICKNESS = 2e-4

_stages: dict[tuple, "Stage"] = {}
# One thread draws at a time.
LOCK = threading.RLock()


@dataclass(frozen=True, eq=False)
class Picture:
    """What is to be seen at one instant.

    Fields:
        shapes: surface and cut faces by their names in the scene
        lesions: centre [m] (3,), half axes [m] (3,) of each solid lesion
        instrument: the instrument's data, which is read
        target: a disc to be seen, None for none
    """

    shapes: dict[str, Shape]
    lesions: Sequence[tuple[FloatArray, FloatArray]]
    instrument: mujoco.MjData
    target: Disc | None = None


class Stage:
    """The drawn scene of an anatomy with its meshes in a graphics context."""

    def __init__(self, anatomy: Anatomy, instrument: mujoco.MjModel, options: RenderOptions, gl_context: Any) -> None:
        """Make the scene and load it; `gl_context` is current from now on wherever this stage draws."""
        self.users = 0
        self.surface: DrawnSurface = drawn_surface(anatomy.mesh.points, anatomy.mesh.boundary_triangles)
        self.scene = build_scene(anatomy, self.surface, instrument, options)
        self.gl_context = gl_context
        model = self.scene.model
        model.vis.quality.shadowsize = SHADOW_MAP if options.shadows else 0
        with gl.current(gl_context):
            try:
                self.context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
            except mujoco.FatalError as error:
                raise gl.NoGLError(f"OpenGL is there, but MuJoCo cannot draw with it: {error}") from error
        self.context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._drawn = mujoco.MjvScene(model, model.ngeom + LESIONS_MOST + 1)
        self._drawn.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = options.shadows
        self._drawn.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        # What the scene shows beyond its model: labels by their places in it.
        self._added: dict[int, int] = {}
        self._camera = mujoco.MjvCamera()
        self._camera.type, self._camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
        self._visible = mujoco.MjvOption()
        self._visible.geomgroup[:] = 1
        self._rect = mujoco.MjrRect(0, 0, options.width, options.height)

    def show(self, picture: Picture, camera: Camera) -> None:
        """Upload what moves and look at it through a camera."""
        scene = self.scene
        model, data = scene.model, scene.data
        scene.instrument.pose(picture.instrument, data)
        data.cam_xpos[0], data.cam_xmat[0], model.cam_fovy[0] = camera.position, camera.rotation.ravel(), camera.fov
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.context)
        for name, shape in picture.shapes.items():
            scene.meshes[name].upload(shape, self.context)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, self._visible, None, self._camera, everything, self._drawn)
        self._drawn.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = camera.sees_above_level()
        self._added.clear()
        for centre, half_axes in picture.lesions[:LESIONS_MOST]:
            self._add_lesion(centre, half_axes)
        if picture.target is not None:
            self._add_target(picture.target)

    def colour(self) -> NDArray[np.uint8]:
        """The picture, shape (height, width, 3), its first row on top."""
        frame = np.empty((self._rect.height, self._rect.width, 3), dtype=np.uint8)
        mujoco.mjr_render(self._rect, self._drawn, self.context)
        mujoco.mjr_readPixels(frame, None, self._rect, self.context)
        return np.ascontiguousarray(frame[::-1])

    def depth(self) -> NDArray[np.float32]:
        """Distance from the camera's plane [m], infinite where there is nothing, shape (height, width)."""
        raw = np.empty((self._rect.height, self._rect.width), dtype=np.float32)
        with _Flags(self._drawn):
            mujoco.mjr_render(self._rect, self._drawn, self.context)
        mujoco.mjr_readPixels(None, raw, self._rect, self.context)
        # Reversed depth: 1 at the near plane, 0 at the far one; 1 / z is linear in it.
        inverse = 1.0 / FAR + raw[::-1].astype(np.float64) * (1.0 / NEAR - 1.0 / FAR)
        return np.where(raw[::-1] > 0.0, 1.0 / inverse, np.inf).astype(np.float32)

    def labels(self) -> NDArray[np.uint8]:
        """What each pixel shows, by LABELS; solid lesions count also through the organ, shape (height, width)."""
        shown = self._labels()
        if self._lesions_solid():
            with self._without_organ():
                inside = self._labels()
            shown[(shown == LABELS["organ"]) & (inside == LABELS["lesion"])] = LABELS["lesion"]
        return shown

    def present(self, frame: NDArray[np.uint8]) -> None:
        """Copy a picture to the window that the context belongs to."""
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_WINDOW.value, self.context)
        mujoco.mjr_drawPixels(np.ascontiguousarray(frame[::-1]).ravel(), None, self._rect, self.context)

    def close(self) -> None:
        """Give back what the graphics hold."""
        with gl.current(self.gl_context):
            self.context.free()

    def _labels(self) -> NDArray[np.uint8]:
        frame = np.empty((self._rect.height, self._rect.width, 3), dtype=np.uint8)
        with _Flags(self._drawn):
            mujoco.mjr_render(self._rect, self._drawn, self.context)
        mujoco.mjr_readPixels(frame, None, self._rect, self.context)
        number = frame[::-1].astype(np.int32) @ np.array([1, 256, 65536], dtype=np.int32)
        table = np.zeros(self._drawn.ngeom + 1, dtype=np.uint8)
        for geom in self._drawn.geoms[: self._drawn.ngeom]:
            if geom.segid >= 0:
                table[geom.segid + 1] = self._label(geom)
        return table[number]

    def _label(self, geom: Any) -> int:
        if geom.objtype != mujoco.mjtObj.mjOBJ_GEOM:
            return self._added[geom.segid]
        name = self.scene.model.geom(geom.objid).name
        return LABELS["instrument"] if name.startswith(PREFIX) else MESH_LABELS.get(name, LABELS["background"])

    def _lesions_solid(self) -> bool:
        return LABELS["lesion"] in self._added.values()

    @contextlib.contextmanager
    def _without_organ(self) -> Iterator[None]:
        """The organ's meshes have no triangles for as long as this lasts."""
        hidden = [self.scene.meshes[name] for name in ("organ", "held")]
        for mesh in hidden:
            mesh.show(False, self.context)
        yield
        for mesh in hidden:
            mesh.show(True, self.context)

    def _add_lesion(self, centre: FloatArray, half_axes: FloatArray) -> None:
        self._add(mujoco.mjtGeom.mjGEOM_ELLIPSOID, half_axes, centre, np.eye(3), LESION_COLOUR, "lesion")

    def _add_target(self, disc: Disc) -> None:
        size = np.array([disc.radius, 0.5 * TARGET_THICKNESS, 0.0])
        centre = disc.centre - 0.5 * TARGET_THICKNESS * disc.normal
        self._add(mujoco.mjtGeom.mjGEOM_CYLINDER, size, centre, disc.rotation, TARGET_COLOUR, "target")

    def _add(
        self, kind: mujoco.mjtGeom, size: FloatArray, centre: FloatArray, rotation: FloatArray,
        colour: tuple[float, float, float], label: str,
    ) -> None:  # fmt: skip
        """Add a geom to the drawn scene that its model does not have."""
        drawn = self._drawn
        geom = drawn.geoms[drawn.ngeom]
        mujoco.mjv_initGeom(geom, kind, size, centre, rotation.ravel(), np.array([*colour, 1.0], dtype=np.float32))
        geom.specular, geom.shininess = 0.35, 0.5
        # mjv_initGeom leaves these as it found them, in memory that nobody has written.
        geom.objtype, geom.objid, geom.category = mujoco.mjtObj.mjOBJ_UNKNOWN, -1, mujoco.mjtCatBit.mjCAT_DECOR
        geom.segid = drawn.ngeom
        self._added[drawn.ngeom] = LABELS[label]
        drawn.ngeom += 1


class _Flags:
    """Geoms are drawn in the colour of their number for as long as this lasts."""

    def __init__(self, drawn: mujoco.MjvScene) -> None:
        self._drawn = drawn

    def __enter__(self) -> None:
        self._drawn.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = True
        self._drawn.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = True

    def __exit__(self, *_: object) -> None:
        self._drawn.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = False
        self._drawn.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = False


def borrow_stage(anatomy: Anatomy, instrument: mujoco.MjModel, options: RenderOptions, gl_context: Any) -> Stage:
    """The stage that all simulations of one anatomy share, for pictures of one size and kind; to be given back."""
    key = _key(anatomy, instrument, options, gl_context)
    with LOCK:
        _close_all_at_exit()
        if key not in _stages:
            _stages[key] = Stage(anatomy, instrument, options, gl_context)
        _stages[key].users += 1
        return _stages[key]


def give_back_stage(stage: Stage) -> None:
    """Close a stage that nobody else has borrowed."""
    with LOCK:
        stage.users -= 1
        if stage.users == 0:
            for key in [key for key, one in _stages.items() if one is stage]:
                del _stages[key]
                stage.close()


def _key(anatomy: Anatomy, instrument: mujoco.MjModel, options: RenderOptions, gl_context: Any) -> tuple:
    drawn = replace(options, camera="overview", show_force=True, force_mm_per_newton=1.0)
    return anatomy, int(instrument.signature), drawn, id(gl_context)


@cache
def _close_all_at_exit() -> None:
    gl.at_exit(_close_all)


def _close_all() -> None:
    while _stages:
        _stages.popitem()[1].close()
